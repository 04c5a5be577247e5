# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Jumps of odometry: what is one, the speeds from which that follows, and what fills gaps."""

import math

from hypothesis import assume, given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.geometry.se2 import compose_one, wrap_one
from pose_graph_ros.core.odometry.motion import (
    is_jump,
    JUMP_SIGMA,
    LEAST_TIME,
    MEMORY_TIME,
    RESTART_VARIANCE,
    RESUMED_WITHIN,
    SLACK,
    Speeds,
    SpeedWindow,
    UNKNOWN,
)
from pose_graph_ros.core.odometry.timeline import next_row, OdometryTimeline

SECOND = 1_000_000_000
LIMIT = 60.0

rates = st.tuples(st.floats(0.0, 50.0), st.floats(0.0, 5.0))
speeds = st.one_of(st.just(UNKNOWN), st.builds(
    lambda recent, more: Speeds(
        (recent[0], 0.0, recent[1]), recent, (recent[0] + more[0], recent[1] + more[1])),
    rates, rates))
steps = st.tuples(st.floats(0.0, 500.0), st.floats(0.0, math.pi))
times = st.floats(1e-9, 20.0)
stated_speeds = st.floats()     # not finite ones, too


# --- Which steps are jumps -------------------------------------------------------------------

@given(speeds, steps, steps, times, stated_speeds)
def test_a_step_that_is_longer_than_a_jump_is_a_jump(
    before: Speeds, step: tuple[float, float], more: tuple[float, float], elapsed: float,
    stated: float,
) -> None:
    longer = step[0] + more[0], step[1] + more[1]
    assert (is_jump(before, longer, elapsed, stated, LIMIT)
            >= is_jump(before, step, elapsed, stated, LIMIT))


@given(speeds, steps, times, st.floats(0.0, 100.0), st.floats(0.0, 100.0))
def test_more_time_or_a_greater_stated_speed_makes_no_jump(
    before: Speeds, step: tuple[float, float], elapsed: float, stated: float, more: float,
) -> None:
    assume(not is_jump(before, step, elapsed, stated, LIMIT))
    assert not is_jump(before, step, elapsed + more, stated, LIMIT)
    assert not is_jump(before, step, elapsed, stated + more, LIMIT)
    assert not is_jump(before, step, elapsed, -stated - more, LIMIT)


@given(st.floats(0.0, LIMIT), st.floats(-6.0, 6.0), st.floats(0.001, 5.0))
def test_a_constant_speed_is_no_jump_at_any_period(
    speed: float, turn_rate: float, period: float,
) -> None:
    assume(abs(turn_rate) * period < math.pi)
    between = (speed * period, 0.0, turn_rate * period)
    step = between[0], abs(between[2])
    stamp_ns, pose = 1, (0.0, 0.0, 0.0)
    window = SpeedWindow(UNKNOWN, stamp_ns, pose)
    for _ in range(200):
        assert not is_jump(window.speeds, step, period, math.nan, LIMIT)
        stamp_ns, pose = stamp_ns + round(period * 1e9), compose_one(pose, between)
        window = window.moved(stamp_ns, pose, step)


@given(speeds, st.floats(0.1, 100.0), times, st.floats(0.0, 1e6))
def test_no_stated_speed_permits_more_than_the_limit(
    before: Speeds, limit: float, elapsed: float, stated: float,
) -> None:
    longest = SLACK[0] + limit * (elapsed + LEAST_TIME)
    assert is_jump(before, (1.001 * longest, 0.0), elapsed, stated, limit)
    assert not is_jump(UNKNOWN, (0.999 * longest, 0.0), elapsed, stated, limit)


# --- Speeds ----------------------------------------------------------------------------------

ORIGIN = (0.0, 0.0, 0.0)


