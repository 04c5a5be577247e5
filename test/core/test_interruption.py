# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is interrupted by another thread leaves everything as it was, and nothing is lost."""

from collections.abc import Iterator
from contextlib import contextmanager
import threading
import time

from hypothesis import event, example, given, settings, strategies as st
import numpy as np
from random_graphs import snapshot
from slow_smoother import state

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, OdometrySource, SmootherConfig
from pose_graph_ros.core.exceptions import INTERRUPTED
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.measurements import GlobalPose, LoopClosure, OdometrySample
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

SECOND = 1_000_000_000
NAMES = 'pose', 'loop_closure'


def drive(n: int, seed: int = 0) -> tuple[PoseGraphBackend, np.ndarray]:
    """Return an engine after n nodes on a circle of 100 m, and the true path."""
    rng, backend = np.random.default_rng(seed), PoseGraphBackend(BackendConfig(
        odometry={'odom': OdometrySource(reorder_window=0.0)}))
    step = np.array([1.0, 0.0, 2.0 * np.pi / 100.0])
    true, odometry = [np.zeros(3)], [np.zeros(3)]
    for _ in range(n - 1):
        true.append(se2.compose(true[-1], step))
        odometry.append(se2.compose(odometry[-1], step + rng.normal(0.0, (0.02, 0.02, 0.005))))
    for k, pose in enumerate(odometry):
        backend.add_odometry(OdometrySample((k + 1) * SECOND, pose))
    return backend, np.array(true)


def measure(backend: PoseGraphBackend, true: np.ndarray, first: int, last: int) -> None:
    """Add a pose in the map at some nodes, and a closure to the lap before."""
    for k in range(first, last, 5):
        backend.add_measurement(GlobalPose((k + 1) * SECOND, true[k], 0.01 * np.eye(3)), 'pose')
        if k >= 100:
            backend.add_measurement(LoopClosure(
                (k + 1) * SECOND, se2.between(true[k - 100], true[k]), 0.01 * np.eye(3),
                reference_ns=(k - 99) * SECOND), 'loop_closure')


def held(backend: PoseGraphBackend) -> tuple[list[int], int]:
    """Return the stamps of the measurements in the map, and the number of closures."""
    kinds = backend.graph.factor_records['kind']
    return (np.sort(backend.measured()['pose']).tolist(),
            int(np.sum(kinds == FactorKind.LOOP_CLOSURE)))


@contextmanager
def interrupted(smoother: IncrementalSmoother, after: int) -> Iterator[None]:
    """Let another thread interrupt everything once so many cliques were eliminated."""
    head, ended = smoother.graph.memory.head, threading.Event()
    end = head[tb.FRONT_SERIAL] + after

    def watch() -> None:
        while head[tb.FRONT_SERIAL] < end and not ended.is_set():
            time.sleep(0.0)
        smoother.interrupt(tb.ALL)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        smoother.interrupt(tb.ALL, on=False)


