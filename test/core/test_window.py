# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A back end with a window: the same poses as without, and a graph that does not grow."""

import functools

import numpy as np
import pytest

from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, MeasurementSource, WindowConfig, WindowPrior
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import LoopClosure, Measurement, OdometrySample, Position

SECOND = 1_000_000_000
RATE = 5
LAP = 250
WINDOW = WindowConfig(nodes=100)
N = 900     # samples, five for each node

Event = tuple[str, OdometrySample | Measurement]


def stamp_of(k: int) -> int:
    return (k + 1) * SECOND // RATE


@functools.cache
def drive(
    n: int, *, fixes: int = 5, closures: int = 15, seed: int = 0, first_fix: int = 0,
) -> tuple[tuple[Event, ...], FloatArray]:
    """Return the events of laps at 1 m/s by stamp, each fixes and closures samples, and truth."""
    rng = np.random.default_rng(seed)
    truth, odometry, events = [np.zeros(3)], np.array([5.0, -2.0, 1.0]), []
    for k in range(n):
        stamp = stamp_of(k)
        events.append(('odom', OdometrySample(stamp, odometry)))
        if fixes > 0 and k % fixes == 3 and k >= first_fix:
            events.append(('fix', Position(
                stamp, truth[k][:2] + rng.normal(0.0, 0.5, 2), 0.25 * np.eye(2), np.zeros(2))))
        if closures > 0 and k % closures == 7 and k > LAP + 10:
            z = se2.between(truth[k - LAP], truth[k]) + rng.normal(0.0, [0.1, 0.1, 0.02])
            events.append(('loop_closure', LoopClosure(
                stamp, z, np.diag([0.01, 0.01, 4e-4]), reference_ns=stamp_of(k - LAP))))
        step = np.array([0.2, 0.0, 2.0 * np.pi / LAP])
        truth.append(se2.compose(truth[-1], step))
        odometry = se2.compose(odometry, step + rng.normal(0.0, [0.02, 0.01, 0.005]))
    return tuple(events), np.array(truth)


def add(backend: PoseGraphBackend, event: Event) -> str:
    source, what = event
    answer = (backend.add_odometry(what, source) if isinstance(what, OdometrySample)
              else backend.add_measurement(what, source))
    return answer.reason or answer.status.value


def run(
    events: tuple[Event, ...] | list[Event], window: WindowConfig | None,
    backend: PoseGraphBackend | None = None,
) -> PoseGraphBackend:
    """Return a back end after the events, with an update every two seconds."""
    if backend is None:
        backend = PoseGraphBackend(BackendConfig(window=window or WindowConfig()))
    for number, event in enumerate(events):
        add(backend, event)
        if number % 12 == 11:
            assert backend.update().status is not Status.FAILED
    return backend


@functools.cache
def without_a_window() -> Estimate:
    estimate = run(drive(N)[0], None).estimate()
    assert estimate is not None
    return estimate


@pytest.mark.parametrize('window', [
    WINDOW, WindowConfig(seconds=70.0), WindowConfig(metres=80.0),
    WindowConfig(nodes=100, prior=WindowPrior.SPARSE)])
def test_the_newest_pose_is_that_of_the_whole_graph_but_the_graph_is_small(
    window: WindowConfig,
) -> None:
    events, truth = drive(N)
    part = run(events, window)
    one, other = without_a_window(), part.estimate()
    assert other is not None
    sigma = np.sqrt(np.diag(one.covariance))
    assert np.all(np.abs(se2.between(one.T_map_base, other.T_map_base)) < 0.7 * sigma)
    assert np.all(np.diag(other.covariance) > 0.7 * np.diag(one.covariance))
    assert np.all(np.diag(other.covariance) < 1.7 * np.diag(one.covariance))
    # the whole path is there, though most of it has left the graph
    np.testing.assert_array_equal(one.path.stamps_ns, other.path.stamps_ns)
    errors = other.path.poses[:-1, :2] - truth[:-1:5][:len(other.path) - 1, :2]
    assert np.sqrt(np.mean(errors**2)) < 0.3
    assert other.n_hidden == one.n_hidden > 170
    assert other.n_frozen > 60
    assert part.graph.n_nodes - other.n_biases <= 115 + 1
    assert len(part.graph.factors.edges) < 300
    assert len(part.graph.factors.observed) < 150
    assert len(part.graph.priors) == (window.prior is WindowPrior.DENSE)


