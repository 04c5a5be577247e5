# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reweighting by robust losses, in time independent of the graph."""


from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import random_graph
from saved_graphs import assert_same_value

from pose_graph_ros.core.config import Loss
from pose_graph_ros.core.graph import factors, reweighting
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import costs_and_weights, Reweighting

seeds = st.integers(0, 2**32 - 1)
some_losses = st.lists(
    st.tuples(st.sampled_from(Loss), st.floats(0.1, 10.0), st.floats(0.05, 1.0)),
    min_size=9, max_size=9)


def registered(chosen: list[tuple[Loss, float, float]], graph: Graph) -> Reweighting:
    """Return the last factors of a graph, edges and observed nodes, with these losses."""
    some = Reweighting()
    for number, (loss, threshold, base) in enumerate(chosen, graph.n_factors - len(chosen)):
        some.add(number, loss, threshold)
        some.set_base_weight(number, base)
    return some


def energies(graph: Graph) -> np.ndarray:
    """Return the energies without weights of all factors."""
    return factors.energies(graph.errors(graph.factors), graph.factors.information)


@given(seeds, some_losses, st.sampled_from([1.0, 4.0]))
@settings(max_examples=40)
def test_every_weight_is_that_of_the_loss_times_the_base_weight(
    seed: int, chosen: list[tuple[Loss, float, float]], widened: float,
) -> None:
    graph = random_graph(seed)
    some = registered(chosen, graph)
    found = some.all_changes(graph, widened)
    energy, first = energies(graph), graph.n_factors - len(chosen)
    expected = {
        row: base * float(costs_and_weights(
            loss, energy[row:row + 1], widened * threshold)[1][0])
        for row, (loss, threshold, base) in enumerate(chosen, first) if loss is not Loss.NONE}
    # all others have that weight already
    assert found == pytest.approx({k: v for k, v in expected.items() if v != 1.0})
    graph.apply(GraphUpdate(weigh=found))
    assert some.all_changes(graph, widened) == {}


@given(seeds, some_losses)
@settings(max_examples=40)
def test_with_the_cost_chi2_is_the_sum_of_the_robust_costs(
    seed: int, chosen: list[tuple[Loss, float, float]],
) -> None:
    graph = random_graph(seed)
    some = registered(chosen, graph)
    graph.apply(GraphUpdate(weigh=some.all_changes(graph)))
    energy = energies(graph)
    expected = float(np.sum(energy[:-len(chosen)]))
    for each, (loss, threshold, base) in zip(energy[-len(chosen):], chosen, strict=True):
        own = base if loss is not Loss.NONE else 1.0
        expected += own * float(costs_and_weights(loss, np.array([each]), threshold)[0][0])
    assert graph.energies().chi2 + some.cost(graph) == pytest.approx(expected)


def robust_edges(graph: Graph) -> Reweighting:
    some = Reweighting()
    for row in range(len(graph.factors.edges)):
        some.add(row, Loss.CAUCHY, 0.1)
    return some


def test_the_newest_are_reweighted_at_every_update_and_all_others_in_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reweighting, 'TUNING', reweighting.TUNING._replace(window=4))
    graph = random_graph(2, n_edges=20)     # with three duplicates
    some, seen = robust_edges(graph), []
    for _ in range(5):
        changed = sorted(some.changes(graph))
        assert len(changed) == 8
        assert changed[4:] == [19, 20, 21, 22]
        seen += changed[:4]
    # and from the beginning again
    assert np.bincount(seen).tolist() == [2] + 18 * [1]


def test_a_saved_state_goes_on_with_the_constraint_that_is_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reweighting, 'TUNING', reweighting.TUNING._replace(window=4))
    graph = random_graph(2, n_edges=20)
    one, other = robust_edges(graph), Reweighting()
    one.add(23, Loss.HUBER, 2.0)
    one.set_base_weight(23, 0.5)
    for _ in range(3):
        one.changes(graph)
    other.restore(one)
    assert_same_value(other, one)
    for _ in range(4):
        assert other.changes(graph) == one.changes(graph)
    # and it grows on
    for each in (one, other):
        each.add(24, Loss.CAUCHY, 1.0)
    assert_same_value(other, one)
