# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sources that all is refused from: what is said, and for how long."""

from collections import Counter

from pose_graph_ros.ros.refusals import LEAST, PATIENCE, Refusals

NOTHING = {}


class Counts:
    """What a node has counted, with the time in seconds."""

    def __init__(self) -> None:
        self.refusals, self.now = Refusals(), 50.0
        self.received, self.counts, self.details = Counter(), Counter(), {}

    def add(self, source: str, answer: str, count: int = 1, detail: str = '') -> None:
        self.received[source] += count
        self.counts[source, answer] += count
        if answer != 'accepted':
            self.details[source, answer] = detail

    def said(self, seconds: float = 0.0) -> dict[str, str]:
        self.now += seconds
        return self.refusals.update(self.received, self.counts, self.details, self.now)


def test_a_source_from_which_nothing_was_ever_accepted() -> None:
    counts = Counts()
    assert counts.said() == NOTHING
    counts.add('odom', 'zero_stamp', LEAST - 1, 'got 0 ns')
    assert counts.said() == NOTHING
    counts.add('odom', 'zero_stamp', 15, 'got 0 ns')
    counts.add('odom', 'not_finite', 3, 'position (nan, 0)')
    counts.add('fix', 'accepted')
    assert counts.said() == {'odom': (
        '20 of 20 messages of odom were refused: 17 times zero_stamp (got 0 ns); '
        '3 times not_finite (position (nan, 0))')}
    counts.add('odom', 'accepted')
    assert counts.said() == NOTHING


def test_a_source_from_which_nothing_is_accepted_any_more() -> None:
    counts = Counts()
    counts.add('fix', 'no_fix', 7, 'no fix')
    counts.add('fix', 'accepted', 30)
    assert counts.said() == NOTHING
    counts.add('fix', 'no_fix', 9, 'no fix')
    assert counts.said() == NOTHING
    assert counts.said(PATIENCE + 0.1) == {
        'fix': 'the newest 9 messages of fix were refused: no_fix (no fix)'}
    # some of them are good
    counts.add('fix', 'no_fix', 9, 'no fix')
    counts.add('fix', 'accepted')
    assert counts.said() == counts.said(PATIENCE + 0.1) == NOTHING


def test_what_was_asked_for_and_what_is_no_refusal_is_not_said() -> None:
    counts = Counts()
    counts.add('fix', 'paused', 100, 'call ~/pause')
    counts.add('global_pose', 'accepted')
    counts.add('global_pose', 'thinned', 100, 'too close')
    counts.received['odom'] = counts.counts['odom', 'sorted'] = 100
    assert counts.said() == counts.said(PATIENCE + 0.1) == NOTHING
    counts.counts['set_pose', 'wrong_frame'] = 9
    counts.details['set_pose', 'wrong_frame'] = 'expected map'
    assert counts.said() == NOTHING
