# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Prices of runs of measurements, and of odometry that jumps between two of them."""

import numpy as np
import pytest

from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.runs import Run, Transition
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.tracks import Track

SECOND = 1_000_000_000


def price(way: float, moved: float) -> float:
    """Return the price of two runs where odometry has gone so far and measurements so far [m]."""
    graph = Graph()
    information = np.diag((100.0, 100.0, 1e4))[None]
    graph.apply(GraphUpdate(hidden=np.zeros((2, 3)), fix=[0], edges=Edges(
        [0], [1], np.array(((way, 0.0, 0.0),)), information, [EdgeKind.ODOMETRY])))
    chain = OdometryChain()
    chain.extend(graph)
    cov = np.diag((0.2, 0.2, 0.01))
    before = Run(1, 0, Track(0, np.zeros(3), cov), believed=True)
    after = Run(2, SECOND, Track(1, np.array((moved, 0.0, 0.0)), cov), believed=False)
    after.n = BELIEF.least_members
    return after.ways_after(before, chain)[0].price


@pytest.mark.parametrize('jump', [6.0, 10.0, 20.0])
def test_a_jump_is_cheaper_where_the_positions_go_on(jump: float) -> None:
    # odometry goes too far, or the positions do
    slip, leap = price(1.0 + jump, 1.0), price(1.0, 1.0 + jump)
    assert BELIEF.event <= slip < leap


def test_a_jump_costs_more_the_farther_it_is_and_less_the_longer_the_way() -> None:
    far = [price(1.0, 1.0 + jump) for jump in (10.0, 20.0, 40.0, 100.0)]
    assert far == sorted(far)
    long = [price(way, way + 40.0) for way in (1.0, 10.0, 60.0)]
    assert long == sorted(long, reverse=True)
    # so that 40 m for 30 s after a minute without fixes do not win
    run = Run(1, 0, Track(0, np.zeros(3), np.eye(3)), believed=False)
    run.seconds = 30.0
    assert run.price < long[-1]


def test_ways_after_a_part_of_a_run_follow_the_states_that_stay() -> None:
    graph = Graph()
    graph.apply(GraphUpdate(hidden=np.zeros((6, 3)), fix=[0], edges=Edges(
        np.arange(5), np.arange(1, 6), np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)),
        np.full(5, EdgeKind.ODOMETRY))))
    chain = OdometryChain()
    chain.extend(graph)
    tracks = [Track(node, np.zeros(3), np.eye(3)) for node in range(6)]
    before = Run(1, 0, tracks[4], believed=True)
    before.states = [(node * SECOND, tracks[node]) for node in range(4)]
    after = Run(2, 5 * SECOND, tracks[5], believed=False)
    ways = [Transition(1.0), Transition(2.0, 1.0, 1), Transition(3.0, 1.0, 3)]
    after.prices[1] = ways
    after.states_left({1: before.carry(chain, np.array([1, 2]))})
    assert [track.node for _, track in before.states] == [0, 3]
    assert after.prices[1] == [ways[0], ways[2]._replace(cut=1)]
