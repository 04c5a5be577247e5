# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The motion during a gap in odometry."""

import numpy as np
import pytest

from pose_graph_ros.core.odometry.gaps import (
    gap_motion,
    JUMP_SIGMA,
    RESTART_VARIANCE,
    RESTARTED,
    RESUMED_WITHIN,
)
from pose_graph_ros.core.odometry.jumps import MEMORY_TIME
from pose_graph_ros.core.odometry.timeline import next_row, OdometryTimeline

SECOND = 1_000_000_000
END = 5 * SECOND
# Standard deviations of x, y and yaw across a jump of a robot at rest.
SIGMA = (JUMP_SIGMA[0], JUMP_SIGMA[0], JUMP_SIGMA[1])


def timeline(speed: float, turn_rate: float = 0.0) -> OdometryTimeline:
    """Return samples of 5 s at 10 Hz; the robot stands for the first 4 s."""
    one = OdometryTimeline()
    for k in range(51):
        time = max(0.1 * k - 4.0, 0.0)
        one.append(next_row(
            one._last, k * SECOND // 10, (speed * time, 0.0, turn_rate * time)))
    return one


@pytest.mark.parametrize('gap', [0.5, 1.5, 2.0])
def test_the_robot_keeps_the_speed_that_it_had_before_a_gap(gap: float) -> None:
    mean, noise = gap_motion(timeline(3.0), END, END + round(gap * 1e9), -1)
    np.testing.assert_allclose(mean, [3.0 * gap, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(
        np.sqrt(np.diag(noise)), np.add([3.0 * gap, 3.0 * gap, 0.0], SIGMA))
    assert np.count_nonzero(noise - np.diag(np.diag(noise))) == 0


def test_in_a_long_gap_the_mean_ends_and_the_covariance_grows() -> None:
    mean, noise = gap_motion(timeline(3.0, 0.2), END, END + 60 * SECOND, -1)
    np.testing.assert_allclose(mean[2], 0.2 * MEMORY_TIME)
    np.testing.assert_allclose(np.sqrt(noise[0, 0]), JUMP_SIGMA[0] + 3.0 * 60.0, rtol=1e-6)
    np.testing.assert_allclose(np.sqrt(noise[2, 2]), JUMP_SIGMA[1] + 0.2 * 60.0, rtol=1e-6)


def test_a_single_sample_gives_no_speed() -> None:
    one = OdometryTimeline()
    one.append(next_row(None, END, (1.0, 2.0, 0.3)))
    mean, noise = gap_motion(one, END, END + SECOND, -1)
    np.testing.assert_array_equal(mean, 0.0)
    np.testing.assert_allclose(np.sqrt(np.diag(noise)), SIGMA)


@pytest.mark.parametrize('saved_ns', [END, END + SECOND])
def test_a_long_gap_at_the_end_of_a_loaded_graph_is_a_restart(saved_ns: int) -> None:
    limit_ns = END + round(RESUMED_WITHIN * 1e9)
    mean, noise = gap_motion(timeline(3.0), END, limit_ns + 1, saved_ns)
    np.testing.assert_array_equal(mean, 0.0)
    np.testing.assert_array_equal(noise, np.diag(RESTART_VARIANCE))
    np.testing.assert_allclose(np.sqrt(RESTART_VARIANCE), [*2 * RESTARTED[:1], RESTARTED[1]])
    # neither a short one nor one of samples that came since
    for until_ns, saved in ((limit_ns, saved_ns), (limit_ns + 1, END - 1)):
        mean, _ = gap_motion(timeline(3.0), END, until_ns, saved)
        np.testing.assert_allclose(mean, [3.0 * MEMORY_TIME, 0.0, 0.0], atol=1e-9)
