# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Records of fixes can be taken back and saved."""

from hypothesis import given, settings, strategies as st
import numpy as np

from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.judgement.fix_states import FixStates
from pose_graph_ros.core.judgement.verdicts import BELIEVED, DOUBTED
from pose_graph_ros.core.sources.queued import Queued

UNSEEN = Factors.joined([])  # what a record does not look at


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 2**32 - 1))
def test_new_records_can_be_taken_back_and_all_can_be_saved(seed: int) -> None:
    rng, states = np.random.default_rng(seed), FixStates()
    for _ in range(20):
        size, before, totals = len(states), states.records.copy(), states.totals()
        for k in range(size, size + int(rng.integers(5))):
            source = ('fix', 'other', 'third')[rng.integers(3)]
            states.append(Queued(source, UNSEEN, k, number=k), 0,
                          (BELIEVED, DOUBTED)[rng.integers(2)], distance=0.5)
        if rng.random() < 0.4:
            states.truncate(size)
            np.testing.assert_array_equal(states.records, before)
            assert {name: states.totals()[name] for name in totals} == totals
        some = np.flatnonzero(rng.random(len(states)) < rng.random())
        states.believe(some, rng.random(len(some)) < rng.random())
        if rng.random() < 0.2:
            states.select(np.flatnonzero(rng.random(len(states)) < 0.8))
    again = FixStates()
    again.restore(states.saved())
    assert np.all(states.run == -1)
    np.testing.assert_array_equal(again.records, states.records)
    assert again.totals() == states.totals()
    for each in (states, again):
        each.append(Queued('fix', UNSEEN, 0, number=0), 0, BELIEVED)
    assert again.name(len(again) - 1) == states.name(len(states) - 1)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 2**32 - 1))
def test_records_are_found_by_the_ids_that_they_were_added_as(seed: int) -> None:
    rng, states = np.random.default_rng(seed), FixStates()
    ids = np.unique(rng.integers(0, 400, rng.integers(0, 200)))
    for number in ids.tolist():
        states.append(Queued('fix', UNSEEN, number, number=number), 0, BELIEVED)
    of = {number: k for k, number in enumerate(ids.tolist())}
    # mostly new ones, as after an update, and some that are old or not there
    wanted = rng.integers(rng.integers(0, 400), 401, rng.integers(0, 30))
    assert states.numbers_of(wanted).tolist() == [of.get(k, -1) for k in wanted.tolist()]
