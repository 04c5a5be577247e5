# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Innovation covariances are J P J^T with the dense inverse P of H."""

from hypothesis import given, settings, strategies as st
import jacobians
import numpy as np
from slow_smoother import EXACT, world
from test_covariances import chain, dense, driven, off, RELATIVE, seeds

from pose_graph_ros.core.graph import error_functions
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother


def candidates(smoother: IncrementalSmoother, rng: np.random.Generator, n: int) -> Edges:
    """Return random edges, also to biases, of any consistency."""
    graph, sigma = smoother.graph, (2.0, 2.0, 1.0)
    poses, biases = np.flatnonzero(~graph.is_bias), np.flatnonzero(graph.is_bias)
    pairs = [rng.choice(poses, 2, replace=False) for _ in range(n if len(poses) > 1 else 0)]
    kinds = [EdgeKind.LOOP_CLOSURE] * len(pairs)
    if len(biases) > 0:
        pairs += [(rng.choice(poses), rng.choice(biases)) for _ in range(n)]
        kinds += [EdgeKind.BIAS] * n
    i, j = np.reshape(pairs, (-1, 2)).T.astype(np.int64)
    root = rng.normal(size=(len(i), 3, 3))
    return Edges(i, j, rng.normal(size=(len(i), 3)) * sigma, root @ np.swapaxes(root, 1, 2), kinds,
                 bias=rng.normal(size=(len(i), 4)))


@given(seeds, st.integers(0, 25))
@settings(max_examples=30)
def test_they_are_those_of_the_dense_inverse(seed: int, steps: int) -> None:
    smoother = driven(seed, steps)
    poses, P = smoother.poses, dense(smoother).reshape(len(smoother.poses), 3, -1, 3)
    edges = candidates(smoother, np.random.default_rng(seed), 5)
    linear = jacobians.linearize_edges(poses, edges)
    errors, actual = smoother.edge_innovations(edges)
    np.testing.assert_allclose(errors, error_functions.edge_errors(poses, edges), atol=1e-12)
    for k, (i, j) in enumerate(zip(edges.i, edges.j, strict=True)):
        J = np.hstack((linear.jacobian_i[k], linear.jacobian_j[k]))
        joint = np.block([[P[i, :, i], P[i, :, j]], [P[j, :, i], P[j, :, j]]])
        assert off(actual[k], J @ joint @ J.T) < RELATIVE
        np.testing.assert_array_equal(actual[k], actual[k].T)


@given(seeds)
@settings(max_examples=10)
def test_they_are_those_of_joint_covariances_whatever_is_linearized_where(seed: int) -> None:
    smoother, here = IncrementalSmoother(), world(seed, noise=(0.2, 0.2, 0.1))
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    for _ in range(30):
        smoother.update(here.new_nodes(2))
    smoother.update(GraphUpdate(edges=here.edges(here.pairs(3))))
    edges = candidates(smoother, here.rng, 5)
    linear = jacobians.linearize_edges(smoother.poses, edges)
    for k, actual in enumerate(smoother.edge_innovations(edges).covariances):
        J = np.hstack((linear.jacobian_i[k], linear.jacobian_j[k]))
        joint = smoother.joint_covariance(edges.i[k], edges.j[k])
        assert off(actual, J @ joint @ J.T) < 1e-8


@given(seeds)
@settings(max_examples=10)
def test_distances_are_those_by_the_inverse_also_without_information_on_the_heading(
    seed: int,
) -> None:
    smoother = driven(seed, 10)
    edges = candidates(smoother, np.random.default_rng(seed), 5)
    found = smoother.edge_innovations(edges)
    total = found.covariances + np.linalg.inv(edges.information)
    np.testing.assert_allclose(
        found.squared_distances(edges.information),
        np.einsum('mi,mij,mj->m', found.errors, np.linalg.inv(total), found.errors), rtol=1e-7)
    edges.information[:, 2, :] = edges.information[:, :, 2] = 0.0
    position = np.linalg.inv(
        found.covariances[:, :2, :2] + np.linalg.inv(edges.information[:, :2, :2]))
    np.testing.assert_allclose(
        found.squared_distances(edges.information),
        np.einsum('mi,mij,mj->m', found.errors[:, :2], position, found.errors[:, :2]), rtol=1e-7)


def test_neighbours_far_from_what_fixes_them_have_an_exact_relative_covariance() -> None:
    smoother = IncrementalSmoother(EXACT)
    smoother.update(chain(2000, bend=1e-3))
    edges = smoother.graph.edges_at(np.array([1990]))
    covariance = smoother.edge_innovations(edges).covariances[0]
    np.testing.assert_allclose(covariance, np.linalg.inv(edges.information[0]), rtol=1e-12)
