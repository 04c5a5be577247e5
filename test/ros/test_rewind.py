# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time that begins again is noticed, and nothing else is taken for it."""

from hypothesis import given, strategies as st

from pose_graph_ros.ros.rewind import EVIDENCE, Heard, Rewind

SECOND = 1_000_000_000


def odometry(seconds: float) -> Heard:
    return Heard('odom', seconds, round(seconds * SECOND), tells_time=True)


def fix(seconds: float) -> Heard:
    return Heard('fix', seconds, round(seconds * SECOND), tells_time=False)


def taken(rewind: Rewind, messages: list[Heard]) -> tuple[list[object], list[int]]:
    """Return what was released, and before how many of these time jumped back."""
    released, jumps = [], []
    for heard in messages:
        result = rewind.take(heard)
        if result.jump_ns > 0:
            jumps.append(len(released))
        released += result.released
    return released, jumps


def lap(begin: float, seconds: float) -> list[Heard]:
    return [odometry(begin + 0.1 * step) for step in range(round(10 * seconds))]


def test_a_bag_that_begins_again_is_noticed_and_nothing_is_lost() -> None:
    rewind = Rewind(SECOND)
    messages = []
    for _ in range(3):
        messages += lap(100.0, 10.0)
        messages.insert(len(messages) - 98, fix(100.05))  # among those that are in doubt
    released, jumps = taken(rewind, messages)
    assert released == messages
    assert jumps == [101, 202]


def test_the_jump_is_told_by_its_length() -> None:
    rewind = Rewind(SECOND)
    results = [rewind.take(heard) for heard in lap(100.0, 10.0) + lap(95.0, 1.0)]
    assert [result.jump_ns for result in results if result.jump_ns > 0] == [
        round((109.9 - 95.0) * SECOND)]


@given(st.lists(st.floats(0.0, 0.9), min_size=20, max_size=200))
def test_what_is_late_by_less_than_the_threshold_is_no_new_time(late: list[float]) -> None:
    rewind = Rewind(SECOND)
    messages = [odometry(100.0 + 0.1 * step - delay) for step, delay in enumerate(late)]
    released, jumps = taken(rewind, messages)
    assert released == messages
    assert jumps == []


@given(st.integers(1, EVIDENCE - 1), st.booleans())
def test_a_few_of_the_past_are_no_new_time(count: int, increasing: bool) -> None:
    rewind = Rewind(SECOND)
    past = lap(50.0, 10.0)[:count]
    messages = lap(100.0, 5.0) + (past if increasing else past[::-1]) + lap(105.0, 5.0)
    released, jumps = taken(rewind, messages)
    assert released == messages
    assert jumps == []


def test_many_of_the_past_that_do_not_go_on_are_no_new_time() -> None:
    rewind = Rewind(SECOND)
    messages = lap(100.0, 5.0) + lap(50.0, 3.0)[::-1] + lap(105.0, 5.0)
    released, jumps = taken(rewind, messages)
    assert released == messages
    assert jumps == []


def test_a_stamp_of_the_future_does_not_make_the_present_a_past() -> None:
    rewind = Rewind(SECOND)
    messages = [*lap(100.0, 5.0), odometry(5000.0), *lap(105.0, 5.0)]
    released, jumps = taken(rewind, messages)
    assert released == messages
    assert jumps == []


def test_odometry_that_is_away_for_a_while_goes_on() -> None:
    rewind = Rewind(SECOND)
    messages = lap(100.0, 5.0) + lap(500.0, 5.0) + lap(100.0, 5.0)
    released, jumps = taken(rewind, messages)
    assert released == messages
    assert jumps == [100]


def test_after_a_jump_of_the_clock_what_was_on_its_way_is_old() -> None:
    rewind = Rewind(SECOND)
    taken(rewind, lap(100.0, 60.0))
    rewind.clock_jumped(60 * SECOND)
    results = [rewind.take(heard) for heard in (
        odometry(160.0), fix(159.8), odometry(100.0), fix(159.9), odometry(100.1), fix(100.1),
        fix(165.0))]
    assert [result.is_old for result in results] == [
        True, True, False, True, False, False, False]
    assert all(result.jump_ns == 0 for result in results)


def test_what_came_before_the_jump_of_the_clock_was_told_is_kept_if_it_is_new() -> None:
    rewind = Rewind(SECOND)
    taken(rewind, lap(100.0, 60.0))
    early = [odometry(100.0), fix(100.0), odometry(100.1)]
    assert taken(rewind, early) == ([], [])
    rewind.clock_jumped(60 * SECOND)
    assert rewind.release() == early
    released, jumps = taken(rewind, lap(100.2, 5.0))
    assert len(released) == 50
    assert jumps == []


def test_a_doubt_without_an_end_holds_nothing_back_for_ever() -> None:
    rewind = Rewind(SECOND)
    messages = [*lap(100.0, 5.0), odometry(50.0), *(fix(105.0 + step) for step in range(500))]
    released, jumps = taken(rewind, messages)
    assert jumps == []
    assert len(released) == len(messages)


def test_another_odometry_that_tells_the_time_may_have_another_clock() -> None:
    rewind = Rewind(SECOND)
    other = [heard._replace(source='visual') for heard in lap(50.0, 5.0)]
    messages = [*lap(100.0, 5.0), *other, *(heard._replace(source='visual')
                                            for heard in lap(50.0, 2.0))]
    released, jumps = taken(rewind, messages)
    assert released == messages
    assert jumps == [100]
