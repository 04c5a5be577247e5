# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Messages are held back while time may begin again; none is lost, and none mixes two times."""

import itertools
from types import SimpleNamespace

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.measurements import OdometrySample, Position
from pose_graph_ros.core.odometry.time_keeper import TimeKeeper
from pose_graph_ros.ros import input as input_module
from pose_graph_ros.ros.input import PoseContinuity, ReceivedMessage, Senders, TimeJumps

SECOND = 1_000_000_000


class Topic:
    """Who publishes the odometry; the test says it."""

    def __init__(self, *publishers: bytes) -> None:
        self.publishers = set(publishers)

    def find(self, source: str) -> set[bytes]:
        return self.publishers


def made(*odometry: str, topic: Topic | None = None) -> TimeJumps:
    """Return it for a topic whose publisher is another each time, or a given one."""
    numbers = itertools.count()
    return TimeJumps(TimeKeeper(odometry or ('odom',), SECOND), Senders(
        (lambda _: {str(next(numbers)).encode()}) if topic is None else topic.find))


def odometry(seconds: float, source: str = 'odom') -> ReceivedMessage:
    return ReceivedMessage(source, seconds, OdometrySample(round(seconds * SECOND), np.zeros(3)))


def fix(seconds: float) -> ReceivedMessage:
    return ReceivedMessage('fix', seconds, Position(
        round(seconds * SECOND), np.zeros(2), np.eye(2), np.zeros(2)))


def decide(
    time_jumps: TimeJumps, messages: list[ReceivedMessage],
) -> tuple[list[tuple[str, object]], list[int]]:
    """Return the released messages, and the number of them before each new beginning."""
    released, jumps = [], []
    for received in messages:
        result = time_jumps.receive(received)
        if result.jump_ns > 0:
            jumps.append(len(released))
        released += sent(result.released)
    return released, jumps


def sent(messages: list[ReceivedMessage]) -> list[tuple[str, object]]:
    return [(each.source, each.message) for each in messages]


def lap(begin: float, seconds: float) -> list[ReceivedMessage]:
    return [odometry(begin + 0.1 * step) for step in range(round(10 * seconds))]


def test_a_bag_that_starts_again_is_a_jump_and_no_message_is_lost() -> None:
    messages = []
    for _ in range(3):
        messages += lap(100.0, 10.0)
        messages.insert(len(messages) - 98, fix(100.05))  # among those that are held back
    released, jumps = decide(made(), messages)
    assert released == sent(messages)
    assert jumps == [101, 202]


@given(st.lists(st.floats(0.0, 0.9), min_size=20, max_size=200))
def test_stamps_that_are_late_by_less_than_the_threshold_are_no_jump(late: list[float]) -> None:
    messages = [odometry(100.0 + 0.1 * step - delay) for step, delay in enumerate(late)]
    assert decide(made(), messages) == (sent(messages), [])


@given(st.integers(1, 10), st.booleans())
def test_stamps_of_the_past_for_less_than_a_second_are_no_jump(
    count: int, increasing: bool,
) -> None:
    past = lap(50.0, 10.0)[:count]
    messages = lap(100.0, 5.0) + (past if increasing else past[::-1]) + lap(105.0, 5.0)
    assert decide(made(), messages) == (sent(messages), [])


@pytest.mark.parametrize('back', [60, 600])
def test_after_a_jump_of_the_clock_queued_messages_of_the_old_time_are_old(back: int) -> None:
    time_jumps = made()
    decide(time_jumps, lap(100.0, 60.0))
    # also if the clock had run on for long without a message
    time_jumps.clock_jumped(back * SECOND, 100 * SECOND)
    results = [time_jumps.receive(received) for received in (
        odometry(160.0), fix(159.8), odometry(100.0), fix(159.9), odometry(100.1), fix(100.1),
        fix(165.0))]
    assert [result.is_old for result in results] == [True, True, False, True, False, False, False]
    assert all(result.jump_ns == 0 for result in results)


def test_new_messages_that_came_before_the_callback_of_the_clock_are_kept() -> None:
    time_jumps = made()
    decide(time_jumps, lap(100.0, 60.0))
    early = [odometry(100.0), fix(100.0), odometry(100.1)]
    assert decide(time_jumps, early) == ([], [])
    time_jumps.clock_jumped(60 * SECOND, 100 * SECOND)
    assert sent(time_jumps.release()) == sent(early)
    released, jumps = decide(time_jumps, lap(100.2, 5.0))
    assert len(released) == 50
    assert jumps == []


