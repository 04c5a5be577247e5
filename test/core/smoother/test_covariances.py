# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances from the Bayes tree are blocks of the dense inverse P of H, and J P J^T."""

from hypothesis import given, settings, strategies as st
import jacobians
import numpy as np
import pytest
from slow_smoother import driven, EXACT, SlowGraph

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph import factors
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# Tolerance of an entry, relative to the product of its two sigmas.
RELATIVE = 1e-9

seeds = st.integers(0, 2**32 - 1)


def linearized(seed: int, steps: int) -> IncrementalSmoother:
    """Return a smoother after random edits, everything linearized at the estimate."""
    smoother, *_ = driven(seed, steps)
    smoother.graph.set_poses(smoother.poses.copy())
    smoother.update(GraphUpdate())
    return smoother


def dense(smoother: IncrementalSmoother) -> np.ndarray:
    graph = smoother.graph
    return SlowGraph(graph.poses, graph.fixed, graph.factors).covariance()


def off(actual: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference of two covariances, in products of sigmas."""
    sigma = np.sqrt(np.diag(expected)) + 1e-30
    return float(np.max(np.abs(actual - expected) / sigma / sigma[:, None], initial=0.0))


def rows(*nodes: int) -> list[int]:
    return [3 * node + k for node in nodes for k in range(3)]


@given(seeds, st.integers(0, 25))
@settings(max_examples=30)
def test_covariances_are_the_blocks_of_the_inverse(seed: int, steps: int) -> None:
    smoother = linearized(seed, steps)
    expected, actual = dense(smoother), smoother.covariances()
    assert actual.shape == (smoother.graph.n_nodes, 3, 3)
    for node, block in enumerate(actual):
        at = rows(node)
        assert off(block, expected[np.ix_(at, at)]) < RELATIVE
        assert off(smoother.covariance(node), expected[np.ix_(at, at)]) < RELATIVE
        np.testing.assert_array_equal(block, block.T)
    np.testing.assert_array_equal(
        smoother.newest_covariance(), smoother.covariance(smoother.graph.newest_pose))


@given(seeds, st.integers(0, 25), st.data())
@settings(max_examples=40)
def test_joint_covariances_have_the_blocks_of_both(
    seed: int, steps: int, data: st.DataObject,
) -> None:
    smoother = linearized(seed, steps)
    expected, node = dense(smoother), st.integers(0, smoother.graph.n_nodes - 1)
    for _ in range(5):
        i, j = data.draw(node), data.draw(node)
        joint, at = smoother.joint_covariance(i, j), rows(i, j)
        assert off(joint, expected[np.ix_(at, at)]) < RELATIVE
        np.testing.assert_array_equal(joint, joint.T)


def pose_information(scale: float = 1.0) -> np.ndarray:
    return scale * np.array([[100.0, 10.0, 5.0], [10.0, 80.0, -7.0], [5.0, -7.0, 400.0]])


def chain(n: int, *, bend: float = 0.1) -> GraphUpdate:
    """Return a chain of nodes with bends, its edges without errors."""
    mean = np.tile([1.0, 0.0, bend], (n - 1, 1))
    poses = [np.zeros(3)]
    for step in mean:
        poses.append(se2.wrapped(se2.compose(poses[-1], step)))
    return GraphUpdate(
        hidden=np.array(poses), fix=[0],
        factors=Factors(range(n - 1), range(1, n), mean, [pose_information()] * (n - 1),
                    [FactorKind.ODOMETRY] * (n - 1)))


def test_nodes_in_different_parts_are_not_correlated() -> None:
    smoother = IncrementalSmoother(EXACT)
    smoother.update(chain(4))
    smoother.update(GraphUpdate(
        hidden=np.zeros((2, 3)),
        factors=Factors.joined([
            Factors([4], [5], np.zeros((1, 3)), [pose_information()], [FactorKind.ODOMETRY]),
            Factors.on([4], None, np.zeros((1, 3)), [pose_information()],
                       [FactorKind.GLOBAL_POSE])])))
    joint = smoother.joint_covariance(2, 5)
    np.testing.assert_array_equal(joint[:3, 3:], np.zeros((3, 3)))
    np.testing.assert_allclose(joint[3:, 3:], 2.0 * np.linalg.inv(pose_information()), rtol=1e-12)


def test_covariances_require_that_edits_are_solved_for() -> None:
    smoother = IncrementalSmoother(EXACT)
    smoother.update(chain(4))
    smoother.graph.set_poses(smoother.poses.copy())
    for ask in (smoother.covariances, lambda: smoother.covariance(1),
                lambda: smoother.joint_covariance(1, 2)):
        with pytest.raises(ValueError, match='4 hidden nodes that wait'):
            ask()
    with pytest.raises(ValueError, match='4 hidden nodes that wait'):
        smoother.newest_covariance()
    smoother.update(GraphUpdate())
    assert smoother.covariances().shape == (4, 3, 3)


def candidates(smoother: IncrementalSmoother, rng: np.random.Generator, n: int) -> Factors:
    """Return random edges, also to biases, of any consistency."""
    graph, sigma = smoother.graph, (2.0, 2.0, 1.0)
    poses, biases = np.flatnonzero(~graph.is_bias), np.flatnonzero(graph.is_bias)
    pairs = [rng.choice(poses, 2, replace=False) for _ in range(n if len(poses) > 1 else 0)]
    kinds = [FactorKind.LOOP_CLOSURE] * len(pairs)
    if len(biases) > 0:
        pairs += [(rng.choice(poses), rng.choice(biases)) for _ in range(n)]
        kinds += [FactorKind.BIAS] * n
    i, j = np.reshape(pairs, (-1, 2)).T.astype(np.int64)
    root = rng.normal(size=(len(i), 3, 3))
    return Factors(i, j, rng.normal(size=(len(i), 3)) * sigma, root @ np.swapaxes(root, 1, 2),
                   kinds, constants=rng.normal(size=(len(i), 4)))


@given(seeds, st.integers(0, 25))
@settings(max_examples=30)
def test_innovations_are_those_of_the_dense_inverse(seed: int, steps: int) -> None:
    smoother = linearized(seed, steps)
    poses, P = smoother.poses, dense(smoother).reshape(len(smoother.poses), 3, -1, 3)
    edges = candidates(smoother, np.random.default_rng(seed), 5)
    linear = jacobians.linearize_edges(poses, edges)
    errors, actual = smoother.innovations(edges)
    np.testing.assert_allclose(errors, factors.errors(poses, edges), atol=1e-12)
    for k, (i, j) in enumerate(zip(edges.i, edges.j, strict=True)):
        J = np.hstack((linear.jacobian_i[k], linear.jacobian_j[k]))
        joint = np.block([[P[i, :, i], P[i, :, j]], [P[j, :, i], P[j, :, j]]])
        assert off(actual[k], J @ joint @ J.T) < RELATIVE
        np.testing.assert_array_equal(actual[k], actual[k].T)


@given(seeds)
@settings(max_examples=10)
def test_distances_are_those_by_the_inverse_also_without_information_on_the_heading(
    seed: int,
) -> None:
    smoother = linearized(seed, 10)
    edges = candidates(smoother, np.random.default_rng(seed), 5)
    found = smoother.innovations(edges)
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
    edges = smoother.graph.factors_at(np.array([1990]))
    covariance = smoother.innovations(edges).covariances[0]
    np.testing.assert_allclose(covariance, np.linalg.inv(edges.information[0]), rtol=1e-12)
