# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Closures that take turns rest: a drive ends."""

import numpy as np

from pose_graph_ros.core.judgement.beliefs import Retests
from pose_graph_ros.core.judgement.closure_states import ClosureStates
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.verdicts import WAITING
from pose_graph_ros.core.measurements import LoopClosure
from pose_graph_ros.core.sources.factor_builder import NewConstraint

EACH = np.arange(3)


def append(states: ClosureStates, n: int) -> None:
    for k in range(n):
        states.append(NewConstraint(k, 'scan', k, LoopClosure, 0), 0, WAITING)


def retests() -> tuple[Retests, ClosureStates]:
    states = ClosureStates()
    append(states, len(EACH))
    return Retests(states), states


def test_those_that_take_turns_wait_for_another_closure() -> None:
    them, states = retests()
    for _ in range(BELIEF.most_turns):
        np.testing.assert_array_equal(them.due(0, 100), [True] * 3)
        them.thrown_out(EACH[1:])
    np.testing.assert_array_equal(them.due(0, 100), [True, False, False])
    append(states, 1)
    them.begin_turns()
    np.testing.assert_array_equal(them.due(0, 100), [True] * 4)
    states.truncate(len(EACH))
    assert len(them.due(0, 100)) == 3
