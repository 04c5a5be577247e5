# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Edits keep chi2 and lists as they follow from the rows; what leaves leaves no trace."""

from collections.abc import Callable

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import random_edges, random_graph, random_observed, random_poses, snapshot
from slow_smoother import differences, state

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

seeds = st.integers(0, 2**32 - 1)
edits = st.lists(st.tuples(
    st.sampled_from(['factor', 'fix', 'free', 'node']), st.integers(0, 10**6),
    st.sampled_from([0.0, 1e-9, 0.5, 1.0, 20.0])), max_size=12)


def edited(graph: Graph, steps: list[tuple[str, int, float]], rng: np.random.Generator) -> None:
    for what, number, value in steps:
        node = number % graph.n_nodes
        graph.apply({
            'factor': GraphUpdate(weigh={number % graph.n_factors: value}),
            'fix': GraphUpdate(fix=(node,)), 'free': GraphUpdate(free=(node,)),
            'node': GraphUpdate(
                hidden=random_poses(rng, 1), factors=Factors.joined([
                    random_edges(rng, [node], [graph.n_nodes]),
                    random_observed(rng, [graph.n_nodes])]))}[what])


def listed(graph: Graph) -> list[list[int]]:
    """Return the ids of the factors in the list of each node, sorted."""
    found = []
    for first in graph.node_records['factor_list'].tolist():
        factors, entry = [], first
        while entry >= 0:
            factors.append(int(graph.factor_ids[entry >> 2]))
            entry = int(graph.factor_records['next'][entry >> 2, entry & 3])
        found.append(sorted(factors))
    return found


@given(seeds, edits)
@settings(max_examples=60)
def test_after_any_edits_chi2_and_lists_are_those_of_the_rows(
    seed: int, steps: list[tuple[str, int, float]],
) -> None:
    graph = random_graph(seed)
    edited(graph, steps, np.random.default_rng(seed))
    factors = graph.factors
    assert graph.memory['scalars']['chi2'][0] == pytest.approx(
        graph.energies().chi2, rel=1e-9, abs=1e-6)
    assert listed(graph) == [
        np.flatnonzero(((factors.i == node) | (factors.j == node))
                       & (factors.weight > 0.0)).tolist()
        for node in range(graph.n_nodes)]


# --- what leaves leaves no trace in the tables, and its id never comes back ---------------------

def graph_of(seed: int) -> Graph:
    """Return a graph with biases, some constraints of which have the weight 0."""
    graph, rng = random_graph(seed, n_nodes=9, n_biases=3), np.random.default_rng(seed)
    graph.apply(GraphUpdate(
        remove=rng.choice(graph.n_factors, 6, replace=False).tolist(), fix=(2,)))
    return graph


def leaving(graph: Graph, rng: np.random.Generator) -> GraphUpdate:
    nodes, factors = (
        rng.choice(ids, min(len(ids), int(rng.integers(0, 5))), replace=False).tolist()
        for ids in (graph.node_ids, graph.factor_ids))
    return GraphUpdate(remove_nodes=nodes, drop=factors)


@given(seeds)
@settings(max_examples=60)
def test_the_graph_is_the_one_that_what_is_left_would_make(seed: int) -> None:
    graph, rng = graph_of(seed), np.random.default_rng(seed)
    for _ in range(3):
        before, update = graph.rows(), leaving(graph, rng)
        graph.apply(update)
        stays = ~np.isin(before.node_ids, update.remove_nodes)
        nodes = before.node_ids[stays]
        ends = before.factors.i, before.factors.j, before.factors.k
        factors = np.all(np.isin(ends, (*nodes, -1)), axis=0) & ~np.isin(
            before.factor_ids, update.drop)
        assert graph.node_ids.tolist() == nodes.tolist()
        assert graph.factor_ids.tolist() == before.factor_ids[factors].tolist()
        assert graph.next_ids == before.next_ids
        for column, expected in zip(
                graph.factors.columns, before.factors.rows(factors).columns, strict=True):
            np.testing.assert_array_equal(column, expected)
        anew = Graph()
        anew.fill(before._replace(
            poses=before.poses[stays], node_kind=before.node_kind[stays],
            dimension=before.dimension[stays], fixed=before.fixed[stays],
            factors=before.factors.rows(factors), node_ids=nodes,
            factor_ids=before.factor_ids[factors]))
        assert snapshot(graph) == snapshot(anew)
        assert listed(graph) == listed(anew)
        assert graph.newest_pose == anew.newest_pose
        assert sorted(graph.node_ids[graph.memory['touched'][:graph.memory.head[
            tb.N_TOUCHED]]].tolist()) == nodes.tolist()
        if len(nodes) > 0:
            for field in ('scale_t', 'scale_r'):
                scales = (each.node_records[field] for each in (graph, anew))
                np.testing.assert_allclose(*scales, rtol=1e-6, atol=1e-5)
        assert graph.energies().chi2 == pytest.approx(anew.energies().chi2, rel=1e-12)


