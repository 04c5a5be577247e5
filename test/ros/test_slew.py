# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The published transform follows the estimate at a limited speed, at the robot."""


from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.ros.publishers import Slew

poses = st.tuples(st.floats(-500.0, 500.0), st.floats(-500.0, 500.0), st.floats(-3.0, 3.0)).map(
    np.array)
SECOND = 1_000_000_000


@given(st.tuples(poses, poses, poses, poses), st.floats(0.01, 2.0), st.floats(0.01, 2.0))
def test_the_robot_is_moved_no_faster_than_asked(
    some: tuple[np.ndarray, ...], linear: float, angular: float,
) -> None:
    before, after, then, now = some
    slew = Slew()
    slew.limited(SECOND, before, then, linear, angular)
    shown = se2.compose(before, now)
    moved = se2.compose(slew.limited(SECOND + SECOND // 10, after, now, linear, angular), now)
    wanted = se2.compose(after, now)
    step, whole = moved - shown, wanted - shown
    distance, turn = np.hypot(*whole[:2]), abs(se2.wrap(whole[2]))
    assert np.hypot(*step[:2]) == pytest.approx(min(distance, 0.1 * linear), abs=1e-9)
    assert abs(se2.wrap(step[2])) == pytest.approx(min(turn, 0.1 * angular), abs=1e-9)
