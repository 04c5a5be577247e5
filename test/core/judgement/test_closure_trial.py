# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an update leaves to the work after it: closures it diverges with, tests of large graphs."""


import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import (
    BackendConfig,
    NodePolicy,
    OdometryNoise,
    OdometrySource,
    SolverConfig,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement import closure_judge
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import Decision, State
from pose_graph_ros.core.measurements import LoopClosure, OdometrySample
from pose_graph_ros.core.smoother.covariances import Innovations
from pose_graph_ros.core.smoother.incremental import DIVERGED, IncrementalSmoother, UpdateResult
from pose_graph_ros.core.smoother.trial import Trial

SECOND = 10**9
COVARIANCE = np.square(np.diag([0.1, 0.1, 0.03]))
CONFIG = BackendConfig(
    nodes=NodePolicy(minimum_travel_distance=0.9),
    odometry={'odom': OdometrySource(OdometryNoise(sigma_heading_distance=0.1))})


class Counting(IncrementalSmoother):
    """Counts what it is asked for."""

    def __init__(self) -> None:
        super().__init__(CONFIG.smoother)
        self.solves = self.gates = self.diverged = self.fallbacks = 0

    def update(self, update: GraphUpdate, *, fall_back: bool = True) -> UpdateResult:
        result = super().update(update, fall_back=fall_back)
        self.solves += 1
        self.diverged += result.reason == DIVERGED
        return result

    def innovations(self, edges: Factors) -> Innovations:
        self.gates += len(edges)
        return super().innovations(edges)

    def _fall_back_to_batch(self, update: GraphUpdate) -> UpdateResult:
        self.fallbacks += 1
        return super()._fall_back_to_batch(update)


class Stuck(Counting):
    """One whose steps diverge with any other weights, as those of a graph that is bent do."""

    def __init__(self) -> None:
        super().__init__()
        self.is_stuck, self.trials = True, 0

    def update(self, update: GraphUpdate, *, fall_back: bool = True) -> UpdateResult:
        if self.is_stuck and not fall_back and len(update.weigh) > 0:
            self.diverged += 1
            return UpdateResult(Status.FAILED, DIVERGED, 0, 0, 0, 0)
        return super().update(update, fall_back=fall_back)

    def trial(self, update: GraphUpdate, poses: FloatArray | None = None) -> Trial:
        self.trials += 1
        return super().trial(update, poses)

    def adopt(self, trial: Trial) -> UpdateResult:
        if self.is_stuck:
            return UpdateResult(Status.FAILED, 'a test wants it to fail', 0, 0, 0, 0)
        return super().adopt(trial)


def driven(
    n: int, smoother: Counting | None = None,
) -> tuple[PoseGraphBackend, Counting, FloatArray]:
    """
    Return a back end with nodes along circles, its smoother and the poses.

    Parameters
    ----------
    n : int
    smoother : Counting, optional

    """
    smoother, poses = smoother or Counting(), np.zeros((n, 3))
    backend = PoseGraphBackend(CONFIG, smoother=smoother)
    for k in range(n):
        if k > 0:
            poses[k] = se2.compose(poses[k - 1], np.array([1.0, 0.0, 0.02]))
        backend.add_odometry(OdometrySample((k + 1) * SECOND, poses[k]))
    backend.finish()
    backend.update()
    smoother.solves = smoother.gates = 0
    return backend, smoother, poses


def add_group(backend: PoseGraphBackend, poses: FloatArray, place: FloatArray, count: int) -> None:
    """Add closures that agree with one another, the first from node 10 to its newer end."""
    first = len(poses) - 2 * count
    for k in range(count):
        i, j = 10 + 2 * k, first + 2 * k
        z = se2.between(poses[i], se2.compose(poses[10], se2.compose(
            place, se2.between(poses[first], poses[j]))))
        backend.add_measurement(LoopClosure(
            (j + 1) * SECOND, z, COVARIANCE, reference_ns=(i + 1) * SECOND), 'scan')


def work(backend: PoseGraphBackend) -> None:
    while not backend.refine().finished:
        pass


def states(backend: PoseGraphBackend) -> set[State]:
    return {each.state for each in backend.verdicts()}


def best_chi2(graph: Graph) -> float:
    copy = Graph()
    copy.fill(graph.rows())
    return optimizer.optimize_from_linear_start(copy, SolverConfig()).chi2


DIVERGING = np.array([20.0, 60.0, 2.0])


@pytest.mark.parametrize('in_update', [True, False])
def test_closures_that_an_update_diverges_with_are_believed_after_it(
    monkeypatch: pytest.MonkeyPatch, *, in_update: bool,
) -> None:
    monkeypatch.setattr(closure_judge, 'BELIEF', BELIEF._replace(large=600 if in_update else 500))
    backend, smoother, poses = driven(600)
    add_group(backend, poses, DIVERGING, 6)
    odometry = backend.graph.poses[-1].copy()
    backend.update()
    assert (smoother.diverged >= 1) == in_update
    np.testing.assert_allclose(backend.graph.poses[-1], odometry, atol=1e-6)
    work(backend)
    assert states(backend) == {State.BELIEVED}
    assert (smoother.diverged >= 1, smoother.fallbacks) == (True, 0)
    assert smoother.chi2() <= best_chi2(backend.graph) * (1.0 + 1e-6)


def test_what_comes_while_it_is_tried_is_kept() -> None:
    backend, smoother, poses = driven(600)
    add_group(backend, poses, DIVERGING, 6)
    backend.update()
    pose = poses[-1]
    for k in range(600, 700):
        pose = se2.compose(pose, np.array([1.0, 0.0, 0.02]))
        backend.add_odometry(OdometrySample((k + 1) * SECOND, pose))
        backend.update()
        backend.refine()
    backend.finish()
    backend.update()
    work(backend)
    assert states(backend) == {State.BELIEVED}
    assert (backend.graph.n_nodes, smoother.fallbacks) == (700, 0)
    assert smoother.chi2() <= best_chi2(backend.graph) * (1.0 + 1e-6)


def test_where_every_update_diverges_the_work_is_in_proportion_to_the_drive() -> None:
    smoother = Stuck()
    backend, _, poses = driven(600, smoother)
    for k in range(600, 1000):
        pose = se2.compose(poses[-1], np.array([1.0, 0.0, 0.02]))
        poses = np.concatenate((poses, pose[None]))
        backend.add_odometry(OdometrySample((k + 1) * SECOND, pose))
        if k % 10 == 0:
            place = se2.between(poses[10], poses[-6]) + np.array([0.5, 0.3, 0.01])
            add_group(backend, poses, place, 3)
            backend.update()
            work(backend)
    # without pauses, all that wait would be tried again after each update, and on a copy
    assert smoother.trials <= 8
    assert smoother.diverged <= 150     # of 120 closures
    assert State.BELIEVED not in states(backend)
    smoother.is_stuck = False
    for k in range(1000, 1400):
        pose = se2.compose(poses[-1], np.array([1.0, 0.0, 0.02]))
        poses = np.concatenate((poses, pose[None]))
        backend.add_odometry(OdometrySample((k + 1) * SECOND, pose))
    add_group(backend, poses, se2.between(poses[10], poses[-6]) + np.array([0.5, 0.3, 0.01]), 3)
    backend.update()
    work(backend)
    assert states(backend) == {State.BELIEVED}


def test_the_work_ends_where_the_graph_cannot_be_solved_without_what_does_not_fit() -> None:
    smoother = Stuck()
    smoother.is_stuck = False
    backend, _, poses = driven(600, smoother)
    place = se2.between(poses[10], poses[-12]) + np.array([0.5, 0.3, 0.01])
    add_group(backend, poses, place, 6)
    backend.update()
    work(backend)
    assert states(backend) == {State.BELIEVED}
    place = se2.between(poses[10], poses[-16]) + np.array([0.0, 8.0, 0.0])
    add_group(backend, poses, place, 8)
    smoother.is_stuck = True
    backend.update()
    # a person believes what contradicts them, and the update that throws them out diverges
    for number in range(6, 14):
        backend.decide(f'scan/{number}', Decision.IN)
    smoother.diverged = 0
    work(backend)
    assert 1 <= smoother.diverged <= 3
    assert [each.state for each in backend.verdicts()[:6]] == [State.BELIEVED] * 6
    assert backend.optimize().status is not Status.FAILED


@pytest.mark.parametrize('parts', [1, 8])
def test_a_person_who_decides_meanwhile_wins(parts: int) -> None:
    backend, _, poses = driven(600)
    add_group(backend, poses, DIVERGING, 6)
    backend.update()
    for _ in range(parts):
        backend.refine()
    for verdict in backend.verdicts():
        backend.decide(verdict.id, Decision.OUT)
    work(backend)
    assert states(backend) == {State.DOUBTED}
    assert best_chi2(backend.graph) < 1e-6


def test_an_update_of_a_large_graph_tests_nothing_and_its_work_a_bounded_number() -> None:
    backend, smoother, poses = driven(BELIEF.large + 200)
    place = se2.between(poses[10], poses[-200]) + np.array([0.5, 0.3, 0.01])
    add_group(backend, poses, place, 100)
    backend.update()
    assert (smoother.solves, smoother.gates) == (1, 0)
    assert states(backend) == {State.WAITING}
    finished, most = False, 0
    while not finished:
        smoother.solves = smoother.gates = 0
        finished = backend.refine().finished
        most = max(most, smoother.gates)
        assert smoother.solves <= 1
    assert 0 < most <= BELIEF.tests_in_part
    assert states(backend) == {State.BELIEVED}
