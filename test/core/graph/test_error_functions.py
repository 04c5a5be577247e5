# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors and Jacobians against g2o's definition, central differences and three footnotes."""

from itertools import pairwise

from hypothesis import given, strategies as st
import jacobians
import numpy as np
import pytest
from random_graphs import (
    matrix,
    random_edges,
    random_information,
    random_observed,
    random_poses,
    slow_edge,
    slow_observed,
    vector,
)
from sparse_system import LinearSystem

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import error_functions
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

# Tolerance for coordinates of about 10 m after three or four rotations, each rounded to 2e-15.
ROUNDING = 1e-13
# Tolerance for sums of them weighted by information of about 100.
WEIGHTED_ROUNDING = 1e-10
# Step and tolerance of central differences; their error is step^2 from the series and 1e-15 / step
# from rounding.
STEP = 1e-5
DIFFERENCES = 1e-8

N = 40
seeds = st.integers(0, 2**32 - 1)


def central_differences(function, poses: FloatArray) -> FloatArray:
    """Return d function(pose) / d pose, shape (M, 3, 3), for rows (M, 3), angles unwrapped."""
    columns = []
    for axis in range(3):
        step = STEP * np.eye(3)[axis]
        difference = function(poses + step) - function(poses - step)
        difference[:, 2] = se2.wrap(difference[:, 2])
        columns.append(difference / (2.0 * STEP))
    return np.stack(columns, axis=-1)


def edges_of_pairs(rng: np.random.Generator, *, zero_error: bool) -> tuple[FloatArray, Edges]:
    """Return 2N poses and N edges, the k-th from pose k to pose N + k."""
    poses = random_poses(rng, 2 * N)
    edges = random_edges(rng, list(range(N)), list(range(N, 2 * N)))
    if zero_error:
        edges = Edges(edges.i, edges.j, se2.between(poses[:N], poses[N:]), edges.information,
                      edges.kind)
    return poses, edges


@pytest.mark.parametrize('zero_error', [True, False])
def test_jacobians_of_edges_are_the_central_differences(*, zero_error: bool) -> None:
    poses, edges = edges_of_pairs(np.random.default_rng(1), zero_error=zero_error)
    error, jacobian_i, jacobian_j = jacobians.linearize_edges(poses, edges)

    def error_at_i(start: FloatArray) -> FloatArray:
        return error_functions.edge_errors(np.vstack((start, poses[N:])), edges)

    def error_at_j(end: FloatArray) -> FloatArray:
        return error_functions.edge_errors(np.vstack((poses[:N], end)), edges)

    np.testing.assert_allclose(
        jacobian_i, central_differences(error_at_i, poses[:N]), atol=DIFFERENCES)
    np.testing.assert_allclose(
        jacobian_j, central_differences(error_at_j, poses[N:]), atol=DIFFERENCES)
    np.testing.assert_array_equal(error, error_functions.edge_errors(poses, edges))
    assert np.all(np.abs(error) < ROUNDING) == zero_error
    assert zero_error or np.max(np.abs(error[:, 2])) > 3.0     # far into the half circle


@pytest.mark.parametrize('offset', [True, False])
@pytest.mark.parametrize('zero_error', [True, False])
def test_jacobians_of_observed_nodes_are_the_central_differences(
    *, zero_error: bool, offset: bool,
) -> None:
    rng = np.random.default_rng(2)
    poses = random_poses(rng, N)
    observed = random_observed(rng, list(range(N)), offset=offset)
    if zero_error:
        observed = ObservedNodes(
            observed.node, observed.offset, se2.compose(poses, observed.offset),
            observed.information, observed.kind)
    error, jacobian = jacobians.linearize_observed(poses, observed)
    numeric = central_differences(
        lambda moved: error_functions.observed_errors(moved, observed), poses)
    np.testing.assert_allclose(jacobian, numeric, atol=DIFFERENCES)
    np.testing.assert_array_equal(error, error_functions.observed_errors(poses, observed))
    assert np.all(np.abs(error) < ROUNDING) == zero_error


@given(seeds)
def test_the_error_of_an_edge_is_that_of_g2o(seed: int) -> None:
    poses, edges = edges_of_pairs(np.random.default_rng(seed), zero_error=False)
    error, jacobian_i, jacobian_j = jacobians.linearize_edges(poses, edges)
    for k in range(N):
        slow, A, B = slow_edge(poses[k], poses[N + k], edges.mean[k])
        np.testing.assert_allclose(error[k, :2], slow[:2], atol=ROUNDING)
        assert abs(se2.wrap(error[k, 2] - slow[2])) < ROUNDING
        np.testing.assert_allclose(jacobian_i[k], A, atol=ROUNDING)
        np.testing.assert_allclose(jacobian_j[k], B, atol=ROUNDING)


