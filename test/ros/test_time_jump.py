# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Jumps back in time are detected, and late or wrong stamps are not taken for jumps."""

from hypothesis import given, strategies as st

from pose_graph_ros.ros.time_jump import Decision, EVIDENCE, ReceivedMessage, TimeJumpDetector

SECOND = 1_000_000_000


def odometry(seconds: float) -> ReceivedMessage:
    return ReceivedMessage('odom', seconds, round(seconds * SECOND), is_primary=True)


def fix(seconds: float) -> ReceivedMessage:
    return ReceivedMessage('fix', seconds, round(seconds * SECOND), is_primary=False)


def decide(
    time_jumps: TimeJumpDetector, messages: list[ReceivedMessage],
) -> tuple[list[object], list[int]]:
    """Return the released messages, and the number of them before each jump."""
    released, jumps = [], []
    for received in messages:
        result = time_jumps.receive(received)
        if result.jump_ns > 0:
            jumps.append(len(released))
        released += result.released
    return released, jumps


def lap(begin: float, seconds: float) -> list[ReceivedMessage]:
    return [odometry(begin + 0.1 * step) for step in range(round(10 * seconds))]


def test_a_bag_that_starts_again_is_a_jump_and_no_message_is_lost() -> None:
    time_jumps = TimeJumpDetector(SECOND)
    messages = []
    for _ in range(3):
        messages += lap(100.0, 10.0)
        messages.insert(len(messages) - 98, fix(100.05))  # among those that are held back
    released, jumps = decide(time_jumps, messages)
    assert released == messages
    assert jumps == [101, 202]


def test_the_length_of_a_jump_is_returned() -> None:
    time_jumps = TimeJumpDetector(SECOND)
    results = [time_jumps.receive(received) for received in lap(100.0, 10.0) + lap(95.0, 1.0)]
    assert [result.jump_ns for result in results if result.jump_ns > 0] == [
        round((109.9 - 95.0) * SECOND)]


@given(st.lists(st.floats(0.0, 0.9), min_size=20, max_size=200))
def test_stamps_that_are_late_by_less_than_the_threshold_are_no_jump(late: list[float]) -> None:
    time_jumps = TimeJumpDetector(SECOND)
    messages = [odometry(100.0 + 0.1 * step - delay) for step, delay in enumerate(late)]
    released, jumps = decide(time_jumps, messages)
    assert released == messages
    assert jumps == []


@given(st.integers(1, EVIDENCE - 1), st.booleans())
def test_a_few_stamps_of_the_past_are_no_jump(count: int, increasing: bool) -> None:
    time_jumps = TimeJumpDetector(SECOND)
    past = lap(50.0, 10.0)[:count]
    messages = lap(100.0, 5.0) + (past if increasing else past[::-1]) + lap(105.0, 5.0)
    released, jumps = decide(time_jumps, messages)
    assert released == messages
    assert jumps == []


def test_many_stamps_of_the_past_that_do_not_increase_are_no_jump() -> None:
    time_jumps = TimeJumpDetector(SECOND)
    messages = lap(100.0, 5.0) + lap(50.0, 3.0)[::-1] + lap(105.0, 5.0)
    released, jumps = decide(time_jumps, messages)
    assert released == messages
    assert jumps == []


def test_a_stamp_of_the_future_does_not_make_the_present_a_past() -> None:
    time_jumps = TimeJumpDetector(SECOND)
    messages = [*lap(100.0, 5.0), odometry(5000.0), *lap(105.0, 5.0)]
    released, jumps = decide(time_jumps, messages)
    assert released == messages
    assert jumps == []


def test_a_gap_is_no_jump_but_a_step_back_after_it_is() -> None:
    time_jumps = TimeJumpDetector(SECOND)
    messages = lap(100.0, 5.0) + lap(500.0, 5.0) + lap(100.0, 5.0)
    released, jumps = decide(time_jumps, messages)
    assert released == messages
    assert jumps == [100]


