# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Nodes leave a graph that stays sparse, and no covariance becomes smaller."""

from hypothesis import given, settings, strategies as st
import numpy as np
from random_graphs import consistent_graph

from pose_graph_ros.core.config import SmootherConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.marginalization.marginalize import equations, marginalize
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.bias import (
    Additions,
    BiasChain,
    CorrelatedErrors,
    held_by_bias,
    Process,
)
from pose_graph_ros.core.sources.queued import Queued
from pose_graph_ros.core.window.sparse_removal import (
    crowded_edges,
    cut_chains,
    NONE,
    sparse_marginalization,
    sparse_removal,
)
from pose_graph_ros.core.window.thinning import next_segment

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


def test_fewer_edges_take_the_place_of_many() -> None:
    rng = np.random.default_rng(1)
    poses = np.column_stack((rng.uniform(0.0, 5.0, (8, 2)), rng.uniform(-3.0, 3.0, 8)))
    i, j = np.triu_indices(8, 1)
    graph = Graph()
    graph.apply(GraphUpdate(hidden=poses, fix=[0], factors=Factors(
        i, j, se2.between(poses[i], poses[j]), np.tile(np.eye(3), (len(i), 1, 1)),
        np.full(len(i), FactorKind.PRIOR))))
    before = covariances(graph)
    edges = next(crowded_edges(graph, 1))
    np.testing.assert_array_equal(edges, graph.factor_ids)
    IncrementalSmoother(EXACT, graph).update(sparse_removal(graph, NONE, edges))
    assert list(crowded_edges(graph, 1)) == []
    assert len(graph.factors.edges) == 7 + 4
    assert np.min(np.linalg.eigvalsh(covariances(graph) - before)) > -1e-9


N = 18


def drive(seed: int, tau: float, *, headings: bool) -> tuple[Graph, BiasChain]:
    """
    Return a graph in which all constraints agree, with a fix each second, and its biases.

    All errors are 0, so no Jacobian changes when nodes leave.
    """
    rng = np.random.default_rng(seed)
    steps = np.column_stack((
        rng.uniform(0.5, 2.0, N - 1), rng.normal(0.0, 0.2, N - 1), rng.normal(0.0, 0.3, N - 1)))
    poses = np.zeros((N, 3))
    for k, step in enumerate(steps):
        poses[k + 1] = se2.compose(poses[k], step)
    i = np.arange(N - 1)
    graph = Graph()
    graph.apply(GraphUpdate(hidden=poses, factors=Factors.joined([
        Factors(i, i + 1, steps, np.tile(np.diag((400.0, 900.0, 1e4)), (N - 1, 1, 1)), 0 * i),
        Factors([1], [N - 3], se2.between(poses[[1]], poses[[N - 3]]),
                np.diag((50.0, 20.0, 100.0))[None], [FactorKind.LOOP_CLOSURE])])))
    errors, additions = CorrelatedErrors(tau, 1.0, 0.1), Additions(graph.next_ids)
    bias = BiasChain().with_bins(
        1_000_000_000 * np.arange(N), Process.correlated(errors), additions, np.zeros(3))
    for k in range(N):
        kind = FactorKind.GLOBAL_POSE if headings else FactorKind.POSITION
        mean = poses[[k]] if headings else np.append(poses[k, :2], 0.0)[None]
        observed = Factors.on(
            [k], mean=mean, information=[np.diag((1.0, 1.0, 25.0 * headings))], kind=[kind])
        additions.add(held_by_bias(
            Queued('fix', observed, k * 1_000_000_000, noise=np.array((0.01, 0.001))), bias,
            errors))
    graph.apply(additions.update())
    return graph, bias


def joint_covariance(graph: Graph, nodes: list[int]) -> FloatArray:
    """Return the covariance of all coordinates of nodes, by a dense inverse."""
    columns = 3 * graph.node_rows(np.array(nodes))[:, None] + np.arange(3)
    H, _ = equations(graph)
    return np.asarray(np.linalg.inv(H)[np.ix_(columns.ravel(), columns.ravel())])


@given(st.integers(0, 2**32 - 1), st.sampled_from((2.0, 20.0, 300.0)), st.booleans())
@settings(max_examples=15)
def test_where_a_chain_is_cut_no_covariance_becomes_smaller(
    seed: int, tau: float, headings: bool,
) -> None:
    graph, bias = drive(seed, tau, headings=headings)
    before_poses, rng = graph.poses.copy(), np.random.default_rng(seed)
    first = graph.node_ids.copy()
    before = joint_covariance(graph, first.tolist())
    smoother = IncrementalSmoother(EXACT, graph)
    for _ in range(2):  # the second one takes in what the first has left
        older = graph.node_ids[graph.is_pose][:-3]
        leaving = older[rng.random(len(older)) < 0.5]
        segment = next_segment(graph, older, leaving)
        if segment is None:
            break
        biases = np.array(bias.leaving(segment.after * 1_000_000_000))
        cuts, _ = cut_chains(graph, biases)
        assert len(cuts) == 1
        leaving = leaving[np.isin(leaving, segment.poses)]
        update = sparse_removal(graph, np.sort(np.append(leaving, biases)), segment.factors)
        assert update is not None
        smoother.update(update)
        bias = bias.without(biases)
        kept = graph.node_ids.tolist()
        columns = (3 * np.searchsorted(first, kept)[:, None] + np.arange(3)).ravel()
        after = joint_covariance(graph, kept)
        scale = 1.0 / np.sqrt(np.diagonal(before)[columns])
        more = (after - before[np.ix_(columns, columns)]) * scale[:, None] * scale
        assert np.min(np.linalg.eigvalsh(more)) > -1e-5
        np.testing.assert_allclose(
            graph.poses, before_poses[np.searchsorted(first, kept)], atol=1e-6)
    assert graph.n_nodes < len(first) - 3
