# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Between two updates the back end reaches the optimum, also with robust losses, and stops."""

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import BackendConfig, Loss, MeasurementSource, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.measurements import GlobalPose, LoopClosure, OdometrySample

SECOND = 1_000_000_000
STEP = np.array([1.0, 0.0, 2.0 * np.pi / 60])


def config(loss: Loss) -> BackendConfig:
    source = MeasurementSource(loss=loss, rejection_threshold=1.5)
    return BackendConfig(odometry={'odom': OdometrySource(reorder_window=0.0)},
                         measurements={'pose': source, 'closure': source})


def drive(backend: PoseGraphBackend, *, refine: bool, n: int = 240) -> None:
    """Drive four laps with drift; one in six of the poses and closures is wrong."""
    rng, truth, odometry = np.random.default_rng(4), np.zeros(3), np.zeros(3)
    for k in range(n):
        backend.add_odometry(OdometrySample((k + 1) * SECOND, odometry))
        wrong = rng.normal(size=3) * [1.0, 1.0, 0.1] * (rng.random() < 0.16)
        noise = rng.normal(size=3) * [0.2, 0.2, 0.05]
        if k == 0 or k % 40 == 0:
            backend.add_measurement(GlobalPose(
                (k + 1) * SECOND, truth + (noise + wrong) * (k > 0),
                np.diag([0.04, 0.04, 0.0025])), 'pose')
        elif k >= 60 and k % 3 == 0:
            backend.add_measurement(LoopClosure(
                (k + 1) * SECOND, noise + wrong, np.diag([0.04, 0.04, 0.0025]),
                reference_node=k - 60), 'closure')
        backend.update()
        if refine:
            refined(backend)
        truth = se2.compose(truth, STEP)
        odometry = se2.compose(odometry, STEP + rng.normal(size=3) * [0.02, 0.02, 0.01])


def refined(backend: PoseGraphBackend) -> float:
    """Refine a back end to the end; return the sum of the moves [m]."""
    moved = 0.0
    for _ in range(1000):
        result = backend.refine()
        moved += result.moved
        if result.finished:
            return moved
    raise AssertionError('the refinement does not end')


# those that take weight away again have other minima, which a full optimisation may find
@pytest.mark.parametrize('loss', [Loss.NONE, Loss.HUBER, Loss.CAUCHY])
def test_a_full_optimisation_moves_a_refined_path_by_below_a_millimetre(loss: Loss) -> None:
    backend = PoseGraphBackend(config(loss))
    drive(backend, refine=False)
    backend.finish()
    backend.update()
    rough = backend.graph.poses.copy()
    assert refined(backend) > 0.0
    before = backend.graph.poses.copy()
    assert backend.update().new_constraints == 0
    np.testing.assert_array_equal(backend.graph.poses, before)
    report = backend.optimize()
    assert report.status is Status.CONVERGED
    moved, at_once = (np.max(np.abs(poses - backend.graph.poses)[:, :2])
                      for poses in (before, rough))
    assert moved < 1e-3
    assert moved < at_once


@pytest.mark.parametrize('loss', [Loss.NONE, Loss.HUBER])
def test_the_result_of_the_full_optimisation_does_not_depend_on_refinement(loss: Loss) -> None:
    plain, refining = PoseGraphBackend(config(loss)), PoseGraphBackend(config(loss))
    drive(plain, refine=False)
    drive(refining, refine=True)
    for backend in (plain, refining):
        backend.optimize()
    np.testing.assert_allclose(refining.graph.poses, plain.graph.poses, atol=1e-9)


def test_nothing_is_refined_before_an_update_nor_after_a_full_optimisation() -> None:
    backend = PoseGraphBackend(config(Loss.HUBER))
    assert backend.refine() == (True, 0.0)
    drive(backend, refine=True, n=100)
    assert backend.refine() == (True, 0.0)
    backend.optimize()
    poses = backend.graph.poses.copy()
    assert backend.refine() == (True, 0.0)
    np.testing.assert_array_equal(backend.graph.poses, poses)
