# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Edits keep chi2 and the lists of constraints as they follow from the rows, and can be undone."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import random_edges, random_graph, random_observed, random_poses, snapshot

from pose_graph_ros.core.graph import editing, error_functions, tables as tb
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

seeds = st.integers(0, 2**32 - 1)
edits = st.lists(st.tuples(
    st.sampled_from(['edge', 'observed', 'fix', 'free', 'node']), st.integers(0, 10**6),
    st.sampled_from([0.0, 1e-9, 0.5, 1.0, 20.0])), max_size=12)


def edited(graph: Graph, steps: list[tuple[str, int, float]], rng: np.random.Generator) -> None:
    for what, number, value in steps:
        node = number % graph.n_nodes
        graph.apply({
            'edge': GraphUpdate(weigh_edges={number % graph.n_edges: value}),
            'observed': GraphUpdate(weigh_observed={number % graph.n_observed: value}),
            'fix': GraphUpdate(fix=(node,)), 'free': GraphUpdate(free=(node,)),
            'node': GraphUpdate(
                hidden=random_poses(rng, 1), edges=random_edges(rng, [node], [graph.n_nodes]),
                observed=random_observed(rng, [graph.n_nodes]))}[what])


def chi2(graph: Graph) -> float:
    """Return the sum of all weighted energies, from copies of the rows."""
    edges, observed = graph.edges, graph.observed
    return float(np.sum(error_functions.energies(
        error_functions.edge_errors(graph.poses, edges), edges.weighted_information))
        + np.sum(error_functions.energies(error_functions.observed_errors(
            graph.poses, observed), observed.weighted_information)))


def edges_of(graph: Graph, node: int) -> list[int]:
    """Return the edges in the list of a node; the two low bits are the end of the edge."""
    edge_i, found = graph.memory['edge_i'], []
    entry = int(graph.memory['node_i'][node, tb.EDGE_LIST])
    while entry >= 0:
        edge, side = entry >> 2, entry & 3
        assert edge_i[edge, side] == node
        found.append(edge)
        entry = int(edge_i[edge, tb.NEXT_I + side])
    return found


def observed_of(graph: Graph, node: int) -> list[int]:
    row, found = int(graph.memory['node_i'][node, tb.OBSERVED_LIST]), []
    while row >= 0:
        found.append(row)
        row = int(graph.memory['observed_i'][row, tb.OBS_NEXT])
    return found


@given(seeds, edits)
@settings(max_examples=60)
def test_after_any_edits_chi2_is_that_of_the_rows(
    seed: int, steps: list[tuple[str, int, float]],
) -> None:
    graph = random_graph(seed)
    edited(graph, steps, np.random.default_rng(seed))
    assert graph.memory['scalars'][tb.CHI2] == pytest.approx(chi2(graph), rel=1e-9, abs=1e-6)


@given(seeds, edits)
@settings(max_examples=60)
def test_each_constraint_with_a_weight_is_once_in_the_lists_of_its_nodes(
    seed: int, steps: list[tuple[str, int, float]],
) -> None:
    graph = random_graph(seed)
    edited(graph, steps, np.random.default_rng(seed))
    edges, observed = graph.edges, graph.observed
    for node in range(graph.n_nodes):
        assert sorted(edges_of(graph, node)) == np.flatnonzero(
            ((edges.i == node) | (edges.j == node)) & (edges.weight > 0.0)).tolist()
        assert sorted(observed_of(graph, node)) == np.flatnonzero(
            (observed.node == node) & (observed.weight > 0.0)).tolist()


def test_a_weight_of_zero_removes_a_constraint_and_another_brings_it_back() -> None:
    graph = random_graph(8)
    before, whole = snapshot(graph), chi2(graph)
    graph.apply(GraphUpdate(remove_edges=range(graph.n_edges),
                            remove_observed=range(graph.n_observed)))
    assert chi2(graph) == 0.0
    scales = graph.memory['node_f'][:graph.n_nodes, [tb.SCALE_T, tb.SCALE_R]]
    np.testing.assert_allclose(scales, 0.0, atol=1e-5)
    graph.apply(GraphUpdate(weigh_edges=dict.fromkeys(range(graph.n_edges), 1.0),
                            weigh_observed=dict.fromkeys(range(graph.n_observed), 1.0)))
    assert snapshot(graph) == before
    assert graph.memory['scalars'][tb.CHI2] == pytest.approx(whole)


def columns(edges: Edges) -> tuple[np.ndarray, ...]:
    none = Graph().observed
    return (np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.uint8), *edges.columns,
            *(np.ascontiguousarray(column) for column in (
                none.node.astype(np.int64), none.offset, none.mean, none.information,
                none.kind.astype(np.uint8), none.weight)))


def test_rows_are_added_all_or_none_and_the_answer_says_why() -> None:
    graph, rng = random_graph(4), np.random.default_rng(4)
    graph.ensure(50, 50, 50)
    head, before = graph.memory.head, snapshot(graph)
    good = random_edges(rng, [0, 1], [2, 3])
    bad = Edges(good.i, good.j, good.mean, good.information * np.array([1.0, -1.0])[:, None, None],
                good.kind)
    for checked, edges, expected in (
            (False, bad, editing.UNSOUND),
            (False, random_edges(rng, [0], [graph.n_nodes]), editing.UNSOUND),
            (False, random_edges(rng, [0] * 10**3, [1] * 10**3), editing.NO_ROOM),
            (True, random_edges(rng, [0] * 10**3, [1] * 10**3), editing.NO_ROOM)):
        assert editing.add_rows(head, *columns(edges), checked) == expected
        assert snapshot(graph) == before
    assert editing.add_rows(head, *columns(good), False) == editing.ADDED
    assert graph.n_edges == len(graph.edges) == random_graph(4).n_edges + 2
