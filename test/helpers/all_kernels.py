# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A drive that calls every kernel of the engine, also those that only difficulties call."""

import numpy as np

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch import gauss_newton, optimizer
from pose_graph_ros.core.config import BackendConfig, SmootherConfig, SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.measurements import GlobalPose, LoopClosure, OdometrySample, Position

SECOND = 10**9


def call_all_kernels(n_samples: int, max_iterations: int = 10) -> None:
    """Drive in circles with measurements of all kinds, edit the graph, optimise in all ways."""
    rng = np.random.default_rng(0)
    backend = PoseGraphBackend(
        BackendConfig(smoother=SmootherConfig(max_iterations=max_iterations)))
    pose, truth = np.array([3.0, 1.0, 0.4]), [np.zeros(3)]
    step = np.array([1.0, 0.0, 2.0 * np.pi / 100])
    for k in range(n_samples):
        stamp = (k + 1) * SECOND
        backend.add_odometry(OdometrySample(stamp, pose))
        at = truth[-1]
        if k > 60 and k % 5 == 0:
            backend.add_measurement(Position(
                stamp, at[:2] + rng.normal(0.0, 0.5, 2), 0.25 * np.eye(2),
                np.array([0.3, 0.1])), 'fix')
        if k > 60 and k % 11 == 0:
            backend.add_measurement(GlobalPose(
                stamp - 30 * SECOND, truth[-31], 0.01 * np.eye(3)), 'late')
        if k > 110 and k % 17 == 0:
            backend.add_measurement(LoopClosure(
                stamp, se2.between(truth[-101], at), 0.01 * np.eye(3),
                reference_ns=stamp - 100 * SECOND), 'scan')
        if k == n_samples - 20:     # far off: the graph is optimised as a whole
            backend.add_measurement(GlobalPose(stamp, at + 500.0, 0.01 * np.eye(3)), 'outlier')
        pose = se2.compose(pose, step + rng.normal(0.0, (0.02, 0.01, 0.003)))
        truth.append(se2.compose(at, step))
        backend.update()
        backend.estimate()
    smoother = backend._smoother
    for update in (
            GraphUpdate(remove=(50,)), GraphUpdate(),
            GraphUpdate(weigh={3: 0.1, 17: 2.0}),
            GraphUpdate(fix=(7,)), GraphUpdate(free=(7,)), GraphUpdate(remove=(4,))):
        smoother.update(update)
    smoother.covariances()
    smoother.covariance(30)
    smoother.joint_covariance(5, n_samples - 30)
    assert smoother.update(GraphUpdate(hidden=np.zeros((1, 3)))).status is optimizer.Status.FAILED
    backend.view()
    backend.optimize()
    backend.update()
    backend.saved()
    graph = backend.graph
    optimizer.optimize_from_linear_start(graph, SolverConfig())
    # the optimiser calls these only if it stalls or takes many iterations
    gauss_newton.step(graph.memory.head, np.zeros((graph.n_nodes, 3)), True)
