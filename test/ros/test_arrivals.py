# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Silent sources, and sources that all is refused from: both without a node."""

from collections import Counter

import numpy as np
import pytest

from pose_graph_ros.ros.arrivals import EXPECTED, Liveness, Refusals


def receive_all(liveness: Liveness, source: str, start: float, end: float, period: float) -> None:
    for now in np.arange(start, end + 1e-9, period).tolist():
        liveness.receive(source, now)


def test_a_source_that_ends_before_another_is_silent() -> None:
    liveness = Liveness()
    receive_all(liveness, 'fix', 0.0, 10.0, 1.0)
    receive_all(liveness, 'odom', 0.0, 10.0, 0.02)
    assert liveness.silent(10.0) == []
    receive_all(liveness, 'odom', 10.0, 14.9, 0.02)
    assert liveness.silent(14.9) == []
    # five of its own periods
    receive_all(liveness, 'odom', 14.9, 20.0, 0.02)
    assert liveness.silent(20.0) == ['fix']
    assert liveness.silence('fix', 12.5) == 2.5
    assert liveness.silence('imu', 12.5) is None
    liveness.receive('fix', 20.1)
    assert liveness.silent(20.2) == []


def reports(liveness: Liveness, source: str, times: list[float], end: float) -> int:
    """Return how often a source is newly silent while odometry goes on at 10 Hz."""
    count, said, left = 0, False, list(times)
    for now in np.arange(0.0, end, 0.1).tolist():
        liveness.receive('odom', now)
        while len(left) > 0 and left[0] <= now:
            liveness.receive(source, left.pop(0))
        silent = source in liveness.silent(now)
        count += silent and not said
        said = silent
    assert liveness.silent(now) in ([], [source])
    return count


def test_a_sporadic_source_is_not_reported_after_each_message() -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.exponential(10.0, 150)).tolist()
    assert reports(Liveness(), 'global_pose', times, 1200.0) <= 3
    # seen now and then, at a high rate: two silences are reported until that is its rhythm
    times = [start + 0.1 * step for start in range(0, 1200, 60) for step in range(100)]
    assert reports(Liveness(), 'global_pose', times, 1200.0) <= 2
    # sent by hand: no rhythm at all
    assert reports(Liveness(), 'global_pose', [5.0, 6.0, 8.0, 100.0], 300.0) == 0


def test_the_time_without_subscriptions_is_no_silence() -> None:
    liveness = Liveness()
    receive_all(liveness, 'odom', 0.0, 10.0, 0.1)
    receive_all(liveness, 'fix', 0.0, 10.0, 0.2)
    liveness.resume(300.0)
    assert liveness.quiet(300.0) == 0.0
    receive_all(liveness, 'odom', 300.1, 301.0, 0.1)
    assert liveness.silent(301.0) == []
    assert liveness.silence('fix', 301.0) == pytest.approx(291.0)
    receive_all(liveness, 'odom', 301.1, 303.0, 0.1)
    # it does not come back
    assert liveness.silent(303.0) == ['fix']
    assert liveness.rate('odom') == pytest.approx(10.0)


def test_it_is_said_when_nothing_comes_at_all() -> None:
    liveness = Liveness(rare=['loop_closure'])
    assert liveness.quiet(1000.0) == 0.0
    liveness.receive('odom', 0.0)
    assert liveness.quiet(9.0) == 0.0
    assert liveness.quiet(11.0) == 11.0
    receive_all(liveness, 'odom', 11.0, 20.0, 0.1)
    liveness.receive('loop_closure', 25.0)
    assert liveness.quiet(32.0) == 0.0
    assert liveness.silent(32.0) == ['odom']
    assert liveness.quiet(36.0) == 11.0
    # slower than that
    slow = Liveness()
    receive_all(slow, 'odom', 0.0, 200.0, 20.0)
    assert slow.quiet(280.0) == 0.0
    assert slow.quiet(320.0) == 120.0


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
    counts.add('odom', 'zero_stamp', EXPECTED.refusals - 1, 'got 0 ns')
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
    assert counts.said(EXPECTED.refused_for + 0.1) == {
        'fix': 'the newest 9 messages of fix were refused: no_fix (no fix)'}
    # some of them are good
    counts.add('fix', 'no_fix', 9, 'no fix')
    counts.add('fix', 'accepted')
    assert counts.said() == counts.said(EXPECTED.refused_for + 0.1) == NOTHING


def test_what_was_asked_for_and_what_is_no_refusal_is_not_said() -> None:
    counts = Counts()
    counts.add('fix', 'paused', 100, 'call ~/pause')
    counts.add('global_pose', 'accepted')
    counts.add('global_pose', 'thinned', 100, 'too close')
    counts.received['odom'] = counts.counts['odom', 'sorted'] = 100
    assert counts.said() == counts.said(EXPECTED.refused_for + 0.1) == NOTHING
    counts.counts['set_pose', 'wrong_frame'] = 9
    counts.details['set_pose', 'wrong_frame'] = 'expected map'
    assert counts.said() == NOTHING
