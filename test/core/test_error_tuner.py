# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Correlated errors are found, the graph treats them so, and all of it can be undone."""

from dataclasses import replace
import functools

import numpy as np
import pytest

from pose_graph_ros.core import error_tuner
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import (
    BackendConfig,
    MeasurementSource,
    OdometrySource,
    POSITIONS,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.measurements import Measurement, OdometrySample, Position
from pose_graph_ros.core.odometry.motion import AS_CLAIMED
from pose_graph_ros.core.smoother.incremental import UpdateResult
from pose_graph_ros.core.sources.bias import CorrelatedErrors

SECOND = 1_000_000_000
TAU = 20.0
SOURCE = replace(POSITIONS, robust=MeasurementSource().robust)
Event = OdometrySample | Measurement


def drive(seed: int, tau: float, *, n: int = 200, drift: float = 1.0) -> list[Event]:
    """Return odometry and fixes of 1 m at 1 Hz on a winding road of n seconds."""
    rng = np.random.default_rng(seed)
    noise = BackendConfig().odometry_source('odom').noise
    true, seen, events = np.zeros(3), np.array((3.0, 1.0, 2.0)), []
    error = rng.standard_normal(2)
    kept = np.exp(-1.0 / tau)
    for second in range(1, n + 1):
        step = np.array((1.0, 0.0, 0.15 * np.sin(0.2 * second)))
        slip = drift * rng.standard_normal(3) * (
            noise.sigma_distance, noise.sigma_lateral, noise.sigma_heading_distance)
        true, seen = se2.compose(true, step), se2.compose(seen, se2.compose(step, slip))
        events.append(OdometrySample(second * SECOND, seen))
        error = kept * error + np.sqrt(1.0 - kept**2) * rng.standard_normal(2)
        where = true[:2] + np.sqrt(0.95) * error + np.sqrt(0.05) * rng.standard_normal(2)
        events.append(Position(second * SECOND, where, np.eye(2), np.zeros(2)))
    return events


def fed(events: list[Event], source: MeasurementSource = SOURCE) -> PoseGraphBackend:
    backend = PoseGraphBackend(BackendConfig(measurements={'fix': source}))
    go_on(backend, events)
    return backend


def go_on(backend: PoseGraphBackend, events: list[Event]) -> None:
    for k, event in enumerate(events):
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
        else:
            backend.add_measurement(event, 'fix')
        if k % 8 == 7:
            assert backend.update().status is not Status.FAILED


def in_use(backend: PoseGraphBackend) -> CorrelatedErrors | None:
    return backend._factors.errors_in_use('fix')


def path(backend: PoseGraphBackend) -> np.ndarray:
    estimate = backend.estimate()
    assert estimate is not None
    return estimate.path.poses


def assert_each_held_once(backend: PoseGraphBackend) -> None:
    """Each fix counts once: as an edge to a bias, or as an observed node."""
    constraints = backend._factors.sources['fix']
    every, as_edges = backend.graph.weights, constraints.measured['held_by']
    weights = every[constraints.measured['id']]
    np.testing.assert_array_equal(weights > 0.0, as_edges < 0)
    assert np.all(every[as_edges[as_edges >= 0]] > 0.0)
    held = np.zeros(len(every), dtype=bool)
    held[as_edges[as_edges >= 0]] = True
    table = backend.graph.factors
    to_pose = (table.kind == FactorKind.BIAS) & ~backend.graph.is_bias[table.i]
    assert np.all(every[to_pose & ~held] == 0.0)


def test_correlated_errors_are_found_online_and_the_whole_past_is_changed() -> None:
    backend = fed(drive(1, TAU))
    found = in_use(backend)
    assert found is not None
    assert 0.4 * TAU < found.tau < 2.5 * TAU
    assert 0.4 < found.correlated + found.white < 2.5
    while not backend.refine().finished:
        pass
    assert np.all(backend._factors.sources['fix'].measured['held_by'] >= 0)
    assert_each_held_once(backend)
    white = fed(drive(1, TAU), replace(SOURCE, correlation_time=0.0))
    sigmas = [np.sqrt(each.estimate().covariance[0, 0]) for each in (white, backend)]
    assert sigmas[1] > 1.5 * sigmas[0]
    report = backend.reports()['fix']
    assert report.in_use == in_use(backend)
    assert not report.wrongly_white


def test_white_errors_stay_as_they_are_bit_for_bit() -> None:
    events = drive(2, 1e-3)
    backend, white = fed(events), fed(events, replace(SOURCE, correlation_time=0.0))
    assert in_use(backend) is None
    np.testing.assert_array_equal(path(backend), path(white))
    for each in (backend, white):
        each.optimize()
    assert in_use(backend) is None
    np.testing.assert_array_equal(path(backend), path(white))


@pytest.mark.parametrize('seed', [1, 2])
def test_the_final_path_does_not_depend_on_the_order_of_arrival(seed: int) -> None:
    events, source = drive(seed, TAU, n=120), SOURCE
    random = np.random.default_rng(seed)
    late = [event.stamp_ns + (60 * SECOND * random.random() if isinstance(event, Position) else 0)
            for event in events]
    shuffled = [events[k] for k in np.argsort(late, kind='stable')]
    backends = [fed(events, source), fed(shuffled, source)]
    for backend in backends:
        assert backend.optimize().status is Status.CONVERGED
        assert in_use(backend) is not None
    assert in_use(backends[0]) == in_use(backends[1])
    np.testing.assert_allclose(*map(path, backends), atol=1e-9)
    again = path(backends[0])
    n_factors = backends[0].graph.n_factors
    backends[0].optimize()
    np.testing.assert_allclose(path(backends[0]), again, atol=1e-9)
    assert backends[0].graph.n_factors == n_factors


def test_what_is_saved_goes_on_as_if_it_had_not_been() -> None:
    events = drive(4, TAU)
    backend = fed(events[:240])
    assert in_use(backend) is not None
    backend.update()
    restored = PoseGraphBackend.restored(backend._config, backend.saved())
    assert in_use(restored) == in_use(backend)
    for each in (backend, restored):
        go_on(each, events[230:])   # again what waited for odometry when it was saved
        each.optimize()
    assert in_use(restored) == in_use(backend)
    assert_each_held_once(restored)
    np.testing.assert_allclose(path(restored), path(backend), atol=1e-9)


@pytest.mark.parametrize('error', [False, True])
def test_a_change_that_fails_is_undone_as_a_whole(
    error: bool, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(error_tuner, 'PART', 30)
    events = drive(5, TAU, n=100)
    backend = fed(events, replace(SOURCE, correlation_time=0.0))
    backend.optimize()
    white = path(backend)
    tuner, smoother = backend._tuner, backend._smoother
    tuner._begin('fix', CorrelatedErrors(TAU, 1.0, 0.05))
    update, calls = smoother.update, 0

    def failing(change: object) -> UpdateResult:
        nonlocal calls
        calls += 1
        if calls == 3 and error:
            raise ValueError('the third part')
        if calls == 3:
            return UpdateResult(Status.FAILED, 'the third part', 0, 0, 0, 0)
        return update(change)  # type: ignore[arg-type]

    monkeypatch.setattr(smoother, 'update', failing)
    while not tuner.is_idle:
        tuner.step()
    assert calls > 3
    assert tuner.n_failures == 1
    assert in_use(backend) is None
    assert np.all(backend._factors.sources['fix'].measured['held_by'] == -1)
    assert_each_held_once(backend)
    assert backend.optimize().status is Status.CONVERGED
    np.testing.assert_allclose(path(backend), white, atol=1e-9)


def sigmas_of_odometry(backend: PoseGraphBackend) -> np.ndarray:
    """Return those of the position along each edge, relative to what is claimed by default."""
    edges = backend.graph.factors.edges
    rows = edges.kind == FactorKind.ODOMETRY
    assert set(edges.weight[rows]) == {1.0}
    claimed = fed_once().rows(np.flatnonzero(fed_once().kind == FactorKind.ODOMETRY))
    return np.sqrt(np.linalg.inv(edges.information[rows])[:, 0, 0]) / np.sqrt(
        np.linalg.inv(claimed.information)[:, 0, 0])


@functools.cache
def fed_once() -> Factors:
    """Return the edges of a drive as odometry claims them."""
    claimed = PoseGraphBackend(BackendConfig(
        measurements={'fix': SOURCE}, odometry={'odom': OdometrySource(sigma_scale=1.0)}))
    go_on(claimed, drive(8, 1e-3, drift=4.0))
    claimed.finish()
    return claimed.graph.factors.edges


def test_an_odometry_that_drifts_more_than_it_claims_gets_more_noise() -> None:
    events = drive(8, 1e-3, drift=4.0)
    backend = fed(events[:240])
    assert np.sqrt(backend.estimate().odometry_errors.way) > 2.0
    for each in (backend, PoseGraphBackend.restored(backend._config, backend.saved())):
        go_on(each, events[230:])   # again what waited for odometry when it was saved
        each.optimize()
        errors = each.estimate().odometry_errors
        assert 2.0 < np.sqrt(errors.way) < 6.0
        if errors.rate == 0.0:
            np.testing.assert_allclose(sigmas_of_odometry(each), np.sqrt(errors.way), rtol=0.1)
    np.testing.assert_allclose(path(each), path(backend), atol=1e-6)


@pytest.mark.parametrize('scale', [0.0, 1.0])
def test_an_odometry_as_it_claims_or_whose_scale_is_given_keeps_its_noise(scale: float) -> None:
    source = OdometrySource(sigma_scale=scale)
    backend = PoseGraphBackend(BackendConfig(
        measurements={'fix': SOURCE}, odometry={'odom': source}))
    go_on(backend, drive(8, 1e-3, drift=4.0 if scale > 0.0 else 1.0))
    backend.optimize()
    assert backend.estimate().odometry_errors == AS_CLAIMED
