# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A `GraphUpdate` is applied whole or not at all; a rollback reverts it bit for bit."""

from collections.abc import Callable

import numpy as np
import pytest
from random_graphs import random_edges, random_graph, random_observed, random_poses, snapshot

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.graph import editing
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

# A graph of seven nodes, 0 to 6, is edited here.
N_NODES = 7


ASYMMETRIC = np.eye(3) + np.array([[0.0, 0.1, 0.0], [0.0] * 3, [0.0] * 3])


def edge(
    i: object = (0,), j: object = (1,), mean: object = ((1.0, 0.0, 0.0),),
    information: object = (np.eye(3),), kind: object = (FactorKind.ODOMETRY,),
) -> GraphUpdate:
    return GraphUpdate(factors=Factors(i, j, mean, information, kind))


def edge_to_bias(bias: object) -> GraphUpdate:
    return GraphUpdate(biases=np.zeros((1, 3)), factors=Factors(
        [0], [N_NODES], np.zeros((1, 3)), [np.eye(3)], [FactorKind.BIAS], constants=bias))


def observed(
    node: object = (0,), offset: object = None, mean: object = ((1.0, 0.0, 0.0),),
    information: object = (np.eye(3),), kind: object = (FactorKind.GLOBAL_POSE,),
) -> GraphUpdate:
    return GraphUpdate(factors=Factors.on(node, offset, mean, information, kind))


# Invalid updates, with a pattern of the message: what was expected, and the value.
BAD_UPDATES = {
    'hidden_shape': (lambda: GraphUpdate(hidden=np.zeros((2, 2))), r'\(N, 3\).*\(2, 2\)'),
    'hidden_nan': (lambda: GraphUpdate(hidden=np.full((1, 3), np.nan)), 'finite'),
    'fix_outside': (lambda: GraphUpdate(fix=(7,)), r'fix.*0\.\.6.*7'),
    'fix_no_integer': (lambda: GraphUpdate(hidden=np.zeros((1, 3)), fix=(0.5,)), r'fix.*0\.5'),
    'weight_negative': (
        lambda: GraphUpdate(weigh={0: -0.1}), r'weigh.*not negative, got -0\.1.*0'),
    'weight_nan': (
        lambda: GraphUpdate(weigh={1: np.nan}), 'weigh.*finite.*nan.*number 1'),
    'edge_i_outside': (lambda: edge(i=[7]), r'Factors.*0\.\.6.*row 0: 7'),
    'edge_to_itself': (lambda: edge(i=[3], j=[3]), 'itself.*row 0: 3'),
    'edge_mean_nan': (lambda: edge(mean=[[np.nan, 0.0, 0.0]]), r'Factors\.mean.*finite.*nan'),
    'edge_information_asymmetric': (
        lambda: edge(information=[ASYMMETRIC]), r'Factors\.information.*symmetric.*row 0'),
    'edge_information_negative_beside_large': (
        lambda: edge(information=[np.diag([4e8, -100.0, 1.0])]),
        r'Factors\.information.*semidefinite.*row 0'),
    'edge_information_zero': (
        lambda: edge(information=[np.zeros((3, 3))]), r'Factors\.information.*row 0'),
    'edge_kind_unknown': (
        lambda: edge(kind=[len(FactorKind)]),
        'kind is none of ODOMETRY, LOOP_CLOSURE, BIAS, .*; row 0'),
    'observed_kind_unknown': (
        lambda: observed(kind=[255]), 'kind is none of .*, GLOBAL_POSE, .*; row 0: 255'),
    'edge_to_a_pose_as_a_bias': (
        lambda: edge(kind=[FactorKind.BIAS]),
        r'Factors\.j: .*kind BIAS to have bias .*; row 0: 1'),
    'edge_to_nothing': (
        lambda: edge(j=[-1]), r'Factors\.j: .*kind ODOMETRY to have pose .*; row 0: -1'),
    'observed_with_two_ends': (
        lambda: edge(kind=[FactorKind.POSITION]), r'Factors\.j: .*to have none .*; row 0: 1'),
    'edge_to_a_bias_of_another_kind': (
        lambda: edge(j=[7])._replace(biases=np.zeros((1, 3))),
        r'Factors\.j: .* to have pose .*row 0: 7'),
    'edge_bias_inf': (
        lambda: edge_to_bias([[0.0, 0.0, np.inf, 1.0]]), r'Factors\.constants.*finite.*inf'),
    'edge_second_row': (
        lambda: edge([0, 2], [1, 9], np.zeros((2, 3)), [np.eye(3)] * 2, [0, 0]), 'row 1: 9'),
    'observed_outside': (lambda: observed(node=[7]), r'Factors.*0\.\.6.*row 0: 7'),
    'observed_offset_inf': (
        lambda: observed(offset=[[0.0, np.inf, 0.0]]), r'constants.*finite.*inf'),
}


