# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Stamps far from the newest one, ahead and behind."""

from hypothesis import given, strategies as st
import pytest

from pose_graph_ros.core.odometry.stamp_guard import EVIDENCE, StampGuard

SECOND = 1_000_000_000
EPOCH = 1_767_225_600 * SECOND
LIMIT = 10 * SECOND
FAR = 86_400 * SECOND


def guard(*, behind: bool) -> StampGuard:
    one = StampGuard(LIMIT, behind=behind)
    assert one.accepts(EPOCH)
    return one


@pytest.mark.parametrize('first', [1, EPOCH])
def test_the_first_stamp_is_accepted(first: int) -> None:
    one = StampGuard(LIMIT, behind=True)
    assert one.newest_ns == 0
    assert one.accepts(first)
    assert one.newest_ns == first


@given(st.lists(st.integers(-LIMIT, LIMIT), max_size=30), st.booleans())
def test_near_stamps_are_accepted_and_the_newest_is_kept(
    offsets: list[int], behind: bool,
) -> None:
    one, newest = guard(behind=behind), EPOCH
    for offset in offsets:
        stamp_ns = newest + offset
        assert one.accepts(stamp_ns)
        newest = max(newest, stamp_ns)
        assert one.newest_ns == newest


@pytest.mark.parametrize('jump', [LIMIT + 1, FAR, -LIMIT - 1, -FAR])
def test_far_stamps_are_accepted_only_after_several_in_a_row(jump: int) -> None:
    one = guard(behind=True)
    for _ in range(EVIDENCE):
        assert not one.accepts(EPOCH + jump)
        assert one.newest_ns == EPOCH
    assert one.accepts(EPOCH + jump)
    assert one.newest_ns == EPOCH + jump
    assert one.accepts(EPOCH + jump + SECOND)


def test_a_near_stamp_in_between_starts_the_count_again() -> None:
    one = guard(behind=True)
    for k in range(10):
        for _ in range(EVIDENCE):
            assert not one.accepts(EPOCH + FAR)
        assert one.accepts(EPOCH + k)


def test_without_behind_old_stamps_are_accepted_and_change_nothing() -> None:
    one = guard(behind=False)
    for _ in range(2 * EVIDENCE):
        assert one.accepts(EPOCH - FAR)
        assert one.newest_ns == EPOCH
    assert not one.accepts(EPOCH + FAR)


@given(st.lists(st.integers(1, 2 * FAR), max_size=40), st.integers(-FAR, FAR))
def test_a_shift_of_all_stamps_changes_no_answer(stamps: list[int], by_ns: int) -> None:
    one, other = guard(behind=True), guard(behind=True)
    other.shift(by_ns)
    assert other.newest_ns == EPOCH + by_ns
    for stamp in stamps:
        assert one.accepts(EPOCH + stamp) == other.accepts(EPOCH + stamp + by_ns)
        assert other.newest_ns == one.newest_ns + by_ns


def test_before_the_first_stamp_a_shift_does_nothing() -> None:
    one = StampGuard(LIMIT, behind=True)
    one.shift(FAR)
    assert one.newest_ns == 0
    assert one.accepts(EPOCH)
    one.shift(-2 * EPOCH)
    assert one.newest_ns == 1      # 0 would stand for no stamp


@pytest.mark.parametrize('newest', [0, EPOCH + FAR])
def test_after_a_reset_the_other_time_is_accepted(newest: int) -> None:
    one = guard(behind=True)
    for _ in range(EVIDENCE):
        assert not one.accepts(EPOCH + FAR)
    one.reset(newest)
    assert one.newest_ns == newest
    assert one.accepts(EPOCH + FAR)


def test_a_reset_starts_the_count_again() -> None:
    one = guard(behind=True)
    for _ in range(2):
        for _ in range(EVIDENCE):
            assert not one.accepts(EPOCH + FAR)
        one.reset(EPOCH)
