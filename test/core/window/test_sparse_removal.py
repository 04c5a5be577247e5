# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes leave a graph that stays sparse, and no covariance becomes smaller."""

from hypothesis import given, settings, strategies as st
import numpy as np
from random_graphs import consistent_graph

from pose_graph_ros.core.config import SmootherConfig, ThinningConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.marginalization.marginalize import marginalize
from pose_graph_ros.core.odometry.thinned_nodes import ThinnedNodes
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.window.sparse_removal import (
    sparse_marginalization,
    sparse_removal,
    with_fewer_edges,
)
from pose_graph_ros.core.window.thinning import groups, removed, simplify, Thinning

EXACT = SmootherConfig(alpha=0.0, budget=1e-20, max_iterations=20)


def covariances(graph: Graph) -> FloatArray:
    """Return the covariances of all nodes."""
    smoother = IncrementalSmoother(EXACT, graph)
    smoother.update(GraphUpdate())
    return smoother.covariances()


@given(st.integers(0, 2**32 - 1), st.integers(6, 12), st.integers(1, 3))
@settings(max_examples=10)
def test_no_covariance_becomes_smaller(seed: int, n: int, n_leaving: int) -> None:
    # without noise nothing moves, and with it no Jacobian
    graph = consistent_graph(seed, n_nodes=n)
    before = covariances(graph)
    leaving = np.sort(np.random.default_rng(seed).choice(np.arange(1, n), n_leaving, False))
    smoother = IncrementalSmoother(EXACT, graph)
    update = sparse_removal(graph, leaving)
    smoother.update(update)
    assert graph.n_nodes == n - n_leaving
    after = covariances(graph)
    difference = after - before[np.setdiff1d(np.arange(n), leaving)]
    assert np.min(np.linalg.eigvalsh(difference)) > -1e-6 * np.max(np.abs(after))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_nor_does_one_if_nodes_have_left_with_a_dense_prior_before(seed: int) -> None:
    graph = consistent_graph(seed, n_nodes=12)
    smoother = IncrementalSmoother(EXACT, graph)
    before = covariances(graph)
    smoother.update(marginalize(graph, [1, 2, 3]))
    dense = covariances(graph)
    np.testing.assert_allclose(dense, np.delete(before, [1, 2, 3], axis=0), rtol=1e-5, atol=1e-9)
    for remove in (sparse_removal, sparse_marginalization):
        copy = Graph()
        copy.fill(graph.rows())
        IncrementalSmoother(EXACT, copy).update(remove(copy, np.array([4, 5, 6])))
        assert len(copy.priors) <= len(graph.priors)
        after = covariances(copy)
        difference = after - np.delete(before, range(1, 7), axis=0)
        # what the prior has told is not lost
        assert np.all(np.isfinite(after))
        assert np.min(np.linalg.eigvalsh(difference)) > -1e-5 * np.max(np.abs(after))


def test_the_prior_of_a_bias_is_on_one_pose() -> None:
    i = np.arange(4)
    poses = np.column_stack((np.arange(5.0), np.zeros((5, 2))))
    graph = Graph()
    graph.apply(GraphUpdate(hidden=poses, biases=np.zeros((1, 3)), fix=[0], edges=Edges.joined([
        Edges(i, i + 1, se2.between(poses[:-1], poses[1:]), np.tile(np.eye(3), (4, 1, 1)), 0 * i),
        Edges([2, 3], [5, 5], poses[2:4], np.tile(np.eye(3), (2, 1, 1)), [EdgeKind.BIAS] * 2,
              bias=np.ones((2, 4)))]),
        observed=ObservedNodes([5], mean=np.zeros((1, 3)), information=np.eye(3)[None], kind=[0])))
    before = covariances(graph)
    assert [prior.nodes.tolist() for prior in marginalize(graph, [1, 2]).priors] == [[0, 3, 5]]
    IncrementalSmoother(EXACT, graph).update(sparse_marginalization(graph, np.array([1, 2])))
    assert [len(prior.nodes) for prior in graph.priors] == [2]
    assert 5 in graph.priors[0].nodes
    assert graph.edges.kind.tolist().count(EdgeKind.PRIOR) == 1
    after = covariances(graph)
    difference = after - before[[0, 3, 4, 5]]
    assert np.min(np.linalg.eigvalsh(difference)) > -1e-6
    exact, sparse = (np.trace(each, axis1=1, axis2=2) for each in (before[[0, 3, 4, 5]], after))
    assert np.all(sparse <= 1.2 * exact)