@given(seeds)
@settings(max_examples=25)
def test_new_rows_go_on_with_the_ids_and_find_the_nodes(seed: int) -> None:
    graph, rng = graph_of(seed), np.random.default_rng(seed)
    graph.apply(leaving(graph, rng)._replace(remove_nodes=[1, 11], drop=[0]))
    left, first = graph.node_ids[~graph.is_bias].tolist(), graph.next_ids
    i, j = rng.choice(left, 2, replace=False).tolist()
    factors = Factors.joined([random_edges(rng, [i, first.node], [first.node + 1, j]),
                              random_observed(rng, [first.node, i])])
    graph.apply(GraphUpdate(hidden=random_poses(rng, 2), factors=factors))
    assert graph.node_ids[-2:].tolist() == [12, 13] == [first.node, first.node + 1]
    assert graph.next_ids == (first.node + 2, first.factor + 4)
    found = graph.factors_at(first.factor + np.arange(4))
    assert (found.i.tolist(), found.j.tolist()) == (factors.i.tolist(), factors.j.tolist())
    poses = dict(zip(graph.node_ids.tolist(), graph.poses, strict=True))
    np.testing.assert_array_equal(graph.poses_of([j, 12]), [poses[j], poses[12]])
    assert graph.node_rows([1, 11, 99, -1]).tolist() == [-1] * 4
    assert graph.factor_rows(0) == -1


GONE: dict[str, tuple[Callable[[], GraphUpdate], str]] = {
    'fix': (lambda: GraphUpdate(fix=[3]), 'fix: hidden node 3 has left the graph'),
    'remove': (lambda: GraphUpdate(remove_nodes=[3]), 'remove_nodes: hidden node 3 has left'),
    'weigh': (lambda: GraphUpdate(weigh={0: 1.0}), 'weigh: factor 0 has left the graph'),
    'factor': (lambda: GraphUpdate(remove=[1]), 'remove: factor 1 has left the graph'),
    'end': (lambda: GraphUpdate(factors=random_edges(np.random.default_rng(0), [2, 4], [4, 3])),
            'Factors: hidden node 3 has left the graph; row 1'),
}


@pytest.mark.parametrize('name', GONE)
def test_an_id_that_has_left_is_refused_by_name(name: str) -> None:
    make, message = GONE[name]
    graph = random_graph(4, n_nodes=7)
    graph.apply(GraphUpdate(remove_nodes=[3], drop=[0, 1]))
    before = state(graph)
    with pytest.raises(GraphUpdateError, match=message):
        graph.apply(make())
    assert differences(before, state(graph)) == []


def test_within_an_update_rows_stay_and_a_rollback_brings_all_back() -> None:
    graph = graph_of(5)
    before = state(graph)
    graph.begin()
    graph.apply(GraphUpdate(remove_nodes=[0, 8, 10], drop=[3, 0]))
    assert graph.n_nodes == 12
    assert graph.newest_pose == 7
    assert graph.memory.head[tb.N_LEAVING] == 5
    graph.rollback()
    assert differences(before, state(graph)) == []
    assert graph.memory.head[tb.N_LEAVING] == 0
    graph.begin()
    factors = graph.factors
    graph.apply(GraphUpdate(remove_nodes=[0, 8]))
    left = graph.commit()
    assert left.nodes.tolist() == [0, 8]
    assert left.factors.tolist() == np.flatnonzero(
        np.isin(factors.i, [0, 8]) | np.isin(factors.j, [0, 8])).tolist()


def test_rows_are_filled_with_their_ids_which_must_ascend() -> None:
    graph = graph_of(7)
    first = graph.rows()
    graph.apply(GraphUpdate(remove_nodes=[1, 11], drop=[4]))
    copy = Graph()
    copy.fill(graph.rows())
    assert (snapshot(copy), copy.next_ids) == (snapshot(graph), graph.next_ids)
    assert copy.node_ids.tolist() == graph.node_ids.tolist()
    graph.apply(GraphUpdate(hidden=np.ones((2, 3)), fix=[13]))
    copy.fill(graph.rows().since(first.next_ids))
    assert snapshot(copy) == snapshot(graph)
    with pytest.raises(GraphUpdateError, match='node: expected ascending ids from 14 on'):
        copy.fill(graph.rows())
