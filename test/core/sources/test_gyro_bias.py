# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscopes in the engine: heading in outages, bias, rest, late rates, saved graphs."""

from dataclasses import replace
from pathlib import Path

from gyro_drive import Drive, EPOCH, GYRO, run, SECOND, settings, simulate
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, OdometryNoise, OdometrySource, WindowConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.io.graph_files import read_graph, write_graph
from pose_graph_ros.core.measurements import (
    AnswerStatus,
    GlobalPose,
    Measurement,
    OdometrySample,
    YawRate,
)
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.gyro import turn

Events = list[tuple[str, OdometrySample | Measurement]]


def feed(backend: PoseGraphBackend, events: Events, every: int = 40) -> PoseGraphBackend:
    for count, (source, event) in enumerate(events):
        if isinstance(event, OdometrySample):
            backend.add_odometry(event, source)
        else:
            backend.add_measurement(event, source)
        if count % every == 0:
            backend.update()
    return backend


def finished(events: Events) -> PoseGraphBackend:
    backend = feed(PoseGraphBackend(settings()), events)
    backend.optimize()
    return backend


def path_of(backend: PoseGraphBackend) -> np.ndarray:
    return backend.estimate().path.poses


@pytest.fixture(scope='module')
def short() -> Drive:
    return simulate(1, duration=50.0, outage=(30.0, 45.0))


def test_the_heading_in_an_outage_is_several_times_better_and_honest() -> None:
    with_gyro, without, energies = [], [], []
    for seed in (1, 2):
        drive = simulate(seed)
        for gyro, found in ((False, without), (True, with_gyro)):
            _, errors = run(drive, gyro=gyro)
            assert len(errors) > 50
            found.append(np.mean(errors[:, 0]**2))
        energies.append(np.mean((errors[:, 0] / errors[:, 1])**2))
    # 12 seeds gave 13.7
    assert np.sqrt(np.mean(without) / np.mean(with_gyro)) > 5.0
    assert 0.02 < np.mean(energies) < 3.0


def test_rest_measures_the_bias() -> None:
    bias, times = 0.013, np.arange(0.0, 12.0, 0.02)
    rng = np.random.default_rng(4)
    events: Events = [('odom', OdometrySample(EPOCH + round(t * 1e9), np.zeros(3)))
                      for t in times[::5].tolist()]
    rates = bias + rng.normal(0.0, GYRO.sigma_rate / np.sqrt(0.02), len(times))
    events += [('gyro', YawRate(EPOCH + round(t * 1e9), rate))
               for t, rate in zip(times.tolist(), rates.tolist(), strict=True)]
    events.sort(key=lambda event: event[1].stamp_ns)
    backend = finished(events)
    value = backend.gyro_biases(backend.graph)['gyro']
    assert value == pytest.approx(bias, abs=4.0 * GYRO.sigma_rate / np.sqrt(8.0))
    state = backend.graph.node_rows(backend._factors.sources['gyro'].bias.nodes)[-1]
    sigma = np.sqrt(backend._smoother.covariances()[state, 0, 0])
    assert sigma == pytest.approx(GYRO.sigma_rate / np.sqrt(8.66), rel=0.1)


def test_a_robot_that_is_turned_while_its_wheels_stand_is_not_at_rest() -> None:
    times = np.arange(0.0, 12.0, 0.02)
    events: Events = [('odom', OdometrySample(EPOCH + round(t * 1e9), np.zeros(3)))
                      for t in times[::5].tolist()]
    events += [('gyro', YawRate(EPOCH + round(t * 1e9), 0.5)) for t in times.tolist()]
    events.sort(key=lambda event: event[1].stamp_ns)
    observed = finished(events).graph.factors.observed
    assert len(observed) == 1   # the prior of the bias alone


