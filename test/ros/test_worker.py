# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The worker's thread: everything posted is processed, whatever the engine does."""

from collections.abc import Callable, Iterator
import threading
import time

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, OdometrySource, SmootherConfig
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.measurements import Answer, GlobalPose, OdometrySample
from pose_graph_ros.core.smoother.incremental import Refinement
from pose_graph_ros.ros.worker import Worker

Start = Callable[..., Worker]
PATIENCE = 60.0
"""How long a test waits for what comes at once, but for compilations or a busy machine [s]."""


def wait_until(done: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < end, f'waited {PATIENCE} s'
        time.sleep(0.002)


@pytest.fixture
def start() -> Iterator[Start]:
    """Return what starts a worker, which ends with the test."""
    workers: list[Worker] = []

    def made(backend: PoseGraphBackend | None = None, **given: object) -> Worker:
        worker = Worker(backend or PoseGraphBackend(), **{'on_estimate': lambda _: None} | given)
        workers.append(worker)
        worker.thread.start()
        return worker
    yield made
    assert all(worker.stop(PATIENCE) for worker in workers)


def sample(step: int) -> OdometrySample:
    return OdometrySample(step * 100_000_000, np.array([0.3 * step, 0.0, 0.0]))


def test_all_that_is_posted_is_processed_and_one_estimate_follows_the_other(start: Start) -> None:
    estimates: list[Estimate] = []
    worker = start(on_estimate=lambda backend: estimates.append(backend.estimate()))
    for step in range(1, 101):
        assert worker.post('odom', sample(step))
        worker.post('pose', GlobalPose(step * 100_000_000, np.array([0.3 * step, 0.0, 0.0]),
                                       0.01 * np.eye(3)))
        worker.request_update()
    report = worker.call(worker.optimize_fully).result(PATIENCE)
    assert report.status is Status.CONVERGED
    assert worker.is_optimal
    wait_until(lambda: worker.status.processed == 200)
    assert worker.status.counts['pose', 'accepted'] == 100
    assert worker.estimate.stamp_ns == estimates[-1].stamp_ns
    assert worker.estimate.n_observed == 100


def test_posting_never_waits_for_the_solver(
    start: Start, monkeypatch: pytest.MonkeyPatch,
) -> None:
    solving, release = threading.Event(), threading.Event()
    optimize = optimizer.optimize

    def solve(*arguments: object) -> object:
        solving.set()
        assert release.wait(PATIENCE)
        return optimize(*arguments)

    monkeypatch.setattr(optimizer, 'optimize', solve)
    worker = start(PoseGraphBackend())
    for step in range(1, 20):
        worker.post('odom', sample(step))
    closing = worker.call(worker.optimize_fully)
    assert solving.wait(PATIENCE)
    for step in range(20, 40):
        worker.post('odom', sample(step))
    assert not closing.done()
    release.set()
    assert closing.result(PATIENCE).status is Status.CONVERGED
    wait_until(lambda: worker.status.processed == 39)


def test_what_a_worker_that_is_stopped_has_not_taken_is_left(
    start: Start, monkeypatch: pytest.MonkeyPatch,
) -> None:
    backend = PoseGraphBackend()
    add, started, release = backend.add_odometry, threading.Event(), threading.Event()

    def wait(*given: object) -> Answer:
        started.set()
        assert release.wait(PATIENCE)
        return add(*given)

    monkeypatch.setattr(backend, 'add_odometry', wait)
    worker = start(backend)
    with worker._condition:     # so that one batch has them
        for step in range(1, 11):
            worker.post('odom', sample(step))
    assert started.wait(PATIENCE)
    worker.post('odom', sample(11))     # for the next batch
    assert not worker.stop(0.0)
    release.set()
    assert worker.stop(PATIENCE)
    assert backend.estimate() is None
    left, rest = worker.rest()
    assert left is backend
    assert [each.stamp_ns for _, each in rest] == [sample(step).stamp_ns for step in range(2, 12)]


def test_a_preparation_that_fails_or_is_stopped_does_not_hold_the_worker(start: Start) -> None:
    def fail(stopped: Callable[[], bool]) -> None:
        raise OSError('no space')

    worker = start(prepare=fail)
    worker.post('odom', sample(1))
    wait_until(lambda: worker.status.processed == 1)
    assert worker.prepared
    start(prepare=wait_until)


def test_a_job_that_fails_is_answered_logged_and_counted(
    start: Start, caplog: pytest.LogCaptureFixture,
) -> None:
    def fail(error: Exception) -> Callable[[PoseGraphBackend], None]:
        def job(_: PoseGraphBackend) -> None:
            raise error
        return job

    worker = start()
    broken = worker.call(fail(ZeroDivisionError('broken')), 'the markers')
    refused = worker.call(fail(FileFormatError('no graph')), 'a copy of the graph')
    assert isinstance(broken.exception(PATIENCE), ZeroDivisionError)
    assert isinstance(refused.exception(PATIENCE), FileFormatError)
    wait_until(lambda: len(worker.status.counts) == 2)
    assert worker.status.counts == {('worker', 'internal_error'): 1, ('worker', 'refused_job'): 1}
    first, second = caplog.records
    assert first.getMessage() == 'the markers failed'
    assert first.exc_info is not None
    assert second.getMessage() == 'a copy of the graph: no graph'
    assert second.exc_info is None
    assert worker.call(lambda _: 3).result(PATIENCE) == 3


def test_nothing_is_begun_after_the_worker_was_stopped(start: Start) -> None:
    running, release, begun = threading.Event(), threading.Event(), []

    class Slow(PoseGraphBackend):
        def add_odometry(self, added: OdometrySample, source: str = 'odom') -> Answer:
            begun.append(added)
            running.set()
            assert release.wait(PATIENCE)
            return super().add_odometry(added, source)

    worker = Worker(Slow(), lambda _: begun.append('an estimate'))
    # before the thread starts, so that it takes all of them at once
    for step in range(1, 50):
        worker.post('odom', sample(step))
    worker.request_update()
    job = worker.call(begun.append)
    worker.thread.start()
    assert running.wait(PATIENCE)
    assert not worker.stop(0.0)
    release.set()
    assert worker.stop(PATIENCE)
    assert len(begun) == 1
    assert job.cancelled()


class Recording(PoseGraphBackend):
    """A back end that keeps what its refinement has returned."""

    def __init__(self, config: BackendConfig) -> None:
        super().__init__(config)
        self.refinements: list[Refinement] = []

    def refine(self) -> Refinement:
        self.refinements.append(super().refine())
        return self.refinements[-1]


def test_between_updates_the_estimate_is_refined_until_nothing_is_left(start: Start) -> None:
    rng, estimates = np.random.default_rng(1), []
    backend = Recording(BackendConfig(
        odometry={'odom': OdometrySource(reorder_window=0.0)},
        smoother=SmootherConfig(alpha=1.0, budget=1.0, budget_share=1.0)))
    worker = start(backend, on_estimate=lambda backend: estimates.append(backend.estimate()))
    for step in range(1, 200):
        worker.post('odom', sample(step))
        if step % 10 == 0:
            worker.post('pose', GlobalPose(step * 100_000_000, np.array(
                [0.3 * step, 0.0, 0.0]) + 0.3 * rng.normal(size=3), 0.01 * np.eye(3)))
    worker.request_update()
    wait_until(lambda: len(backend.refinements) > 0 and backend.refinements[-1].finished)
    assert not worker.is_optimal
    path = worker.call(lambda backend: backend.estimate().path).result(PATIENCE)
    assert sum(refinement.moved for refinement in backend.refinements) > 0.001
    np.testing.assert_allclose(estimates[-1].path.poses, path.poses, atol=0.002)
    n = len(backend.refinements)
    time.sleep(0.05)
    assert len(backend.refinements) == n    # the thread sleeps
    worker.call(worker.optimize_fully).result(PATIENCE)
    np.testing.assert_allclose(estimates[-1].path.poses, path.poses, atol=0.001)


def test_where_updates_follow_one_another_it_is_refined_now_and_then(
    start: Start, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr('pose_graph_ros.ros.worker.PAUSE', 0.3)
    backend = Recording(BackendConfig(odometry={'odom': OdometrySource(reorder_window=0.0)}))
    worker = start(backend)

    def is_refined(n: int) -> bool:
        return sum(refinement.finished for refinement in backend.refinements) >= n

    for step in range(1, 3):    # the first one at once
        worker.post('odom', sample(step))
        worker.post('pose', GlobalPose(
            step * 100_000_000, np.array([0.3 * step, 0.0, 0.0]), 0.01 * np.eye(3)))
        begin = time.monotonic()
        worker.request_update()
        wait_until(lambda step=step: is_refined(step))
    assert time.monotonic() - begin > 0.25
    wait_until(lambda: worker.status.verdicts['pose'].counts[State.BELIEVED] == 2)