def test_of_two_odometries_messages_of_the_old_time_are_not_mixed_with_the_new() -> None:
    time_jumps, old = made('odom', 'visual'), []
    for seconds in np.arange(100.0, 105.0, 0.1):
        decide(time_jumps, [odometry(seconds), odometry(seconds, 'visual')])
    new = lap(50.0, 1.1)
    for step, received in enumerate(new[:-1]):
        assert decide(time_jumps, [received]) == ([], [])
        if step < 3:    # what was still in the queue
            old.append(odometry(105.0 + 0.1 * step, 'visual'))
            assert decide(time_jumps, old[-1:]) == ([], [])
    decision = time_jumps.receive(new[-1])
    assert decision.jump_ns > 54 * SECOND
    assert sent(decision.released) == sent(new)
    assert time_jumps.receive(odometry(105.3, 'visual')).is_old


LAP = lap(100.0, 5.0)
BURST = lap(50.0, 1.5)


def test_without_another_publisher_stamps_behind_are_refused_and_hold_nothing_back() -> None:
    topic = Topic(b'a')
    time_jumps = made(topic=topic)
    assert decide(time_jumps, LAP) == (sent(LAP), [])
    topic.publishers = {b'a', b'b'}     # one beside it, which has sent them
    decisions = [time_jumps.receive(each) for each in BURST]
    assert all(decision.released[0].refusal.reason == 'stamp_leap' for decision in decisions)
    assert decide(time_jumps, lap(105.0, 1.0)) == (sent(lap(105.0, 1.0)), [])
    # it is only now found out that the other one has gone
    topic.publishers = {b'b'}
    released, jumps = decide(time_jumps, BURST)
    assert (released, jumps) == (sent(BURST), [0])


def test_a_publisher_that_goes_on_where_another_ended_is_known_from_then_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(input_module, 'time', SimpleNamespace(monotonic=lambda: clock.now))
    topic = Topic(b'a')
    time_jumps = made(topic=topic)
    decide(time_jumps, LAP)
    topic.publishers, clock.now = {b'b'}, 1.0
    assert decide(time_jumps, lap(105.0, 1.0))[1] == []
    assert decide(time_jumps, BURST)[1] == []
    topic.publishers, clock.now = set(), 2.0    # what was in the queues when it ended
    assert decide(time_jumps, [*lap(106.0, 1.0), *BURST])[1] == []
    topic.publishers = {b'c'}
    assert decide(time_jumps, BURST)[1] == [0]
    # and so is the one with which time began again
    assert decide(time_jumps, lap(52.0, 1.0))[1] == []
    assert decide(time_jumps, lap(20.0, 1.5))[1] == []


@pytest.mark.parametrize('is_loaded', [False, True])
def test_preferred_odometry_that_comes_second_takes_no_graph_that_was_loaded_back(
    is_loaded: bool,
) -> None:
    time_jumps = made('odom', 'visual', topic=Topic(b'a'))
    time_jumps.senders.strangers_may = not is_loaded
    decide(time_jumps, [odometry(100.0, 'visual')])
    assert len(decide(time_jumps, BURST)[1]) == (not is_loaded)


def drive(
    continuity: PoseContinuity, *places: tuple[float, float], newest: float = 1e9,
) -> list[bool]:
    """Return whether an estimate can be propagated to places (seconds, x) along a line."""
    estimate = SimpleNamespace(stamp_ns=newest * 1e9)
    return [continuity.covers(estimate, OdometrySample(round(1e9 * at), np.array([x, 0.0, 0.0])))
            for at, x in places]


def test_no_estimate_is_propagated_over_a_jump_that_it_does_not_include() -> None:
    continuity = PoseContinuity(60.0)
    assert drive(continuity, *((step / 10.0, step / 10.0) for step in range(10, 50)),
                 newest=4.9) == 40 * [True]
    # a reset to the start
    assert drive(continuity, (5.0, 0.0), (5.1, 0.1), newest=4.9) == [False, False]
    assert drive(continuity, (5.2, 0.2), newest=5.0) == [True]


def test_a_map_that_was_loaded_is_not_propagated_to_odometry_of_hours_before() -> None:
    continuity = PoseContinuity(60.0, resumes=True)
    assert drive(continuity, (1.0, 0.0), (1.1, 0.1), newest=18_000.0) == [False, False]
    continuity = PoseContinuity(60.0, resumes=True)
    assert drive(continuity, (18_001.0, 0.0), newest=18_000.0) == [False]
    assert drive(continuity, (18_001.1, 0.1), newest=18_001.0) == [True]


def test_one_stamp_from_the_future_does_not_stop_the_output() -> None:
    continuity = PoseContinuity(60.0)
    assert drive(continuity, (1.0, 0.0), (1.1, 0.1), newest=1.1) == [True, True]
    assert drive(continuity, (31.0, 0.2), newest=1.1) == [False]
    # the engine has an estimate with that stamp, and later drops it
    assert drive(continuity, (1.2, 0.2), newest=31.0) == [True]
    assert drive(continuity, (1.3, 0.3), (1.4, 0.4), newest=1.2) == [True, True]
    # jumps are detected again
    assert drive(continuity, (1.5, 50.0), newest=1.4) == [False]