@given(st.lists(rates, min_size=1, max_size=30))
def test_the_greatest_speed_stays_and_the_recent_one_decays(
    path: list[tuple[float, float]],
) -> None:
    window, stamp_ns, pose = SpeedWindow(UNKNOWN, 0, ORIGIN), 0, ORIGIN
    seen, recent = [], (0.0, 0.0)
    for step in path:
        stamp_ns += SECOND // 2
        pose = compose_one(pose, (step[0], 0.0, wrap_one(step[1])))
        window = window.moved(stamp_ns, pose, step)
        seen.append((step[0] / 0.5, step[1] / 0.5))
        decay = math.exp(-0.5 / MEMORY_TIME)
        recent = tuple(max(now, decay * one) for now, one in zip(seen[-1], recent, strict=True))
        assert window.speeds.greatest == pytest.approx(tuple(np.max(seen, axis=0)))
        assert window.speeds.recent == pytest.approx(recent)


END = 5 * SECOND
# Standard deviations of x, y and yaw across a jump of a robot at rest.
SIGMA = (JUMP_SIGMA[0], JUMP_SIGMA[0], JUMP_SIGMA[1])


def timeline(speed: float, turn_rate: float = 0.0) -> OdometryTimeline:
    """Return samples of 5 s at 10 Hz; the robot stands for the first 4 s."""
    one = OdometryTimeline()
    for k in range(51):
        time = max(0.1 * k - 4.0, 0.0)
        one.append(next_row(one._last, k * SECOND // 10, (speed * time, 0.0, turn_rate * time)))
    return one


@pytest.mark.parametrize('gap', [0.5, 1.5, 2.0])
def test_the_robot_keeps_the_speed_that_it_had_before_a_gap(gap: float) -> None:
    mean, noise = timeline(3.0).gap_motion(END, END + round(gap * 1e9), -1)
    np.testing.assert_allclose(mean, [3.0 * gap, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diag(noise)), np.add([3.0 * gap, 3.0 * gap, 0.0], SIGMA))
    assert np.count_nonzero(noise - np.diag(np.diag(noise))) == 0


def test_in_a_long_gap_the_mean_ends_and_the_covariance_grows() -> None:
    mean, noise = timeline(3.0, 0.2).gap_motion(END, END + 60 * SECOND, -1)
    np.testing.assert_allclose(mean[2], 0.2 * MEMORY_TIME)
    np.testing.assert_allclose(np.sqrt(noise[0, 0]), JUMP_SIGMA[0] + 3.0 * 60.0, rtol=1e-6)
    np.testing.assert_allclose(np.sqrt(noise[2, 2]), JUMP_SIGMA[1] + 0.2 * 60.0, rtol=1e-6)


@pytest.mark.parametrize('saved_ns', [END, END + SECOND])
def test_a_long_gap_at_the_end_of_a_loaded_graph_is_a_restart(saved_ns: int) -> None:
    limit_ns = END + round(RESUMED_WITHIN * 1e9)
    mean, noise = timeline(3.0).gap_motion(END, limit_ns + 1, saved_ns)
    np.testing.assert_array_equal(mean, 0.0)
    np.testing.assert_array_equal(noise, np.diag(RESTART_VARIANCE))
    np.testing.assert_allclose(np.sqrt(RESTART_VARIANCE), [1.0, 1.0, 0.3])
    # neither a short one nor one of samples that came since
    for until_ns, saved in ((limit_ns, saved_ns), (limit_ns + 1, END - 1)):
        mean, _ = timeline(3.0).gap_motion(END, until_ns, saved)
        np.testing.assert_allclose(mean, [3.0 * MEMORY_TIME, 0.0, 0.0], atol=1e-9)


def test_a_single_sample_gives_no_speed() -> None:
    one = OdometryTimeline()
    one.append(next_row(None, END, (1.0, 2.0, 0.3)))
    mean, noise = one.gap_motion(END, END + SECOND, -1)
    np.testing.assert_array_equal(mean, 0.0)
    np.testing.assert_allclose(np.sqrt(np.diag(noise)), SIGMA)