def test_with_modelled_errors_a_sparse_prior_keeps_what_it_has_of_biases_dense() -> None:
    events, _ = drive(600)
    correlated = {'fix': MeasurementSource(correlation_time=20.0)}
    found = [run(events, None, PoseGraphBackend(BackendConfig(
        window=WindowConfig(nodes=60, prior=prior), measurements=correlated)))
        for prior in (WindowPrior.DENSE, WindowPrior.SPARSE)]
    one, other = (backend.estimate() for backend in found)
    assert one is not None
    assert other is not None
    assert one.n_frozen == other.n_frozen > 40
    assert found[1].graph.n_nodes == found[0].graph.n_nodes
    for prior in found[1].graph.priors:
        assert np.any(found[1].graph.is_bias[found[1].graph.node_rows(prior.nodes)])
    sigma = np.sqrt(np.diag(one.covariance))
    assert np.all(np.abs(se2.between(one.T_map_base, other.T_map_base)) < 0.5 * sigma)
    assert np.all(np.diag(other.covariance) > 0.9 * np.diag(one.covariance))
    assert np.all(np.diag(other.covariance) < 1.5 * np.diag(one.covariance))


def test_what_has_left_does_not_change_any_more_and_nothing_grows() -> None:
    events, _ = drive(2 * N)
    backend, sizes, frozen = PoseGraphBackend(BackendConfig(window=WINDOW)), [], np.empty((0, 3))
    for number, event in enumerate(events):
        add(backend, event)
        if number % 12 == 11:
            backend.update()
            now = backend._nodes.frozen
            np.testing.assert_array_equal(now[:len(frozen)], frozen)
            frozen = now.copy()
            graph, stream = backend.graph, backend._nodes.streams['odom']
            sizes.append((graph.n_nodes, graph.n_edges, graph.n_factors, len(stream.timeline),
                          sum(len(stamps_ns) for stamps_ns, _
                              in backend._pipeline.seen.saved([]).values()),
                          len(backend._reweighting), len(backend._pipeline.queue)))
    at = len(sizes) // 3
    first, last = np.max(sizes[at:2 * at], axis=0), np.max(sizes[2 * at:], axis=0)
    assert np.all(last <= 1.15 * first + 5)


def test_delayed_and_shuffled_within_the_window_the_path_is_the_same() -> None:
    events, _ = drive(N)
    rng = np.random.default_rng(1)
    delays = [0.0 if source == 'odom' else rng.uniform(0.0, 20.0) * SECOND for source, _ in events]
    order = np.argsort([what.stamp_ns + delay for (_, what), delay in zip(
        events, delays, strict=True)], kind='stable')
    prompt, late = (run(some, WINDOW) for some in (events, [events[k] for k in order]))
    for backend in (prompt, late):
        assert backend.optimize().status is Status.CONVERGED
    one, other = prompt.estimate(), late.estimate()
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(prompt._nodes.ids, prompt._nodes.ids)
    assert one.n_frozen == other.n_frozen
    assert (one.n_observed, one.n_edges) == (other.n_observed, other.n_edges)
    # linearized at other estimates when they left
    kept = slice(one.n_frozen, None)
    np.testing.assert_allclose(one.path.poses[kept, :2], other.path.poses[kept, :2], atol=0.05)
    np.testing.assert_allclose(one.path.poses[:, :2], other.path.poses[:, :2], atol=0.3)


def test_a_path_that_has_left_moves_into_the_map_when_the_angle_is_found() -> None:
    events, truth = drive(N, first_fix=600, closures=0)
    backend, held = PoseGraphBackend(BackendConfig(window=WINDOW)), False
    for number, event in enumerate(events):
        add(backend, event)
        if number % 12 == 11:
            backend.update()
            before = backend.estimate()
            # the first node, the gauge, stays until the alignment frees it
            held = held or (before.n_frozen > 0 and bool(backend.graph.fixed[0]))
    estimate = backend.estimate()
    assert held
    assert estimate.alignment is AlignmentState.ALIGNED
    assert not np.any(backend.graph.fixed)
    assert backend.graph.n_nodes - estimate.n_biases <= 115
    assert np.linalg.norm(estimate.T_map_base[:2] - truth[-2][:2]) < 2.0
    # a frozen path is that of odometry, in one piece
    steps = se2.between(estimate.path.poses[:-2], estimate.path.poses[1:-1])
    assert np.max(np.hypot(steps[:, 0] - 1.0, steps[:, 1])) < 0.7


def test_a_closure_that_waits_holds_its_node_but_not_for_ever() -> None:
    events, _ = drive(N, closures=0)
    backend = PoseGraphBackend(BackendConfig(window=WindowConfig(nodes=40)))
    held = []
    for number, event in enumerate(events):
        if number == 120:   # waits for a stamp that odometry does not reach
            add(backend, ('loop_closure', LoopClosure(
                stamp_of(5000), np.zeros(3), np.eye(3), reference_ns=event[1].stamp_ns)))
        add(backend, event)
        if number % 12 == 11:
            backend.update()
            held.append(len(backend._nodes) - backend._nodes.n_frozen)
    assert max(held) >= 75
    assert max(held) <= 85
    assert held[-1] <= 45
