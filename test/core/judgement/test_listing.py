# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is listed is bounded."""

from hypothesis import given, strategies as st

from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.judgement.fix_states import FixStates
from pose_graph_ros.core.judgement.judgements import MOST_OTHERS
from pose_graph_ros.core.judgement.verdicts import AUTO, BELIEVED, DOUBTED, OUT
from pose_graph_ros.core.sources.queued import Queued

UNSEEN = Factors.joined([])  # what a record does not look at

constraints = st.lists(st.tuples(st.integers(0, 2), st.booleans(), st.booleans()), max_size=40)


@given(constraints, st.integers(0, 5))
def test_the_newest_of_each_source_are_listed(
    constraints: list[tuple[int, bool, bool]], most: int,
) -> None:
    states, expected = FixStates(), []
    for number, (own, good, by_person) in enumerate(constraints):
        states.append(Queued(f'fix{own}', UNSEEN, number, number=number), 0,
                      BELIEVED if good else DOUBTED)
        states.decision[number] = OUT if by_person else AUTO
        later = sum(each[0] == own and each[1] == good and not each[2]
                    for each in constraints[number + 1:])
        if by_person or later < (most if good else MOST_OTHERS):
            expected.append(number)
    assert states.listed(most).tolist() == expected
    assert states.listed(None).tolist() == list(range(len(constraints)))