def test_late_and_shuffled_rates_give_the_same_graph(short: Drive) -> None:
    expected = path_of(finished(short.events))
    rng = np.random.default_rng(2)

    def later(seconds: float, jitter: float) -> Events:
        due = [event.stamp_ns + SECOND * (seconds + jitter * rng.uniform())
               if source == 'gyro' else event.stamp_ns for source, event in short.events]
        return [short.events[k] for k in np.argsort(due, kind='stable')]

    for seconds, jitter in ((0.0, 0.24), (20.0, 0.0), (100.0, 0.24), (-30.0, 0.0)):
        assert path_of(finished(later(seconds, jitter))) == pytest.approx(expected, abs=1e-9)


def test_a_gap_leaves_rotations_out_and_is_counted(short: Drive) -> None:
    begin, end = EPOCH + 20 * SECOND, EPOCH + 24 * SECOND
    backend = finished([(source, event) for source, event in short.events
                        if source != 'gyro' or not begin < event.stamp_ns < end])
    edges, stamps = backend.graph.factors.edges, backend.node_stamps_ns
    turns = edges.rows(edges.kind == FactorKind.TURN)
    ends = stamps[np.searchsorted(backend._nodes.ids, turns.j)]
    missing = len(stamps) - 1 - len(turns)
    assert backend.counts['gyro', 'gap'] == missing == np.sum(
        (stamps > begin) & (stamps <= end)) + 1
    assert not np.any((ends > begin) & (ends < end))


def test_with_a_window_old_biases_leave_and_the_newest_pose_is_as_good(short: Drive) -> None:
    whole = feed(PoseGraphBackend(settings()), short.events)
    part = feed(PoseGraphBackend(replace(settings(), window=WindowConfig(seconds=15.0))),
                short.events)
    for backend in (whole, part):
        backend.update()
    assert part.graph.n_nodes < 0.6 * whole.graph.n_nodes
    assert np.count_nonzero(part.graph.is_bias) < np.count_nonzero(whole.graph.is_bias)
    assert len(path_of(part)) == len(path_of(whole))
    newest, expected = path_of(part)[-1], path_of(whole)[-1]
    assert newest[:2] == pytest.approx(expected[:2], abs=0.1)
    assert newest[2] == pytest.approx(expected[2], abs=0.02)


def test_no_rotation_spans_the_step_to_a_pose_that_is_set(short: Drive) -> None:
    half = EPOCH + 25 * SECOND
    backend = feed(PoseGraphBackend(settings()), [
        each for each in short.events if each[1].stamp_ns <= half])
    backend.update()
    before = backend.graph.n_nodes
    turned = backend.estimate().path.poses[-1] + (0.0, 0.0, 1.5)
    answer = backend.set_pose(GlobalPose(half, turned, np.diag((0.01, 0.01, 1e-4))), 'set_pose')
    assert answer.status is AnswerStatus.ACCEPTED
    feed(backend, [each for each in short.events if half < each[1].stamp_ns <= half + 2 * SECOND
                   and each[0] != 'fix'])
    backend.update()
    moved = backend._nodes.ids[max(backend._nodes.relocated)]
    edges = backend.graph.factors.edges
    turns = edges.rows(edges.kind == FactorKind.TURN)
    assert moved >= before
    assert not np.any(turns.j == moved)
    assert np.any(turns.i == moved)
    pose = backend.graph.poses_of(np.array([moved]))[0]
    assert abs(se2.wrap(pose[2] - turned[2])) < 0.01


