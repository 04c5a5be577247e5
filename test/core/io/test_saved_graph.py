# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Saved graphs: a restored engine continues like one without interruption."""

from dataclasses import replace
import functools
from pathlib import Path
import tempfile

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from saved_graphs import (
    assert_same_value,
    feed_all,
    LINE_ODOMETRY,
    line_sample,
    SECOND,
    straight_line,
)
from test_delay_invariance import CONFIGS, drive, Event, PLAIN, SAME_PATH

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import (
    MeasurementSource,
)
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.geodesy import MapOrigin, TangentPlane
from pose_graph_ros.core.io.graph_files import read_graph, SavedGraph, site_refusal, write_graph
from pose_graph_ros.core.measurements import (
    AnswerStatus,
    GlobalPose,
    LoopClosure,
    Measurement,
    OdometrySample,
)


def through_files(saved: SavedGraph) -> SavedGraph:
    with tempfile.TemporaryDirectory() as folder:
        write_graph(saved, Path(folder) / 'graph')
        return read_graph(Path(folder) / 'graph.g2o')


def events(kind: str) -> list[Event]:
    odometry, measurements = drive(0, kind)
    return sorted(odometry + measurements)


def left_out(backend: PoseGraphBackend) -> list[tuple[str, Measurement]]:
    return [each[1:] for each in backend._pipeline.waiting]


def of_the_graph(backend: PoseGraphBackend) -> Estimate:
    """Return the estimate without what waits, which is not saved but sent again."""
    waiting, backend._pipeline.waiting = backend._pipeline.waiting, []
    estimate, backend._pipeline.waiting = backend.estimate(), waiting
    assert estimate is not None
    return estimate


def closed(backend: PoseGraphBackend) -> Estimate:
    assert backend.optimize().status is Status.CONVERGED
    estimate = backend.estimate()
    assert estimate is not None
    return estimate


@functools.cache
def uninterrupted(kind: str) -> Estimate:
    backend = PoseGraphBackend(CONFIGS[kind])
    feed_all(backend, events(kind))
    return closed(backend)


