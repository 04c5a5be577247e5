# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Residuals by source and their covariances, against dense matrices by finite differences."""

from honest_drive import HonestDrive
import numpy as np
import pytest

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.cli.replay import run
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.offline.variance_components import analyse

STEP = 1e-6


def engine(correlation_time: float, seed: int = 1, **settings: float) -> PoseGraphBackend:
    drive = HonestDrive(seed, seconds=60.0, closures=4, fix_period=2.0, **settings)
    backend, report, *_ = run(drive.measurements(), checked(
        {'global_pose.correlation_time': correlation_time, 'global_pose.robust_loss': 'none'}))
    assert report.status.value == 'converged'
    return backend


def stacked_errors(graph: Graph, poses: FloatArray) -> FloatArray:
    """Return all errors, shape (M, 3)."""
    return graph.errors(graph.factors, poses)


def dense(graph: Graph) -> tuple[FloatArray, FloatArray]:
    """Return the Jacobians of all errors, shape (M, 3, 3 N), and the covariance of all nodes."""
    poses = graph.poses.copy()
    n = poses.size
    jacobian = np.empty((graph.n_factors, 3, n))
    for k in range(n):
        ahead, behind = poses.copy(), poses.copy()
        ahead.flat[k] += STEP
        behind.flat[k] -= STEP
        change = stacked_errors(graph, ahead) - stacked_errors(graph, behind)
        change[:, 2] = se2.wrap(change[:, 2])
        jacobian[:, :, k] = change / (2.0 * STEP)
    information = graph.factors.weighted_information
    hessian = np.einsum('mia,mij,mjb->ab', jacobian, information, jacobian)
    free = np.repeat(~graph.fixed, 3)
    covariance = np.zeros((n, n))
    covariance[np.ix_(free, free)] = np.linalg.inv(hessian[np.ix_(free, free)])
    return jacobian, covariance


def test_what_the_fit_takes_is_that_of_dense_matrices() -> None:
    backend = engine(0.0)
    graph = backend.graph
    jacobian, covariance = dense(graph)
    taken = np.einsum('mia,ab,mjb->mij', jacobian, covariance, jacobian)
    found = {source: each.residuals for source, each in analyse(backend.parts).items()}
    assert {source: each.kind for source, each in found.items()} == {
        'global_pose': 'map', 'odom': 'odometry', 'loop_closure': 'loop_closure'}
    for each in found.values():
        rows = graph.factor_rows(each.ids)
        both = each.measured[:, :, None] & each.measured[:, None, :]
        # positions are in map axes in both
        np.testing.assert_allclose(np.where(both, each.taken, 0.0),
                                   np.where(both, taken[rows], 0.0), rtol=1e-4, atol=1e-9)
        errors = stacked_errors(graph, graph.poses)[rows]
        np.testing.assert_allclose(each.errors, errors * each.measured, atol=1e-12)
        assert np.all(np.diff(each.stamps_ns) >= 0)
    # the redundancies of all add up to the degrees of freedom
    total = sum(float(np.sum(each.redundancies)) for each in found.values())
    measured = sum(int(np.sum(each.measured)) for each in found.values())
    assert total == pytest.approx(measured - 3 * np.sum(~graph.fixed), rel=1e-3)


def test_of_correlated_errors_the_whole_error_counts() -> None:
    backend = engine(20.0, tau=20.0)
    graph = backend.graph
    assert np.any(graph.is_bias)
    found = analyse(backend.parts)['global_pose'].residuals
    assert np.all(graph.factors_at(found.ids).j >= 0)
    assert np.all(found.measured == (True, True, False))
    # the error of a fix is its place less that of its node, whatever the bias explains
    edges = graph.factors_at(found.ids)
    nodes = graph.poses_of(edges.i)
    offsets = np.einsum('kij,kj->ki', se2.rotation(nodes[:, 2]), edges.constants[:, :2])
    np.testing.assert_allclose(
        found.errors[:, :2], edges.mean[:, :2] - nodes[:, :2] - offsets, atol=1e-9)
    # its covariance that of the fix, and of the motion since the node
    assert np.all(found.covariances[:, [0, 1], [0, 1]] > 0.5**2 * 0.99)
    assert np.all(found.covariances[:, [0, 1], [0, 1]] < 0.5**2 + 0.05)
    # what the fit takes is the covariance of the node at the arm of the fix
    _, covariance = dense(graph)
    for k in range(0, len(found.ids), 13):
        row = 3 * int(graph.node_rows(edges.i[k]))
        arm = np.array(((1.0, 0.0, -offsets[k, 1]), (0.0, 1.0, offsets[k, 0])))
        np.testing.assert_allclose(
            found.taken[k, :2, :2],
            arm @ covariance[row:row + 3, row:row + 3] @ arm.T, rtol=1e-3)


def test_the_energies_of_honest_measurements_are_as_expected() -> None:
    """Chi-square calibration: the sum over drives is within four standard deviations."""
    sums: dict[str, list[tuple[float, float]]] = {}
    for seed in range(8):
        for source, found in analyse(engine(0.0, seed).parts).items():
            each = found.residuals
            sums.setdefault(source, []).append(
                (float(np.sum(each.energies)), float(np.sum(each.redundancies))))
    for source, pairs in sums.items():
        energy, expected = np.sum(pairs, axis=0)
        assert abs(energy - expected) < 4.0 * np.sqrt(2.0 * expected), source
