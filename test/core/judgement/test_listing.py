# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is listed is bounded."""

from hypothesis import given, strategies as st
import numpy as np

from pose_graph_ros.core.judgement.verdicts import listed, MOST_OTHERS

constraints = st.lists(st.tuples(st.integers(0, 2), st.booleans(), st.booleans()), max_size=40)


@given(constraints, st.integers(0, 5))
def test_the_newest_of_each_source_are_listed(
    constraints: list[tuple[int, bool, bool]], most: int,
) -> None:
    source, believed, decided = np.array(constraints, dtype=int).reshape(-1, 3).T
    found = listed(source, believed > 0, decided > 0, most)
    expected = []
    for number, (own, good, by_person) in enumerate(constraints):
        later = sum(each[0] == own and each[1] == good and not each[2]
                    for each in constraints[number + 1:])
        if by_person or later < (most if good else MOST_OTHERS):
            expected.append(number)
    assert found.tolist() == expected
    assert listed(source, believed > 0, decided > 0, None).tolist() == list(range(len(source)))