@settings(deadline=None, max_examples=20)
@given(after=st.integers(0, 1500), seed=st.integers(0, 2**32 - 1))
def test_an_update_that_is_interrupted_at_any_clique_changes_nothing(
    after: int, seed: int,
) -> None:
    rng, n = np.random.default_rng(seed), 600
    path = np.cumsum(rng.normal((1.0, 0.0, 0.0), (0.1, 0.1, 0.1), (n, 3)), axis=0)
    chain = Factors(np.arange(n - 1), np.arange(1, n), se2.between(path[:-1], path[1:]),
                    np.tile(100.0 * np.eye(3), (n - 1, 1, 1)), [FactorKind.ODOMETRY] * (n - 1))
    i, j = np.arange(0, n // 2, 10), n - 1 - np.arange(0, n // 2, 10)
    closures = Factors(i, j, se2.between(path[i], path[j]) + rng.normal(0.0, 0.3, (len(i), 3)),
                       np.tile(np.eye(3), (len(i), 1, 1)), [FactorKind.LOOP_CLOSURE] * len(i))
    smoother, undisturbed = (IncrementalSmoother(SmootherConfig()) for _ in range(2))
    for each in (smoother, undisturbed):
        each.update(GraphUpdate(hidden=path, fix=[0], factors=chain))
    before, update = state(smoother.graph), GraphUpdate(factors=closures)
    with interrupted(smoother, after):
        result = smoother.update(update)
    event(result.reason)
    if result.status is not Status.FAILED:
        return
    assert result.reason == INTERRUPTED
    assert state(smoother.graph) == before
    assert smoother.update(update) == undisturbed.update(update)
    assert state(smoother.graph) == state(undisturbed.graph)


@settings(deadline=None, max_examples=8)
@example(after=[0, 100])
@given(after=st.lists(st.integers(0, 200), min_size=1, max_size=4))
def test_measurements_of_interrupted_updates_are_in_the_graph_after_later_ones(
    after: list[int],
) -> None:
    (backend, true), (undisturbed, _) = drive(160), drive(160)
    for engine in (backend, undisturbed):
        measure(engine, true, 0, 160)
    for count in after:
        before, path = snapshot(backend.graph), backend.estimate().path.poses
        with interrupted(backend.parts.smoother, count):
            report = backend.update()
        event(report.reason)
        if report.reason == INTERRUPTED:
            assert snapshot(backend.graph) == before
            np.testing.assert_array_equal(backend.estimate().path.poses, path)
    for _ in range(12):
        backend.update()
    assert len(backend.parts.pipeline.queue) == 0
    for engine in (backend, undisturbed):
        assert engine.optimize().status is Status.CONVERGED
    assert backend.n_quarantined == 0
    assert held(backend) == held(undisturbed)
    np.testing.assert_allclose(
        backend.estimate().path.poses, undisturbed.estimate().path.poses, atol=1e-6)


def test_what_takes_too_long_alone_is_set_aside_until_a_full_optimisation() -> None:
    backend, true = drive(150)
    measure(backend, true, 0, 10)
    backend.update()
    measure(backend, true, 50, 65)
    waiting = backend.parts.pipeline.queue.copy()
    for n_set_aside, patience in ((0, 2), (1, 3), (2, 4)):
        backend.interrupt(tb.ALL)
        assert backend.update().reason == INTERRUPTED
        backend.interrupt(tb.ALL, on=False)
        assert backend.parts.quarantine == waiting[:n_set_aside]
        assert backend.parts.pipeline.queue == waiting[n_set_aside:]
        assert 1 + backend.n_interrupted == patience
    assert backend.update().new_constraints == 1
    assert backend.n_interrupted == 0
    assert backend.optimize().status is Status.CONVERGED
    assert backend.n_quarantined == 0
    assert len(held(backend)[0]) == 5


@settings(deadline=None, max_examples=8)
@given(after=st.floats(0.0, 0.3))
def test_an_optimisation_that_is_interrupted_at_any_time_leaves_the_path_and_the_queue(
    after: float,
) -> None:
    backend, true = drive(200)
    measure(backend, true, 0, 170)
    backend.optimize()
    path = backend.estimate().path.poses
    # far off, but a person says that it is right
    backend.add_measurement(LoopClosure(
        180 * SECOND, np.array([5.0, 5.0, 1.0]), 0.01 * np.eye(3), reference_ns=80 * SECOND),
        'loop_closure')
    backend.update()
    before = backend.estimate().path.poses
    timer = threading.Timer(after, backend.interrupt, (tb.ALL,))
    timer.start()
    report = backend.optimize()
    timer.join()
    backend.interrupt(tb.ALL, on=False)
    event(report.reason)
    if report.status is Status.FAILED:
        assert report.reason == INTERRUPTED
        np.testing.assert_array_equal(backend.estimate().path.poses, before)
    assert backend.optimize().status is Status.CONVERGED
    np.testing.assert_allclose(backend.estimate().path.poses, path, atol=1e-6)