@pytest.mark.parametrize('name', BAD_UPDATES)
def test_of_a_bad_update_nothing_is_applied_and_it_says_why(name: str) -> None:
    make, message = BAD_UPDATES[name]
    graph, rng = random_graph(seed=1, n_nodes=N_NODES, fix=(2,)), np.random.default_rng(2)
    before = snapshot(graph)
    with pytest.raises(GraphUpdateError, match=message):
        graph.apply(make())
    good = GraphUpdate(fix=(1,), free=(2,), factors=Factors.joined([
        random_edges(rng, [6], [0]), random_observed(rng, [3])]))
    with pytest.raises(GraphUpdateError):
        graph.apply(good._replace(**{
            part: rows for part, rows in make()._asdict().items() if len(rows) > 0}))
    assert snapshot(graph) == before


def strided(array: np.ndarray) -> np.ndarray:
    return np.repeat(array, 2, axis=0)[::2]


def read_only(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array.flags.writeable = False
    return array


@pytest.mark.parametrize('odd', [
    strided, read_only, np.asfortranarray, np.ndarray.tolist, lambda array: array.astype(
        array.dtype.newbyteorder())], ids=['strided', 'read_only', 'fortran', 'lists', 'swapped'])
def test_whatever_the_arrays_are_like_the_rows_are_the_same(
    odd: Callable[[np.ndarray], object],
) -> None:
    rng = np.random.default_rng(10)
    hidden, factors = random_poses(rng, 3), Factors.joined([
        random_edges(rng, [0, 2, 1], [1, 0, 2]), random_observed(rng, [2, 0])])
    usual, other = Graph(), Graph()
    usual.apply(GraphUpdate(hidden=hidden, factors=factors))
    signatures = len(editing.add_rows.signatures)
    other.apply(GraphUpdate(hidden=odd(hidden), factors=Factors(*map(odd, factors.columns))))
    assert snapshot(other) == snapshot(usual)
    assert len(editing.add_rows.signatures) == signatures


@pytest.mark.parametrize('poses', [
    np.zeros((6, 3)), np.zeros((7, 2)), np.full((7, 3), np.inf)], ids=['few', 'flat', 'inf'])
def test_poses_that_do_not_fit_are_refused(poses: np.ndarray) -> None:
    graph = random_graph(seed=5, n_nodes=N_NODES)
    before = snapshot(graph)
    with pytest.raises(GraphUpdateError, match=r'\(7, 3\)'):
        graph.set_poses(poses)
    assert snapshot(graph) == before


def test_writing_to_what_leaves_the_graph_does_not_change_it() -> None:
    graph = random_graph(seed=6)
    before = snapshot(graph)
    with pytest.raises(ValueError, match='read-only'):
        graph.poses[0] = 0.0
    # copies
    for column in graph.factors.columns:
        column[0] = 1
    graph.fixed[0] = True
    assert snapshot(graph) == before


@pytest.mark.parametrize('make', [
    lambda: edge(i=[0.5]), lambda: edge(j=['1']), lambda: observed(node=[True]),
    lambda: edge(kind=[0.0])])
def test_numbers_of_nodes_and_kinds_are_never_rounded(make: Callable[[], GraphUpdate]) -> None:
    with pytest.raises(GraphUpdateError, match='expected integers, got'):
        make()


def test_what_is_not_in_the_graph_is_refused_by_its_id() -> None:
    graph = random_graph(seed=4)
    with pytest.raises(ValueError, match='hidden node 7 is not in the graph'):
        graph.poses_of([2, 7])
    with pytest.raises(ValueError, match='factor -1 is not in the graph'):
        graph.factors_at([-1])
    with pytest.raises(ValueError, match='factor 99 is not in the graph'):
        graph.factors_at(99)