def test_after_a_jump_of_the_clock_queued_messages_of_the_old_time_are_old() -> None:
    time_jumps = TimeJumpDetector(SECOND)
    decide(time_jumps, lap(100.0, 60.0))
    time_jumps.clock_jumped(60 * SECOND)
    results = [time_jumps.receive(received) for received in (
        odometry(160.0), fix(159.8), odometry(100.0), fix(159.9), odometry(100.1), fix(100.1),
        fix(165.0))]
    assert [result.is_old for result in results] == [
        True, True, False, True, False, False, False]
    assert all(result.jump_ns == 0 for result in results)


def test_new_messages_that_came_before_the_callback_of_the_clock_are_kept() -> None:
    time_jumps = TimeJumpDetector(SECOND)
    decide(time_jumps, lap(100.0, 60.0))
    early = [odometry(100.0), fix(100.0), odometry(100.1)]
    assert decide(time_jumps, early) == ([], [])
    time_jumps.clock_jumped(60 * SECOND)
    assert time_jumps.release() == early
    released, jumps = decide(time_jumps, lap(100.2, 5.0))
    assert len(released) == 50
    assert jumps == []


def test_the_number_of_messages_that_are_held_back_is_limited() -> None:
    time_jumps = TimeJumpDetector(SECOND)
    messages = [*lap(100.0, 5.0), odometry(50.0), *(fix(105.0 + step) for step in range(500))]
    released, jumps = decide(time_jumps, messages)
    assert jumps == []
    assert len(released) == len(messages)


def test_another_primary_odometry_may_have_another_clock() -> None:
    time_jumps = TimeJumpDetector(SECOND)
    other = [received._replace(source='visual') for received in lap(50.0, 5.0)]
    messages = [*lap(100.0, 5.0), *other, *(received._replace(source='visual')
                                            for received in lap(50.0, 2.0))]
    released, jumps = decide(time_jumps, messages)
    assert released == messages
    assert jumps == [100]


def both(begin: float, seconds: float, later: float = 0.0) -> list[ReceivedMessage]:
    """Return two odometries in turn, before one of them is primary; the other may be later."""
    return [each for received in lap(begin, seconds) for each in (
        received, received._replace(source='visual', stamp_ns=received.stamp_ns + round(
            (0.01 + later) * SECOND)))]


@given(st.sampled_from([0.0, -3000.0, 3000.0]))
def test_two_odometries_that_start_again_before_one_is_primary_are_one_jump(later: float) -> None:
    time_jumps = TimeJumpDetector(SECOND)
    old, new = both(5000.0, 10.0, later), both(5000.0, 10.0, later)
    released, jumps = decide(time_jumps, old + new)
    assert jumps == [len(old)]
    assert released == old + new


@given(st.booleans())
def test_one_of_two_odometries_is_enough_for_a_jump_and_for_a_doubt(first: bool) -> None:
    source = 'odom' if first else 'visual'
    time_jumps = TimeJumpDetector(SECOND)
    decide(time_jumps, both(100.0, 5.0))
    sent = [odometry(50.0 + 0.1 * k)._replace(source=source) for k in range(EVIDENCE)]
    other = both(105.0, 5.0)[int(first)::2]
    assert {each.source for each in other} == {'visual' if first else 'odom'}
    for k, received in enumerate(sent[:-1]):
        assert time_jumps.receive(received) == Decision([])
        # the other goes on, which does not prove that the first was wrong
        assert time_jumps.receive(other[k]) == Decision([])
    decision = time_jumps.receive(sent[-1])
    assert decision.jump_ns > 54 * SECOND
    assert decision.released == sent    # what the other has sent is of the old time
    assert time_jumps.receive(other[EVIDENCE]).is_old


def test_an_odometry_that_is_not_primary_any_more_is_not_judged_by_what_it_sent_before() -> None:
    time_jumps = TimeJumpDetector(SECOND)
    decide(time_jumps, both(100.0, 5.0))
    visual = odometry(50.0)._replace(source='visual')
    messages = [*(visual._replace(is_primary=False) for _ in range(3)), *(
        visual._replace(stamp_ns=visual.stamp_ns + k) for k in range(2 * EVIDENCE))]
    assert decide(time_jumps, messages) == (messages, [])