@given(seeds)
def test_the_error_of_an_observed_node_is_its_pose_seen_from_the_measured_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses, observed = random_poses(rng, N), random_observed(rng, list(range(N)))
    error, jacobian = jacobians.linearize_observed(poses, observed)
    for k in range(N):
        slow, J = slow_observed(poses[k], observed.offset[k], observed.mean[k])
        np.testing.assert_allclose(error[k, :2], slow[:2], atol=ROUNDING)
        assert abs(se2.wrap(error[k, 2] - slow[2])) < ROUNDING
        np.testing.assert_allclose(jacobian[k], J, atol=ROUNDING)


def test_angles_are_wrapped_once_and_at_the_end() -> None:
    # th_j - th_i = -2 pi + 0.2 and z = 0.3: wrapping only a part would leave 2 pi in the error
    poses = np.array([[0.0, 0.0, np.pi - 0.1], [0.0, 0.0, -np.pi + 0.1]])
    edges = Edges([0], [1], [[0.0, 0.0, 0.3]], [np.eye(3)], [EdgeKind.ODOMETRY])
    assert error_functions.edge_errors(poses, edges)[0, 2] == pytest.approx(-0.1, abs=ROUNDING)
    observed = ObservedNodes([1], [[0.0, 0.0, -0.3]], [[0.0, 0.0, np.pi - 0.1]], [np.eye(3)],
                             [ObservedKind.GLOBAL_POSE])
    assert error_functions.observed_errors(poses, observed)[0, 2] == pytest.approx(
        -0.1, abs=ROUNDING)


@given(seeds)
def test_energies_are_the_squared_whitened_errors_and_never_negative(seed: int) -> None:
    rng = np.random.default_rng(seed)
    error, information = rng.standard_normal((N, 3)), random_information(rng, N)
    energy = error_functions.energies(error, information)
    for k in range(N):
        whitened = np.linalg.cholesky(information[k]).T @ error[k]
        assert energy[k] == pytest.approx(whitened @ whitened, rel=ROUNDING)
    assert np.all(energy >= 0.0)


# --- Footnote 3: an edge may be reversed -----------------------------------------------------
#
# With d = z^-1 x_i^-1 x_j the error is e = toVector(d). The reversed edge from j to i measures
# z^-1, and its error is e' = toVector(z d^-1 z^-1). Written out, with the adjoint Ad_z,
#
#     e' = -Ad_z e + r,   |r| <= |e_th| |e_t| + e_th^2 / 2 |t_z|,
#
# so that the covariance of e has to be transformed by Ad_z: Sigma' = Ad_z Sigma Ad_z^T. Then
#   - where e_th = 0, r = 0: the energies are equal exactly,
#   - where e = 0, de'/dx = -Ad_z de/dx: the contributions to H are equal exactly, b is 0,
#   - elsewhere energies are equal up to third order in e, and b up to second order.

def reversed_edges(edges: Edges) -> Edges:
    turn = np.linalg.inv(np.array([slow_adjoint(z) for z in edges.mean]))
    return Edges(edges.j, edges.i, se2.inverse(edges.mean),
                 np.swapaxes(turn, 1, 2) @ edges.information @ turn, edges.kind)


def slow_adjoint(z: FloatArray) -> FloatArray:
    """Return the matrix that Ad_z is by definition: z hat(xi) z^-1, column by column."""
    columns = []
    for axis in np.eye(3):
        generator = np.array([[0.0, -axis[2], axis[0]], [axis[2], 0.0, axis[1]], [0.0] * 3])
        turned = matrix(z) @ generator @ np.linalg.inv(matrix(z))
        columns.append((turned[0, 2], turned[1, 2], turned[1, 0]))
    return np.array(columns).T


def with_error(edges: Edges, poses: FloatArray, error: FloatArray) -> Edges:
    """Return the edges with the means at which the errors are the given ones."""
    mean = np.array([
        vector(np.linalg.inv(matrix(poses[i])) @ matrix(poses[j]) @ np.linalg.inv(matrix(e)))
        for i, j, e in zip(edges.i, edges.j, error, strict=True)])
    return Edges(edges.i, edges.j, mean, edges.information, edges.kind)


def contributions(poses: FloatArray, edges: Edges) -> tuple[FloatArray, FloatArray]:
    """Return H and b of edges, and of the same weak prior on every node, which makes H regular."""
    graph = Graph()
    n = len(poses)
    anchor = ObservedNodes(np.arange(n), None, np.zeros((n, 3)), [1e-9 * np.eye(3)] * n,
                           [ObservedKind.GLOBAL_POSE] * n)
    graph.apply(GraphUpdate(hidden=poses, edges=edges, observed=anchor))
    H, b = LinearSystem(graph).assemble(poses)
    return H.toarray(), b