def assert_same_estimate(
    actual: Estimate, expected: Estimate, tolerance: float = 0.0, of_covariance: float = 0.0,
) -> None:
    np.testing.assert_array_equal(actual.path.stamps_ns, expected.path.stamps_ns)
    for one, other in ((actual.path.poses, expected.path.poses),
                       (actual.T_map_odom, expected.T_map_odom),
                       (actual.T_odom_base, expected.T_odom_base),
                       (actual.T_map_base, expected.T_map_base)):
        np.testing.assert_allclose(one[..., :2], other[..., :2], rtol=0.0, atol=tolerance)
        np.testing.assert_allclose(
            se2.wrap(one[..., 2] - other[..., 2]), 0.0, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(
        actual.covariance, expected.covariance, rtol=0.0, atol=tolerance + of_covariance)
    for name in (
            'n_hidden', 'n_edges', 'n_observed', 'n_biases', 'primary', 'alignment', 'odometry'):
        assert getattr(actual, name) == getattr(expected, name), name


# --- continuation --------------------------------------------------------------------------------

@given(st.sampled_from(list(CONFIGS)), st.integers(60, 900))
@settings(max_examples=5)
def test_a_graph_comes_back_to_the_bit_and_grows_on_as_without_saving(kind: str, cut: int) -> None:
    stream = events(kind)
    before = PoseGraphBackend(CONFIGS[kind])
    feed_all(before, stream[:cut])
    resent = left_out(before)
    saved = before.saved(MapOrigin(48.1, 11.6, 500.0, 0.25))
    assert saved.n_left_out == len(resent)
    loaded = through_files(saved)
    assert_same_value(loaded, saved)
    after = PoseGraphBackend.restored(CONFIGS[kind], loaded)
    # the state is the same
    estimate = of_the_graph(before)
    assert_same_estimate(after.estimate(), estimate)
    assert (after.estimate().chi2, after.estimate().alignment_sigma) == (
        estimate.chi2, estimate.alignment_sigma)
    for one, other in zip(
            after.graph.energies(), before.graph.energies(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert after.largest_energies(10_000) == before.largest_energies(10_000)
    before._factors._reports.clear()    # otherwise an older report may be returned
    assert repr(after.reports()) == repr(before.reports())
    assert_same_value(replace(after.saved(saved.datum), n_left_out=len(resent)), saved)
    # later estimates are the same as without saving
    for source, measurement in resent:
        assert after.add_measurement(measurement, source).status is not AnswerStatus.REJECTED
    feed_all(after, stream[cut:])
    # what else may have happened is weighed anew from a file
    assert_same_estimate(closed(after), uninterrupted(kind), SAME_PATH, 1e-6)


def test_a_robot_that_was_put_elsewhere_stays_there() -> None:
    elsewhere = np.array([500.0, 300.0, 1.0])
    # (closures would connect the nodes before and after)
    stream = [event for event in events('plain') if not isinstance(event.what, LoopClosure)]
    whole, parted = PoseGraphBackend(PLAIN), PoseGraphBackend(PLAIN)
    for backend in (whole, parted):
        feed_all(backend, stream[:500])
        newest_ns = int(backend.estimate().path.stamps_ns[-1])
        for _ in range(2):
            backend.set_pose(GlobalPose(newest_ns, elsewhere, 0.01 * np.eye(3)), 'hand')
        backend.update()
    resent = left_out(parted)
    saved = parted.saved()
    parted = PoseGraphBackend.restored(PLAIN, through_files(saved))
    assert_same_estimate(parted.estimate(), of_the_graph(whole))
    for source, measurement in resent:
        parted.add_measurement(measurement, source)
    odometry = [event for event in stream[500:] if isinstance(event.what, OdometrySample)]
    for backend in (whole, parted):
        feed_all(backend, odometry)
    assert_same_estimate(closed(parted), closed(whole), SAME_PATH)


def test_what_was_seen_is_refused_again_and_what_was_left_out_is_not() -> None:
    stream = [event for event in events('plain') if not isinstance(event.what, OdometrySample)]
    odometry = [event for event in events('plain') if isinstance(event.what, OdometrySample)]
    backend = PoseGraphBackend(PLAIN)
    feed_all(backend, odometry[:300])
    feed_all(backend, stream)
    restored = PoseGraphBackend.restored(PLAIN, through_files(backend.saved()))
    again = {key: restored.add_measurement(event.what, event.source).reason
             for key, event in enumerate(stream)}
    end_ns = backend._nodes.covered_ns
    for key, event in enumerate(stream):
        due = max(event.what.stamp_ns, getattr(event.what, 'reference_ns', None) or 0)
        assert again[key] == ('duplicate_stamp' if due <= end_ns else 'pending'), event


def test_edges_that_wait_and_those_set_aside_are_saved() -> None:
    backend = straight_line()
    for source, queue in (('waits', backend._pipeline.queue), ('failed', backend._quarantine)):
        assert backend.add_measurement(LoopClosure(
            10 * SECOND, np.array([5.0, 0.01, 0.0]), np.diag([0.01, 0.01, 0.001]),
            reference_node=5), source).status is AnswerStatus.ACCEPTED
        if queue is backend._quarantine:
            queue.append(backend._pipeline.queue.pop())
    restored = PoseGraphBackend.restored(LINE_ODOMETRY, through_files(backend.saved()))
    assert ([queued.source for queued in restored._pipeline.queue],
            [queued.source for queued in restored._quarantine]) == (['waits'], ['failed'])
    assert_same_estimate(closed(restored), closed(backend), SAME_PATH)
    assert restored.graph.n_edges == backend.graph.n_edges == len(backend.node_stamps_ns) - 1 + 2


# --- other settings than before ------------------------------------------------------------------

@pytest.mark.parametrize('now', [
    MeasurementSource(), MeasurementSource(correlation_time=7.0)])
@pytest.mark.parametrize('kind', ['plain', 'correlated'])
def test_a_source_with_other_settings_adds_to_its_saved_constraints(
    kind: str, now: MeasurementSource,
) -> None:
    stream, config = events(kind), CONFIGS[kind]
    backend = PoseGraphBackend(config)
    feed_all(backend, stream[:500])
    before, resent = of_the_graph(backend), left_out(backend)
    settings_ = {**config.measurements, 'gps': now}
    restored = PoseGraphBackend.restored(
        replace(config, measurements=settings_), through_files(backend.saved()))
    assert_same_estimate(restored.estimate(), before)
    assert restored.saved().sources['gps'].bias is None
    again = PoseGraphBackend.restored(config, through_files(restored.saved()))
    for each in (again, restored):
        for name, measurement in resent:
            each.add_measurement(measurement, name)
        feed_all(each, stream[500:])
        estimate = closed(each)
        assert estimate.n_observed == uninterrupted(kind).n_observed
        off = np.hypot(*(estimate.path.poses - uninterrupted(kind).path.poses)[:, :2].T)
        assert np.max(off) < 0.5
        each.reports()


# --- odometry after a load -----------------------------------------------------------------------

def last_edge(backend: PoseGraphBackend) -> tuple[np.ndarray, np.ndarray]:
    edge = backend.graph.factors_at(backend.graph.factor_ids[-1:])
    return edge.mean[0], np.linalg.inv(edge.information[0])


def test_odometry_that_continues_within_ten_seconds_makes_an_ordinary_edge() -> None:
    whole, saved = straight_line(), straight_line().saved()
    restored = PoseGraphBackend.restored(LINE_ODOMETRY, through_files(saved))
    for backend in (whole, restored):
        backend.add_odometry(line_sample(19.9, at=19.9), 'odom')
        for _ in range(2):
            backend.finish()
    for one, other in zip(last_edge(restored), last_edge(whole), strict=True):
        np.testing.assert_array_equal(one, other)
    assert restored.counts['odom', 'jump'] == 0


@pytest.mark.parametrize(('time', 'at'), [
    (3600.0, 0.0),      # restarted after an hour
    (20.2, 10.2),       # not restarted, after little more than ten seconds
    (12.0, 100.0)])     # restarted at once
def test_odometry_that_was_restarted_makes_a_loose_edge_to_where_the_robot_was(
    time: float, at: float,
) -> None:
    backend = straight_line()
    here = backend.estimate().T_map_base
    restored = PoseGraphBackend.restored(LINE_ODOMETRY, through_files(backend.saved()))
    raw = np.array([at, 7.0, 1.0])
    for k in range(30):
        step = np.array([0.2 * k, 0.0, 0.0])
        restored.add_odometry(OdometrySample(
            round((time + 0.2 * k) * SECOND), se2.compose(raw, step)), 'odom')
    restored.finish()
    restored.update()
    assert restored.counts['odom', 'jump'] == 1
    estimate = restored.estimate()
    # map -> odom places the first new sample at the saved pose of the robot
    np.testing.assert_allclose(
        estimate.T_map_odom, se2.compose(here, se2.inverse(raw)), atol=1e-9)
    np.testing.assert_allclose(
        estimate.T_map_base, se2.compose(here, np.array([5.8, 0.0, 0.0])), atol=1e-9)
    sigma = np.sqrt(np.diagonal(estimate.covariance))
    assert 1.0 < sigma[0] < 1.2
    assert 0.3 < sigma[2] < 0.32
    old = restored.add_odometry(line_sample(9.05), 'odom')
    assert old.reason == 'out_of_order'


# --- measurements after a load -------------------------------------------------------------------

def curve(time: float) -> np.ndarray:
    theta = 0.25 * time
    return np.array([8.0 * np.sin(theta), 8.0 - 8.0 * np.cos(theta), se2.wrap(theta)])


def test_a_closure_may_refer_to_a_saved_node_or_an_instant_between_saved_nodes() -> None:
    backend = PoseGraphBackend(LINE_ODOMETRY)
    for k in range(3000):
        backend.add_odometry(
            OdometrySample(SECOND + round(0.1 * k * SECOND), curve(0.1 * k)), 'odom')
    backend.finish()
    restored = PoseGraphBackend.restored(LINE_ODOMETRY, through_files(backend.saved()))
    stamps = backend.node_stamps_ns
    names = [{'reference_node': 42}, {'reference_ns': int(stamps[42])},
             {'reference_ns': int(stamps[42]) + 300_000_000}]
    for k, name in enumerate(names):
        answer = restored.add_measurement(LoopClosure(
            int(stamps[-1]), np.zeros(3), np.eye(3), **name), f'closure {k}')
        assert answer.status is AnswerStatus.ACCEPTED
    means = [queued.factor.mean[0] for queued in restored._pipeline.queue]
    np.testing.assert_array_equal(means[0], means[1])
    # between saved nodes odometry is interpolated, and its noise covers the error
    farthest = 0.0
    for stamp in range(int(stamps[0]), int(stamps[-1]), 130_000_000):
        fine, coarse = backend._nodes.attach(stamp), restored._nodes.attach(stamp)
        off = se2.between(coarse.motion, fine.motion)
        farthest = max(farthest, float(np.hypot(off[0], off[1])))
        sigmas = np.sqrt(off @ covariance.information(coarse.noise + 1e-8 * np.eye(3)) @ off)
        assert sigmas < 3.0
        if stamp > stamps[-1] - 50 * SECOND:
            np.testing.assert_array_equal(off, 0.0)
    assert 1e-4 < farthest < 0.1


# --- the site ------------------------------------------------------------------------------------

HERE = MapOrigin(48.1, 11.6, 500.0, 0.1)


def north_of(origin: MapOrigin, metres: float) -> MapOrigin:
    there = TangentPlane(origin.latitude, origin.longitude).to_geodetic(np.array([0.0, metres]))
    return origin._replace(latitude=float(there[0]), longitude=float(there[1]))


def saved_here(datum: MapOrigin | None = HERE) -> SavedGraph:
    """Return the graph of a line of 9 km to the east of the datum, aligned."""
    saved = straight_line().saved(datum)
    poses = saved.rows.poses.copy()
    poses[:, 0] *= 1000.0
    return replace(saved, rows=saved.rows._replace(poses=poses),
                   alignment=replace(saved.alignment, state='aligned'))


def test_no_site_is_refused_if_the_graph_or_the_robot_has_no_datum() -> None:
    assert site_refusal(saved_here(None), datum=HERE, fix=HERE) is None
    assert site_refusal(saved_here(), None, None) is None


@pytest.mark.parametrize(('datum', 'same'), [
    (HERE, True), (HERE._replace(altitude=0.0), True),
    (north_of(HERE, 0.009), True), (north_of(HERE, 0.011), False),
    (HERE._replace(yaw=0.1 + 0.9e-6), True), (HERE._replace(yaw=0.1 + 1.1e-6), False),
    (HERE._replace(yaw=0.1 - 2.0 * np.pi), True), (HERE._replace(longitude=11.6 - 360.0), True),
    (MapOrigin(-48.1, -168.4, 0.0, 0.1), False)])
def test_a_datum_that_was_set_must_be_that_of_the_graph(datum: MapOrigin, same: bool) -> None:
    refusal = site_refusal(saved_here(), datum, None)
    assert (refusal is None) is same
    if refusal is not None:
        assert str(HERE) in refusal
        assert str(datum) in refusal


def test_a_first_fix_must_be_near_a_node() -> None:
    saved = saved_here()
    plane = TangentPlane(*HERE)
    end = saved.rows.poses[-1, 0]
    for beyond, same in ((9_900.0, True), (10_100.0, False)):
        latitude, longitude, _ = plane.to_geodetic(np.array([end + beyond, 0.0])).tolist()
        assert (site_refusal(saved, None, fix=MapOrigin(latitude, longitude)) is None) is same
    # of a graph that is not in the map only the datum counts
    unaligned = replace(saved, alignment=replace(saved.alignment, state='unaligned'))
    latitude, longitude, _ = plane.to_geodetic(np.array([end + 9_900.0, 0.0])).tolist()
    assert site_refusal(unaligned, None, fix=MapOrigin(latitude, longitude)) is not None
    assert site_refusal(unaligned, None, fix=north_of(HERE, 9_990.0)) is None
