# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From messages to measurements without a node: counts, reasons, and messages held back."""

from collections import Counter
from collections.abc import Iterator
import math
from types import SimpleNamespace as Space
from typing import Any

import harness
import pytest

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.ros import input as input_module
from pose_graph_ros.ros.input import Arrivals, Decision, Input, LONGEST_DOUBT

SECOND = 1_000_000_000


def odometry(seconds: float, x: float = 0.0) -> Any:
    return harness.odometry(seconds, x, 0.0, 0.0)


def pose(seconds: float, frame: str = 'map') -> Any:
    return harness.pose(seconds, 0.0, 0.0, 0.0, frame)


def fix(seconds: float, latitude: float = 48.1, status: int = 0) -> Any:
    message = harness.fix(seconds, latitude, 11.6)
    message.status.status = status
    return message


class Engine:
    """An inbox with a limit in place of the worker."""

    def __init__(self, limit: int = 1000) -> None:
        self.limit = limit
        self.posted: list[tuple[str, object]] = []

    def post(self, source: str, measurement: object) -> bool:
        if len(self.posted) >= self.limit:
            return False
        self.posted.append((source, measurement))
        return True


class Clock:
    """A monotonic clock that only the test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


class Given:
    """An input with the engine that it writes to."""

    def __init__(self, limit: int = 1000, **values: object) -> None:
        self.publishers = {b'first'}
        self.values = {name.replace('__', '.'): value for name, value in values.items()}
        self.input = Input(checked(self.values), lambda _: self.publishers)
        self.engine = Engine(limit)

    def receive(self, source: str, message: object) -> Decision:
        return self.input.receive(source, message)

    def use(self, source: str, message: object) -> None:
        """Do with a message what the node does, but for jumps of time."""
        for received in self.receive(source, message).released:
            self.input.post(received, self.engine.post)

    def rejected(self) -> dict[str, int]:
        return {f'{source}.{reason}': count
                for (source, reason), count in self.input.rejected.items()}


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    made = Clock()
    monkeypatch.setattr(input_module, 'time', made)
    return made


def not_finite(seconds: float) -> Any:
    return odometry(seconds, math.nan)


@pytest.mark.parametrize(('source', 'message', 'reason'), [
    ('odom', not_finite(2.0), 'not_finite'),
    ('odom', odometry(2.0, 1e30), 'too_large'),
    ('odom', odometry(2**31 - 2.0), 'stamp_out_of_range'),
    ('global_pose', pose(2.0, 'elsewhere'), 'wrong_frame'),
    ('fix', fix(2.0, status=-1), 'no_fix'),
    ('fix', fix(2.0, latitude=95.0), 'out_of_range'),
    ('fix', fix(0.0), 'zero_stamp'),
    ('fix', Space(header=fix(2.0).header), 'malformed'),
])
def test_an_unusable_message_is_counted_by_its_reason_and_logged_once(
    source: str, message: Any, reason: str, caplog: pytest.LogCaptureFixture,
) -> None:
    given = Given()
    for _ in range(3):
        given.use(source, message)
    assert given.input.arrivals[source].count == 3
    assert given.rejected() == {f'{source}.{reason}': 3}
    assert given.input.posted == 0
    given.input.watch(Counter(), {}, active=True)
    (sentence,) = caplog.messages
    assert sentence.startswith(f'{source}: {reason}: ')
    assert sentence.endswith('(logged once, counted in diagnostics)')


def test_a_full_inbox_is_a_reason_and_no_measurement(caplog: pytest.LogCaptureFixture) -> None:
    given = Given(limit=3)
    for step in range(5):
        given.use('odom', odometry(1.0 + 0.1 * step))
    assert given.input.posted == 3
    given.use('fix', fix(1.2))
    assert given.rejected() == {'odom.inbox_full': 2, 'fix.inbox_full': 1}
    assert given.input.reader.datum.plane is None
    given.input.watch(Counter(), {}, active=True)
    assert 'the solver does not keep up' in caplog.messages[0]


@pytest.mark.parametrize(('ahead', 'told'), [(100.0, True), (18.0, True), (3.0, False)])
def test_fixes_ahead_of_odometry_are_told_with_what_to_do(ahead: float, told: bool) -> None:
    given = Given()
    for step in range(200):
        given.use('odom', odometry(100.0 + 0.1 * step))
        if step % 5 == 0:
            given.use('fix', fix(100.0 + 0.1 * step + ahead))
    fixes = given.input.arrivals['fix']
    assert fixes.delay == pytest.approx(-ahead)
    assert (fixes.wrong != '') == told
    if told:
        assert f'stamps of fix are {ahead:.1f} s ahead of those of odom' in fixes.wrong
        assert 'fix.time_offset' in fixes.wrong
    given.input.reader.configure(checked({'fix.time_offset': -ahead}))
    given.use('fix', fix(120.0 + ahead))
    assert fixes.wrong == ''


def test_late_fixes_are_no_mistake_but_odometry_that_is_apart_is() -> None:
    given = Given(sources=['odom', 'visual', 'fix'], visual__type='odometry')
    for step in range(200):
        given.use('odom', odometry(100.0 + 0.1 * step))
        given.use('visual', odometry(70.0 + 0.1 * step))
        given.use('fix', fix(60.0 + 0.1 * step))
    (wrong,) = (each.wrong for each in given.input.arrivals.values() if each.wrong != '')
    assert 'visual are 30.0 s behind those of odom' in wrong


def test_messages_that_are_held_back_are_released_after_a_while(clock: Clock) -> None:
    given = Given()
    given.receive('odom', odometry(100.0))
    given.publishers = {b'second'}
    given.receive('odom', odometry(50.0))
    given.receive('fix', fix(50.1))
    clock.now += 0.9 * LONGEST_DOUBT
    assert given.input.release_overdue() == []
    clock.now += 0.2 * LONGEST_DOUBT
    assert [received.source for received in given.input.release_overdue()] == ['odom', 'fix']
    assert given.input.release_overdue() == []


def test_stamps_that_begin_again_are_told_with_what_to_do(clock: Clock) -> None:
    given = Given()
    for at in (*range(100, 105), *range(50, 60)):
        given.use('odom', odometry(float(at)))
        clock.now += 1.0
        given.input.watch(Counter({('odom', 'accepted'): given.input.posted}), {}, active=True)
    assert given.rejected() == {'odom.stamp_leap': 10}
    assert given.input.refused['odom'] == (
        'the newest 10 messages of odom were refused: stamp_leap (59.000 s is 45.0 s behind those '
        'before: if a new drive or loop of a bag is meant, call ~/reset, or play with --clock and '
        'use_sim_time; else mend the clock of its driver, or set odom.time_offset)')


def test_a_new_graph_forgets_all_but_what_is_held_back(caplog: pytest.LogCaptureFixture) -> None:
    given = Given()
    for step in range(20):
        given.use('odom', odometry(100.0 + 0.1 * step))
    given.use('fix', fix(101.0))
    given.use('fix', fix(101.0, status=-1))
    given.publishers = {b'second'}
    given.use('odom', odometry(50.0))
    frames = given.input.reader.frames
    given.input.watch(Counter(), {}, active=True)
    given.input.start_new_graph(checked(given.values))
    assert given.input.rejected == {}
    assert all(each == Arrivals(name, each.is_rare) for name, each in given.input.arrivals.items())
    assert (given.input.posted, given.input.is_streaming) == (0, False)
    assert given.input.reader.datum.plane is None
    assert given.input.reader.frames is frames
    assert [received.source for received in given.input.time_jumps.release()] == ['odom']
    # what was logged before is not logged again
    given.use('fix', fix(101.0, status=-1))
    given.input.watch(Counter(), {}, active=True)
    assert len(caplog.messages) == 1
