# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances from the Bayes tree are blocks of the dense inverse of H."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from slow_smoother import EXACT, SlowGraph, world

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.smoother import covariances
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# Tolerance of an entry, relative to the product of its two sigmas.
RELATIVE = 1e-9

seeds = st.integers(0, 2**32 - 1)


def driven(seed: int, steps: int) -> IncrementalSmoother:
    """Return a smoother after random edits, everything linearized at the estimate."""
    smoother, slow, here = IncrementalSmoother(EXACT), SlowGraph(), world(seed)
    smoother.update(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    slow = slow.edited(GraphUpdate(hidden=np.array(here.truth), fix=[0]))
    for _ in range(steps):
        update = here.mixture(slow)
        if smoother.update(update).status is not Status.FAILED:
            slow = slow.edited(update)
        del here.truth[len(slow.poses):]
    smoother.graph.set_poses(smoother.poses.copy())
    smoother.update(GraphUpdate())
    return smoother


def dense(smoother: IncrementalSmoother) -> np.ndarray:
    graph = smoother.graph
    return SlowGraph(graph.poses, graph.fixed, graph.edges, graph.observed).covariance()


def off(actual: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference of two covariances, in products of sigmas."""
    sigma = np.sqrt(np.diag(expected)) + 1e-30
    return float(np.max(np.abs(actual - expected) / sigma / sigma[:, None], initial=0.0))


def rows(*nodes: int) -> list[int]:
    return [3 * node + k for node in nodes for k in range(3)]


@given(seeds, st.integers(0, 25))
@settings(max_examples=30)
def test_all_covariances_are_the_blocks_of_the_inverse(seed: int, steps: int) -> None:
    smoother = driven(seed, steps)
    expected, actual = dense(smoother), smoother.covariances()
    assert actual.shape == (smoother.graph.n_nodes, 3, 3)
    for node, block in enumerate(actual):
        at = rows(node)
        assert off(block, expected[np.ix_(at, at)]) < RELATIVE
        np.testing.assert_array_equal(block, block.T)


@given(seeds, st.integers(0, 25))
@settings(max_examples=20)
def test_each_covariance_alone_is_that_block_too(seed: int, steps: int) -> None:
    smoother = driven(seed, steps)
    expected = dense(smoother)
    for node in range(smoother.graph.n_nodes):
        at = rows(node)
        assert off(smoother.covariance(node), expected[np.ix_(at, at)]) < RELATIVE
    np.testing.assert_allclose(
        smoother.newest_covariance(), smoother.covariance(smoother.graph.newest_pose),
        rtol=1e-12, atol=1e-18)


@given(seeds, st.integers(0, 25), st.data())
@settings(max_examples=40)
def test_joint_covariances_have_the_blocks_of_both(
    seed: int, steps: int, data: st.DataObject,
) -> None:
    smoother = driven(seed, steps)
    expected, node = dense(smoother), st.integers(0, smoother.graph.n_nodes - 1)
    for _ in range(5):
        i, j = data.draw(node), data.draw(node)
        joint, at = smoother.joint_covariance(i, j), rows(i, j)
        assert off(joint, expected[np.ix_(at, at)]) < RELATIVE
        np.testing.assert_array_equal(joint, joint.T)
        np.testing.assert_array_equal(joint[:3, :3], smoother.covariance(i))


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
        edges=Edges(range(n - 1), range(1, n), mean, [pose_information()] * (n - 1),
                    [EdgeKind.ODOMETRY] * (n - 1)))


def test_a_fixed_node_has_no_uncertainty_and_no_correlation() -> None:
    smoother = IncrementalSmoother(EXACT)
    smoother.update(chain(6))
    smoother.update(GraphUpdate(fix=[3]))
    np.testing.assert_array_equal(smoother.covariance(3), np.zeros((3, 3)))
    np.testing.assert_array_equal(smoother.covariances()[[0, 3]], np.zeros((2, 3, 3)))
    np.testing.assert_array_equal(smoother.joint_covariance(3, 5)[:3], np.zeros((3, 6)))
    assert np.all(np.diag(smoother.joint_covariance(3, 5))[3:] > 0.0)
    # it separates uncorrelated parts; the covariances behind it are those of a chain from there
    np.testing.assert_allclose(smoother.joint_covariance(1, 5)[:3, 3:], 0.0, atol=1e-18)
    alone = IncrementalSmoother(EXACT)
    alone.update(chain(3))
    turn = np.eye(3)
    turn[:2, :2] = se2.rotation(smoother.poses[3, 2])
    np.testing.assert_allclose(
        smoother.covariance(5), turn @ alone.covariance(2) @ turn.T, rtol=1e-9, atol=1e-15)


def test_nodes_in_different_parts_are_not_correlated() -> None:
    smoother = IncrementalSmoother(EXACT)
    smoother.update(chain(4))
    smoother.update(GraphUpdate(
        hidden=np.zeros((2, 3)),
        edges=Edges([4], [5], np.zeros((1, 3)), [pose_information()], [EdgeKind.ODOMETRY]),
        observed=ObservedNodes([4], None, np.zeros((1, 3)), [pose_information()],
                               [ObservedKind.GLOBAL_POSE])))
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
    assert not covariances.newest_covariance(smoother.graph.memory.head, np.empty((3, 3)))
    with pytest.raises(ValueError, match='4 hidden nodes that wait'):
        smoother.newest_covariance()
    smoother.update(GraphUpdate())
    assert smoother.covariances().shape == (4, 3, 3)
