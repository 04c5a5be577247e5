# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Silent sources, and sources that all is refused from: both without a node."""

from collections import Counter

import numpy as np
import pytest

from pose_graph_ros.ros.input import Arrivals, EXPECTED, quiet, silent


class Sources(dict[str, Arrivals]):
    """Sources by name, which begin with their first message."""

    def __init__(self, rare: str = '') -> None:
        super().__init__()
        self.rare = rare

    def __missing__(self, source: str) -> Arrivals:
        self[source] = Arrivals(source, source == self.rare)
        return self[source]

    def silent(self, now: float) -> list[str]:
        return silent(self.values(), now)

    def quiet(self, now: float) -> float:
        return quiet(self.values(), now)

    def receive_all(self, source: str, start: float, end: float, period: float) -> None:
        for now in np.arange(start, end + 1e-9, period).tolist():
            self[source].receive(now)


def test_a_source_that_ends_before_another_is_silent() -> None:
    sources = Sources()
    sources.receive_all('fix', 0.0, 10.0, 1.0)
    sources.receive_all('odom', 0.0, 10.0, 0.02)
    assert sources.silent(10.0) == []
    sources.receive_all('odom', 10.0, 14.9, 0.02)
    assert sources.silent(14.9) == []
    # five of its own periods
    sources.receive_all('odom', 14.9, 20.0, 0.02)
    assert sources.silent(20.0) == ['fix']
    assert sources['fix'].at == 10.0
    sources['fix'].receive(20.1)
    assert sources.silent(20.2) == []


def reports(sources: Sources, source: str, times: list[float], end: float) -> int:
    """Return how often a source is newly silent while odometry goes on at 10 Hz."""
    count, said, left = 0, False, list(times)
    for now in np.arange(0.0, end, 0.1).tolist():
        sources['odom'].receive(now)
        while len(left) > 0 and left[0] <= now:
            sources[source].receive(left.pop(0))
        silent = source in sources.silent(now)
        count += silent and not said
        said = silent
    assert sources.silent(now) in ([], [source])
    return count


def test_a_sporadic_source_is_not_reported_after_each_message() -> None:
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.exponential(10.0, 150)).tolist()
    assert reports(Sources(), 'global_pose', times, 1200.0) <= 3
    # seen now and then, at a high rate: two silences are reported until that is its rhythm
    times = [start + 0.1 * step for start in range(0, 1200, 60) for step in range(100)]
    assert reports(Sources(), 'global_pose', times, 1200.0) <= 2
    # sent by hand: no rhythm at all
    assert reports(Sources(), 'global_pose', [5.0, 6.0, 8.0, 100.0], 300.0) == 0


def test_the_time_without_subscriptions_is_no_silence() -> None:
    sources = Sources()
    sources.receive_all('odom', 0.0, 10.0, 0.1)
    sources.receive_all('fix', 0.0, 10.0, 0.2)
    for each in sources.values():
        each.resume(300.0)
    assert sources.quiet(300.0) == 0.0
    sources.receive_all('odom', 300.1, 301.0, 0.1)
    assert sources.silent(301.0) == []
    assert 301.0 - sources['fix'].at == pytest.approx(291.0)
    sources.receive_all('odom', 301.1, 303.0, 0.1)
    # it does not come back
    assert sources.silent(303.0) == ['fix']
    assert sources['odom'].rate == pytest.approx(10.0)


def test_it_is_said_when_nothing_comes_at_all() -> None:
    sources = Sources('loop_closure')
    assert sources.quiet(1000.0) == 0.0
    sources['fix'].resume(5.0)  # from which nothing has ever come
    assert sources.quiet(1000.0) == 0.0
    sources['odom'].receive(0.0)
    assert sources.quiet(9.0) == 0.0
    assert sources.quiet(11.0) == 11.0
    sources.receive_all('odom', 11.0, 20.0, 0.1)
    sources['loop_closure'].receive(25.0)
    assert sources.quiet(32.0) == 0.0
    assert sources.silent(32.0) == ['odom']
    assert sources.quiet(36.0) == 11.0
    # slower than that
    slow = Sources()
    slow.receive_all('odom', 0.0, 200.0, 20.0)
    assert slow.quiet(280.0) == 0.0
    assert slow.quiet(320.0) == 120.0


NOTHING = {}


class Counts:
    """What a node has counted, with the time in seconds."""

    def __init__(self) -> None:
        self.sources, self.now = Sources(), 50.0
        self.counts, self.details = Counter(), {}

    def add(self, source: str, answer: str, count: int = 1, detail: str = '') -> None:
        self.sources[source].count += count
        self.counts[source, answer] += count
        if answer != 'accepted':
            self.details[source, answer] = detail

    def said(self, seconds: float = 0.0) -> dict[str, str]:
        self.now += seconds
        said = {name: each.refusal(self.counts, self.details, self.now)
                for name, each in self.sources.items()}
        return {name: sentence for name, sentence in said.items() if sentence != ''}


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
    counts.sources['odom'].count = counts.counts['odom', 'sorted'] = 100
    assert counts.said() == counts.said(EXPECTED.refused_for + 0.1) == NOTHING
    counts.counts['set_pose', 'wrong_frame'] = 9
    counts.details['set_pose', 'wrong_frame'] = 'expected map'
    assert counts.said() == NOTHING
