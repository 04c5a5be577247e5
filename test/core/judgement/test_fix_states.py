# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The counts of what is believed follow every change of the records."""

from hypothesis import given, settings, strategies as st
import numpy as np

from pose_graph_ros.core.judgement.fix_states import BELIEVED, FixStates, NEWEST, SOURCE
from pose_graph_ros.core.judgement.verdicts import SourceVerdicts, State
from pose_graph_ros.core.measurements import Position
from pose_graph_ros.core.sources.constraint_queue import NewConstraint


def counted(states: FixStates) -> dict[str, SourceVerdicts]:
    """Count all records, as the oracle of `totals`."""
    totals = {}
    for index, source in enumerate(states.sources):
        believed = states.records[states.records[:, SOURCE] == index, BELIEVED].tolist()
        totals[source] = SourceVerdicts(
            {State.BELIEVED: sum(believed), State.DOUBTED: len(believed) - sum(believed)}, 1.0,
            len(believed) > 0 and not any(believed[-NEWEST:]))
    return totals


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 2**32 - 1))
def test_totals_are_what_counting_all_records_gives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    states = FixStates()
    for _ in range(20):
        size = len(states)
        for k in range(size, size + int(rng.integers(5))):
            source = ('fix', 'other', 'third')[rng.integers(3)]
            states.append(NewConstraint(False, k, source, k, Position), run=0,
                          believed=bool(rng.integers(2)), distance=0.5, now_ns=0)
        for _ in range(2):
            some = np.flatnonzero(rng.random(len(states)) < rng.random())
            states.believe(some, believed=bool(rng.integers(2)), now_ns=1)
        assert states.totals() == counted(states)
        before = states.state()
        states.believe(np.arange(len(states)), believed=True, now_ns=2)
        states.set_state(*before)
        assert states.totals() == counted(states)
        if rng.random() < 0.4:
            states.undo(size)
        else:
            states.forget()
        assert states.totals() == counted(states)
    again = FixStates()
    again.restore(states.saved({}))
    assert again.totals() == counted(states)