def test_with_another_period_the_chain_of_the_bias_goes_on(short: Drive, tmp_path: Path) -> None:
    half = len(short.events) // 2
    saved = feed(PoseGraphBackend(settings()), short.events[:half]).saved()
    n_before = np.count_nonzero(saved.rows.is_bias)
    restored = PoseGraphBackend.restored(settings(replace(GYRO, bias_period=4.0)), saved)
    feed(restored, short.events[half:-220])
    saved = restored.saved()
    assert saved.n_left_out == 0
    write_graph(saved, tmp_path / 'map')
    again = PoseGraphBackend.restored(
        settings(replace(GYRO, bias_period=4.0)), read_graph(tmp_path / 'map'))
    for each in (restored, again):
        feed(each, short.events[-220:])
        each.optimize()
    assert path_of(again) == pytest.approx(path_of(restored), abs=1e-9)
    assert path_of(restored) == pytest.approx(path_of(finished(short.events)), abs=0.05)
    names = [each.name for each in again.largest_energies(2000)]
    assert any(name.startswith('gyro x') for name in names)
    assert any(name.startswith('error of gyro at') for name in names)
    # one prior, and the new states begin where the old ones end
    graph = restored.graph
    biases = np.flatnonzero(graph.is_bias)
    assert len(biases) >= n_before + 5
    kinds = graph.factors.edges.kind
    assert np.count_nonzero(kinds == FactorKind.BIAS) == len(biases) - 1


def test_rotations_that_come_after_their_nodes_have_left_are_counted(short: Drive) -> None:
    backend = PoseGraphBackend(replace(settings(), window=WindowConfig(seconds=10.0)))
    feed(backend, [each for each in short.events if each[0] != 'gyro'])
    backend.update()
    frozen = backend._nodes.n_frozen
    assert frozen > 10
    feed(backend, [each for each in short.events if each[0] == 'gyro'])
    backend.optimize()
    assert backend.counts['gyro', 'before_window'] == frozen
    turns = np.count_nonzero(backend.graph.factors.edges.kind == FactorKind.TURN)
    assert turns == len(backend.node_stamps_ns) - 1 - frozen


def test_the_newest_pose_has_the_rotation_by_the_gyroscope() -> None:
    """Wheels that do not notice a turn, between two hidden nodes."""
    events: Events = [('odom', OdometrySample(EPOCH + round(t * 1e9), np.zeros(3)))
                      for t in np.arange(0.0, 6.0, 0.1).tolist()]
    # the last turn begins after the newest hidden node
    events += [('gyro', YawRate(EPOCH + round(t * 1e9), 0.3 if t > 5.3 else 0.0))
               for t in np.arange(0.01, 5.95, 0.02).tolist()]
    events.sort(key=lambda event: event[1].stamp_ns)
    noise = OdometryNoise(sigma_heading_distance=0.1)
    events = [(source, replace(event, pose=np.array((0.2 * (event.stamp_ns - EPOCH) * 1e-9, 0, 0)))
               if isinstance(event, OdometrySample) else event) for source, event in events]
    backend = feed(PoseGraphBackend(settings(odometry=OdometrySource(noise=noise))), events)
    backend.update()
    last_ns = int(backend.node_stamps_ns[-1])
    assert last_ns < EPOCH + 5.3 * SECOND
    estimate = backend.estimate()
    assert estimate.T_map_base[2] == pytest.approx(0.3 * 0.6, abs=0.02)
    alone = feed(PoseGraphBackend(settings(odometry=OdometrySource(noise=noise))),
                 [each for each in events if each[0] != 'gyro']).estimate()
    assert alone.T_map_base[2] == pytest.approx(0.0, abs=1e-9)
    assert estimate.covariance[2, 2] < alone.covariance[2, 2]


def test_each_of_two_gyroscopes_goes_on_from_its_own_bias_within_an_update() -> None:
    graph = Graph()
    graph.apply(GraphUpdate(hidden=np.zeros((4, 3))))
    update = FactorBuilder(BackendConfig(), Reweighting()).build([
        queued for k in range(3) for source, rate in (('left', 0.02), ('right', -0.01))
        for queued in turn(source, (k, k + 1), round((1.0 + 20.0 * k) * SECOND), (0.0, 1e-4, 1.0),
                           (rate, 1e-6))], graph)
    assert update.biases[:, 0].tolist() == [0.02] * 3 + [-0.01] * 3
