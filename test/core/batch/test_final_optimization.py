# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robust losses: the minimum of the robust cost, the influence of outliers, failures."""

from collections.abc import Sequence

import numpy as np
import pytest
from random_graphs import snapshot
from scipy.optimize import minimize

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import BatchResult, Status
from pose_graph_ros.core.config import (
    BackendConfig,
    Loss,
    MeasurementSource,
    OdometrySource,
    SolverConfig,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import factors
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.reweighting import costs_and_weights
from pose_graph_ros.core.measurements import (
    GlobalPose,
    LoopClosure,
    Measurement,
    OdometrySample,
    Position,
)

SECOND = 1_000_000_000
ENDING = (Loss.TUKEY, Loss.TRUNCATED)
ROBUST = [loss for loss in Loss if loss is not Loss.NONE]


# --- A drive with fixes ----------------------------------------------------------------------

N = 60


def drive(
    seed: int, outliers: Sequence[int] = (), off: float = 20.0, n: int = N,
) -> tuple[list[OdometrySample], list[Measurement], FloatArray]:
    """Return odometry of a circle at 1 m/s, measurements with a fix per second, and the truth."""
    rng = np.random.default_rng(seed)
    step = np.array([1.0, 0.0, 0.1])
    pose, odometry, truth, fixes = np.zeros(3), [], [np.array([5.0, -3.0, 1.0])], []
    for k in range(n):
        stamp = (k + 1) * SECOND
        odometry.append(OdometrySample(stamp, pose))
        pose = se2.compose(pose, step + rng.normal(0.0, [0.02, 0.01, 0.004]))
        where = truth[-1][:2] + rng.normal(0.0, 0.3, 2)
        if k in outliers:
            angle = rng.uniform(-np.pi, np.pi)
            where = where + off * np.array([np.cos(angle), np.sin(angle)])
        fixes.append(Position(stamp, where, 0.09 * np.eye(2), np.zeros(2)))
        truth.append(se2.compose(truth[-1], step))
    first = GlobalPose(SECOND, truth[0], np.diag([0.01, 0.01, 1e-4]))
    return odometry, [first, *fixes], np.array(truth[:-1])


def config(loss: Loss, threshold: float = 3.0) -> BackendConfig:
    return BackendConfig(
        odometry={'odom': OdometrySource(reorder_window=0.0)},
        measurements={'fix': MeasurementSource(loss=loss, rejection_threshold=threshold),
                      'scan': MeasurementSource(loss=loss, rejection_threshold=threshold)})


def fed(
    backend: PoseGraphBackend, odometry: Sequence[OdometrySample],
    measurements: Sequence[Measurement], *, updates: bool = True,
) -> PoseGraphBackend:
    events = sorted([*odometry, *measurements], key=lambda event: event.stamp_ns)
    for event in events:
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
        else:
            source = {GlobalPose: 'pose', Position: 'fix', LoopClosure: 'scan'}[type(event)]
            backend.add_measurement(event, source)
        if updates:
            assert backend.update().status is not Status.FAILED
    return backend


def rms(backend: PoseGraphBackend, truth: FloatArray) -> float:
    off = backend.graph.poses[:, :2] - truth[:backend.graph.n_nodes, :2]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def robust_cost(backend: PoseGraphBackend, loss: Loss, threshold: float,
                poses: FloatArray) -> float:
    """Sum up rho over the fixes and plain energies over the rest."""
    edges, observed = backend.graph.factors.edges, backend.graph.factors.observed
    fixes = factors.energies(
        factors.errors(poses, observed), observed.information)
    rest = factors.energies(factors.errors(poses, edges), edges.information)
    has_loss = observed.kind == FactorKind.POSITION
    return float(np.sum(rest) + np.sum(fixes[~has_loss])
                 + np.sum(costs_and_weights(loss, fixes[has_loss], threshold)[0]))


@pytest.mark.parametrize(('loss', 'seed'), [
    *((loss, 0) for loss in ROBUST), (Loss.HUBER, 1)])
def test_the_minimum_is_that_of_the_robust_cost(loss: Loss, seed: int) -> None:
    threshold = 1.5
    odometry, measurements, _ = drive(seed, outliers=(3, 7), off=3.0, n=11)
    backend = fed(PoseGraphBackend(config(loss, threshold)), odometry, measurements)
    report = backend.optimize()
    assert report.status is Status.CONVERGED
    poses = backend.graph.poses.copy()

    def cost(flat: FloatArray) -> float:
        return robust_cost(backend, loss, threshold, flat.reshape(-1, 3))

    assert report.chi2 == pytest.approx(cost(poses.ravel()), rel=1e-9)
    assert backend.estimate().chi2 == report.chi2
    found = minimize(cost, poses.ravel() + np.random.default_rng(seed).normal(
        0.0, 0.02, poses.size), method='BFGS', options={'gtol': 1e-6, 'maxiter': 2000})
    assert report.chi2 <= found.fun * (1.0 + 1e-9)
    np.testing.assert_allclose(poses[:, :2], found.x.reshape(-1, 3)[:, :2], atol=1e-4)
    weights = backend.graph.factors.observed.weight
    assert weights[4] < 0.5     # row 0 is the global pose, so row 4 is fix 3
    assert weights[0] == 1.0


def test_fixes_with_small_weights_regain_them_when_more_fixes_agree() -> None:
    # an accurate but wrong pose at the start: the fixes look like outliers until they are many
    cauchy = MeasurementSource(loss=Loss.CAUCHY)
    backend = PoseGraphBackend(BackendConfig(
        odometry={'odom': OdometrySource(reorder_window=0.0)},
        measurements={'pose': cauchy, 'fix': cauchy}))
    first, weights = GlobalPose(SECOND, np.zeros(3), np.diag([0.01, 0.01, 1e-4])), []
    for k in range(40):
        stamp, moved = (k + 1) * SECOND, np.array([1.0 * k, 0.0, 0.0])
        backend.add_odometry(OdometrySample(stamp, moved))
        if k == 0:
            backend.add_measurement(first, 'pose')
        backend.add_measurement(
            Position(stamp, np.add(moved[:2], [0.0, 6.0]), 0.09 * np.eye(2), np.zeros(2)), 'fix')
        backend.update()
        weights.append(backend.graph.factors.observed.weight[:3])
    assert weights[2][0] > 0.9      # the pose
    assert weights[2][1] < 0.1      # the first fix
    assert weights[-1][0] < 0.1
    assert weights[-1][1] > 0.9
    assert backend.estimate().T_map_base[1] == pytest.approx(6.0, abs=0.1)
    backend.optimize()
    assert backend.estimate().T_map_base[1] == pytest.approx(6.0, abs=0.1)


@pytest.mark.parametrize('loss', ROBUST)
def test_a_wrong_loop_closure_gets_a_small_weight(loss: Loss) -> None:
    odometry, measurements, truth = drive(8, n=130)
    scans = [LoopClosure(
        (k + 64) * SECOND, se2.between(truth[k], truth[k + 63]), np.diag([0.01, 0.01, 1e-4]),
        reference_ns=(k + 1) * SECOND) for k in range(2, 60, 6)]
    wrong = LoopClosure(
        90 * SECOND, np.array([8.0, 5.0, 2.0]), np.diag([0.01, 0.01, 1e-4]),
        reference_ns=20 * SECOND)
    backend = fed(PoseGraphBackend(config(loss)), odometry, [*measurements, *scans, wrong])
    backend.optimize()
    edges = backend.graph.factors.edges
    closures = np.flatnonzero(edges.kind == 1)
    lost = closures[np.argmin(edges.weight[closures])]
    assert (edges.i[lost], edges.j[lost]) == (19, 89)
    assert edges.weight[lost] < 0.05
    assert np.min(edges.weight[closures[closures != lost]]) > 0.5
    if loss is Loss.CAUCHY:
        assert rms(backend, truth) < 0.3


# --- Failures --------------------------------------------------------------------------------

class Failing:
    """A solver that changes the poses and fails at its n-th call."""

    def __init__(self, last: int, *, raises: bool) -> None:
        self.left, self.raises, self.optimize = last, raises, optimizer.optimize

    def __call__(self, graph: Graph, settings: SolverConfig) -> BatchResult:
        self.left -= 1
        if self.left > 0:
            return self.optimize(graph, settings)
        graph.set_poses(graph.poses + 17.0)
        if self.raises:
            raise ValueError('broken on purpose')
        return BatchResult(Status.FAILED, 'broken on purpose', 0, 1.0)


@pytest.mark.parametrize('raises', [False, True])
@pytest.mark.parametrize('last', [1, 3])
def test_a_failed_optimisation_leaves_weights_and_poses_to_the_bit(
    last: int, monkeypatch: pytest.MonkeyPatch, *, raises: bool,
) -> None:
    odometry, measurements, _ = drive(9, outliers=(5, 20, 40))
    solve = Failing(last, raises=raises)
    backend = fed(PoseGraphBackend(config(Loss.CAUCHY)), odometry, measurements)
    monkeypatch.setattr(optimizer, 'optimize', solve)
    before, weights = snapshot(backend.graph), backend.graph.factors.observed.weight
    poses, estimate = backend.graph.poses.copy(), backend.estimate()
    assert np.min(weights) < 0.1
    report = backend.optimize()
    assert report.status is Status.FAILED
    assert snapshot(backend.graph) == before
    np.testing.assert_array_equal(backend.graph.factors.observed.weight, weights)
    np.testing.assert_array_equal(backend.graph.poses, poses)
    np.testing.assert_array_equal(backend.estimate().path.poses, estimate.path.poses)
    solve.left = 10**9
    assert backend.optimize().status is Status.CONVERGED


@pytest.mark.parametrize('loss', ENDING)
def test_a_loss_that_takes_all_weight_away_fails_no_update(loss: Loss) -> None:
    # two poses that contradict each other by far: in between, neither has a weight
    source = MeasurementSource(loss=loss)
    backend = PoseGraphBackend(BackendConfig(
        odometry={'odom': OdometrySource(reorder_window=0.0)}, measurements={'pose': source}))
    for k in range(8):
        stamp = (k + 1) * SECOND
        backend.add_odometry(OdometrySample(stamp, np.array([1.5 * k, 0.0, 0.0])))
        if k in (0, 7):
            backend.add_measurement(GlobalPose(
                stamp, np.array([150.0 * k, 0.0, 0.0]), np.diag([0.01, 0.01, 1e-4])), 'pose')
        assert backend.update().status is not Status.FAILED
        backend.refine()
    assert backend.optimize().status is not Status.FAILED
    assert np.all(np.isfinite(backend.graph.poses))
    # better ones decide
    for k in range(8, 16):
        stamp, pose = (k + 1) * SECOND, np.array([1.5 * k, 0.0, 0.0])
        backend.add_odometry(OdometrySample(stamp, pose))
        backend.add_measurement(GlobalPose(stamp, pose, np.diag([0.01, 0.01, 1e-4])), 'pose')
        assert backend.update().status is not Status.FAILED
    assert backend.optimize().status is Status.CONVERGED
    assert backend.graph.factors.observed.weight.tolist() == [
        pytest.approx(1.0, abs=1e-3), 0.0, *[pytest.approx(1.0, abs=1e-3)] * 8]
    np.testing.assert_allclose(backend.graph.poses[-1], [22.5, 0.0, 0.0], atol=1e-3)
