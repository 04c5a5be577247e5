# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Closures rest after failures: all failures of a drive are few."""

from hypothesis import given, settings, strategies as st
import numpy as np

from pose_graph_ros.core.judgement.beliefs import Retests
from pose_graph_ros.core.judgement.closure_states import ClosureStates
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.measurements import LoopClosure
from pose_graph_ros.core.sources.source_constraints import NewConstraint

EACH = np.arange(3)


def append(states: ClosureStates, n: int) -> None:
    states.append([NewConstraint(True, k, 'scan', k, LoopClosure, 0) for k in range(n)], 0)


def retests() -> tuple[Retests, ClosureStates]:
    states = ClosureStates()
    append(states, len(EACH))
    return Retests(states), states


@given(st.integers(1, 1000), st.integers(5, 50))
@settings(max_examples=20)
def test_one_that_always_fails_is_tried_ever_more_rarely(begin: int, step: int) -> None:
    (them, states), tries = retests(), 0
    for n_nodes in range(begin, begin + 20_000, step):
        if them.due(n_nodes, n_nodes)[1]:
            them.failed([1], n_nodes, n_nodes)
            tries += 1
    # the last waits are for two thirds more nodes each, the first ones for ten nodes and more
    assert 1 <= tries <= 40
    np.testing.assert_array_equal(states.failures, [0, tries, 0])


def test_those_that_take_turns_wait_for_another_closure() -> None:
    them, states = retests()
    for _ in range(BELIEF.most_turns):
        np.testing.assert_array_equal(them.due(0, 100), [True] * 3)
        them.thrown_out(EACH[1:])
    np.testing.assert_array_equal(them.due(0, 100), [True, False, False])
    append(states, 1)
    them.begin_turns()
    np.testing.assert_array_equal(them.due(0, 100), [True] * 4)
    states.drop(1)
    assert len(them.due(0, 100)) == 3


def test_after_a_failure_it_is_tested_when_the_graph_has_grown_or_it_is_asked_for() -> None:
    them, states = retests()
    them.failed(EACH, 1000, 1000)
    assert not np.any(them.due(0, 1019))
    assert np.all(them.due(0, 1020))
    them.failed(EACH, 1000, 1000)
    assert np.all(them.resting(1039))
    them.again([2])
    np.testing.assert_array_equal(them.resting(1000), [True, True, False])
    np.testing.assert_array_equal(states.failures, [2, 2, 2])