@given(seeds, st.floats(1e-6, 1.0))
def test_a_reversed_edge_has_the_same_energy_up_to_third_order(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    poses, edges = edges_of_pairs(rng, zero_error=False)
    error = size * rng.uniform(-1.0, 1.0, (N, 3))
    edges = with_error(edges, poses, error)
    turned = reversed_edges(edges)
    energy = error_functions.energies(error_functions.edge_errors(poses, edges), edges.information)
    reversed_energy = error_functions.energies(
        error_functions.edge_errors(poses, turned), turned.information)
    norm = np.linalg.norm(turned.information, ord=2, axis=(1, 2))
    mapped = np.array([np.linalg.norm(slow_adjoint(z) @ e)
                        for z, e in zip(edges.mean, error, strict=True)])
    rest = (np.abs(error[:, 2]) * np.linalg.norm(error[:, :2], axis=1)
            + 0.5 * error[:, 2]**2 * np.linalg.norm(edges.mean[:, :2], axis=1))
    bound = norm * (2.0 * mapped * rest + rest**2)
    rounding = ROUNDING * norm * (1.0 + mapped) * (1.0 + size)
    assert np.all(np.abs(reversed_energy - energy) <= bound + rounding)


def test_a_reversed_edge_adds_the_same_to_the_system_to_first_order() -> None:
    rng = np.random.default_rng(4)
    poses, edges = edges_of_pairs(rng, zero_error=False)
    direction = rng.uniform(-1.0, 1.0, (N, 3))
    differences = []
    for size in (1e-2, 1e-3, 1e-4):
        scaled = with_error(edges, poses, size * direction)
        H, b = contributions(poses, scaled)
        H_turned, b_turned = contributions(poses, reversed_edges(scaled))
        differences.append((np.linalg.norm(H_turned - H), np.linalg.norm(b_turned - b)))
    for (H_large, b_large), (H_small, b_small) in pairwise(differences):
        assert H_large / H_small == pytest.approx(10.0, rel=0.1)      # first order in the error
        assert b_large / b_small == pytest.approx(100.0, rel=0.1)     # second order in it


# --- Footnote 4: the information may be turned instead of the error --------------------------

@given(seeds)
def test_turning_the_information_equals_turning_the_error(seed: int) -> None:
    poses, edges = edges_of_pairs(np.random.default_rng(seed), zero_error=False)
    error, jacobian_i, jacobian_j = jacobians.linearize_edges(poses, edges)
    for k in range(N):
        R_z, W = np.eye(3), edges.information[k]
        R_z[:2, :2] = matrix(edges.mean[k])[:2, :2]
        turned = R_z @ W @ R_z.T
        # the unturned error: difference of the predicted and the measured translation
        predicted = np.linalg.inv(matrix(poses[k])) @ matrix(poses[N + k])
        unturned = np.append(predicted[:2, 2] - edges.mean[k, :2], error[k, 2])
        A, B = R_z @ jacobian_i[k], R_z @ jacobian_j[k]
        assert unturned @ turned @ unturned == pytest.approx(
            error[k] @ W @ error[k], rel=1e-11)
        for J, J_unturned in ((jacobian_i[k], A), (jacobian_j[k], B)):
            np.testing.assert_allclose(J_unturned.T @ turned @ unturned, J.T @ W @ error[k],
                                       atol=WEIGHTED_ROUNDING)
            np.testing.assert_allclose(J_unturned.T @ turned @ A, J.T @ W @ jacobian_i[k],
                                       atol=WEIGHTED_ROUNDING)
            np.testing.assert_allclose(J_unturned.T @ turned @ B, J.T @ W @ jacobian_j[k],
                                       atol=WEIGHTED_ROUNDING)


# --- Footnote 5: an observed node is an edge from a fixed node -------------------------------

@given(seeds)
def test_an_observed_node_is_an_edge_with_zero_mean_from_a_node_fixed_there(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, N)
    observed = random_observed(rng, list(range(N)), offset=False)
    with_observed, with_edges = Graph(), Graph()
    chain = random_edges(rng, list(range(N - 1)), list(range(1, N)))
    with_observed.apply(GraphUpdate(hidden=poses, edges=chain, observed=observed))
    with_edges.apply(GraphUpdate(hidden=poses, edges=chain))
    with_edges.apply(GraphUpdate(
        hidden=observed.mean, fix=range(N, 2 * N),
        edges=Edges(np.arange(N, 2 * N), observed.node, np.zeros((N, 3)), observed.information,
                    [EdgeKind.LOOP_CLOSURE] * N)))
    H, b = LinearSystem(with_observed).assemble(with_observed.poses)
    H_edges, b_edges = LinearSystem(with_edges).assemble(with_edges.poses)
    np.testing.assert_allclose(H_edges.toarray(), H.toarray(), atol=WEIGHTED_ROUNDING)
    np.testing.assert_allclose(b_edges, b, atol=WEIGHTED_ROUNDING)
    assert with_edges.energies().chi2 == pytest.approx(with_observed.energies().chi2, rel=1e-12)
