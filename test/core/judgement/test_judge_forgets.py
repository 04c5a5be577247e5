# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What judgement keeps of nodes and constraints that have left the graph."""

from hypothesis import given, settings, strategies as st
import numpy as np
from test_consistency import Drive

from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.judgement.closures import ClosureTable
from pose_graph_ros.core.judgement.judgements import LEFT, UNKNOWN
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.verdicts import BELIEVED, DOUBTED, State, WAITING
from pose_graph_ros.core.sources.queued import Queued

UNSEEN = Factors.joined([])  # what a record does not look at

SECOND = 1_000_000_000
seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=15)
@given(seeds)
def test_the_motion_between_nodes_that_stay_is_known_as_before(seed: int) -> None:
    drive, chain, whole = Drive(seed, 30), OdometryChain(), OdometryChain()
    for each in (chain, whole):
        each.extend(drive.smoother.graph)
    left = np.array(drive.rows)
    while len(left) > 2:
        # from the beginning, and some from the middle
        gone = np.unique(np.append(left[:-1][:3], drive.rng.choice(left[:-1], 1)))
        chain.forget(gone)
        left = np.setdiff1d(left, gone)
        assert chain.nodes.tolist() == left.tolist()
        i, j = np.meshgrid(left, left)
        for one, other in zip(chain.between(i.ravel(), j.ravel()),
                              whole.between(i.ravel(), j.ravel()), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9)
        np.testing.assert_array_equal(chain.travel(left), whole.travel(left))
    drive.smoother.extend(np.array([1.0, 0.2, 0.1]), np.eye(3))
    for each in (chain, whole):
        each.extend(drive.smoother.graph)
    assert len(chain) == len(left) + 1
    ends = chain.nodes[[0]], chain.nodes[[-1]]
    for one, other in zip(chain.between(*ends), whole.between(*ends), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def added(states: ClosureTable, edges: range) -> None:
    for edge in edges:
        states.append(Queued('scan', UNSEEN, edge * SECOND, 0, number=edge), 0, WAITING)


def test_closures_that_have_left_are_counted_and_keep_their_names() -> None:
    states = ClosureTable(OdometryChain())
    added(states, range(10, 20))
    states.state[:] = [BELIEVED, DOUBTED] * 5
    assert states.numbers(np.array([10, 11, 12, 99])).tolist() == [0, 1, 2]
    states.select(np.arange(3, 10))
    assert len(states) == 7
    assert states.totals()['scan'][-2:] == (3, 1)
    assert states.totals()['scan'].counts == {
        State.WAITING: 0, State.BELIEVED: 3, State.WEAKLY_BELIEVED: 0, State.DOUBTED: 4}
    assert states.counts(0).tolist() == [0, 5, 0, 5]
    assert np.count_nonzero(states.in_graph) == 3
    assert states.find('scan/1') == LEFT
    assert states.name(states.find('scan/4')) == 'scan/4'
    assert states.find('scan/10') == UNKNOWN
    saved, again = states.saved(), ClosureTable(OdometryChain())
    again.restore(saved)
    for each in (states, again):
        added(each, range(30, 31))
        assert each.name(7) == 'scan/10'
        assert each.counts(0).tolist() == [1, 5, 0, 5]
        assert each.totals()['scan'][-2:] == (3, 1)
        assert each.find('scan/2') == LEFT