def test_a_node_of_a_chain_becomes_an_edge_without_loss() -> None:
    i = np.arange(5)
    poses = np.column_stack((np.arange(6.0), np.zeros((6, 2))))
    graph = Graph()
    graph.apply(GraphUpdate(hidden=poses, fix=[0], edges=Edges(
        i, i + 1, se2.between(poses[:-1], poses[1:]), np.tile(np.eye(3), (5, 1, 1)), 0 * i),
        observed=ObservedNodes([4], mean=poses[[4]], information=np.eye(3)[None], kind=[0])))
    before = covariances(graph)
    update = sparse_removal(graph, np.array([2]))
    smoother = IncrementalSmoother(EXACT, graph)
    smoother.update(update)
    np.testing.assert_allclose(covariances(graph), before[[0, 1, 3, 4, 5]], atol=1e-9)
    # the edge that the node has left goes into the next one
    update = sparse_removal(graph, np.array([1]))
    smoother.update(update)
    np.testing.assert_allclose(covariances(graph), before[[0, 3, 4, 5]], atol=1e-9)
    assert graph.edges.kind.tolist() == [
        EdgeKind.ODOMETRY, EdgeKind.ODOMETRY, EdgeKind.PRIOR]


def test_fewer_edges_take_the_place_of_many() -> None:
    rng = np.random.default_rng(1)
    poses = np.column_stack((rng.uniform(0.0, 5.0, (8, 2)), rng.uniform(-3.0, 3.0, 8)))
    i, j = np.triu_indices(8, 1)
    graph = Graph()
    graph.apply(GraphUpdate(hidden=poses, fix=[0], edges=Edges(
        i, j, se2.between(poses[i], poses[j]), np.tile(np.eye(3), (len(i), 1, 1)),
        np.full(len(i), EdgeKind.PRIOR))))
    before = covariances(graph)
    assert with_fewer_edges(graph, 5.0) is None
    update = with_fewer_edges(graph, 2.0)
    assert update is not None
    IncrementalSmoother(EXACT, graph).update(update)
    assert graph.n_edges == 7 + 4
    assert np.min(np.linalg.eigvalsh(covariances(graph) - before)) > -1e-9


def test_the_graph_of_a_place_that_is_driven_often_does_not_grow() -> None:
    rng = np.random.default_rng(2)
    per_lap, laps, sigma = 40, 12, np.array((0.02, 0.02, 0.005))
    angle = 2.0 * np.pi / per_lap * np.arange(per_lap * laps)
    truth = se2.wrapped(np.column_stack((6.0 * np.cos(angle), 6.0 * np.sin(angle), angle)))
    smoother, thinning, thinned = IncrementalSmoother(), Thinning(), ThinnedNodes()
    smoother.update(GraphUpdate(hidden=truth[:1], fix=[0]))
    config, sizes = ThinningConfig(cell=2.0, newest=15), []
    for k in range(1, len(truth)):
        mean = se2.compose(se2.between(truth[k - 1], truth[k]), sigma * rng.standard_normal(3))
        smoother.extend(mean, np.diag(sigma**-2))
        if k > per_lap and k % 5 == 0:
            other = k - per_lap * int(rng.integers(1, k // per_lap + 1))
            mean = se2.compose(
                se2.between(truth[other], truth[k]), 2.0 * sigma * rng.standard_normal(3))
            noise, place = np.diag(4.0 * sigma**2), thinned.place(other)
            if place is not None:
                adjoint = se2.adjoint(se2.inverse(mean))
                noise = noise + adjoint @ place.noise @ adjoint.T
                other, mean = place.anchor, se2.compose(place.mean, mean)
            smoother.update(GraphUpdate(edges=Edges(
                [other], [k], [mean], [np.linalg.inv(noise)], [EdgeKind.LOOP_CLOSURE])))
        places = thinning.places(smoother, config, k + 1)
        if places is not None:
            for group in groups(smoother.graph, places):
                assert removed(
                    smoother, sparse_removal(smoother.graph, group.nodes)) is not None
                thinned.add(*group)
            for _ in simplify(smoother):
                pass
        if k % per_lap == per_lap - 1:
            sizes.append((smoother.graph.n_nodes, smoother.graph.n_edges))
    nodes, edges = np.array(sizes).T
    assert np.max(nodes[4:]) < 2 * per_lap
    assert np.max(edges[4:]) < 4 * np.max(nodes[4:])
    assert len(thinned) == len(truth) - smoother.graph.n_nodes
    off = smoother.graph.poses_of(len(truth) - 1) - truth[-1]
    off[2] = se2.wrap(off[2])
    assert off @ np.linalg.solve(smoother.newest_covariance(), off) < 16.0
