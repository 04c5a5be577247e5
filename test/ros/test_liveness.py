# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Silent sources, and jumps over which no estimate is propagated: both without a node."""

from types import SimpleNamespace

import numpy as np
import pytest

from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.ros.liveness import Liveness
from pose_graph_ros.ros.pose_continuity import PoseContinuity


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


def test_no_source_is_silent_if_all_have_ended() -> None:
    liveness = Liveness()
    receive_all(liveness, 'odom', 0.0, 10.0, 0.02)
    receive_all(liveness, 'fix', 0.0, 10.0, 0.2)
    assert liveness.silent(11.0) == liveness.silent(13.0) == liveness.silent(1000.0) == []


def test_a_source_without_a_period_is_never_silent() -> None:
    liveness = Liveness(rare=['loop_closure'])
    receive_all(liveness, 'odom', 0.0, 100.0, 0.1)
    receive_all(liveness, 'loop_closure', 0.0, 10.0, 0.1)
    assert liveness.silent(100.0) == []


@pytest.mark.parametrize('period', [0.01, 0.5, 3.0, 10.0, 60.0])
def test_a_source_of_any_period_is_not_silent_after_a_few_messages(period: float) -> None:
    slow = Liveness()
    for now in np.arange(0.0, 50.0 * period, min(period, 0.5)).tolist():
        slow.receive('odom', now)
        if now >= 10.0 * period:
            assert slow.silent(now) == []
        if abs(now / period - round(now / period)) < 1e-6:
            slow.receive('fix', now)


def test_a_silence_does_not_make_a_source_slow() -> None:
    liveness = Liveness()
    receive_all(liveness, 'odom', 0.0, 200.0, 0.1)
    receive_all(liveness, 'fix', 0.0, 10.0, 0.2)
    receive_all(liveness, 'fix', 190.0, 195.0, 0.2)
    assert liveness.silent(199.9) == ['fix']


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


def test_each_outage_of_a_regular_source_is_reported() -> None:
    times = np.arange(0.0, 1200.0, 0.2)
    for begin in (200.0, 700.0, 1190.0):
        times = times[(times < begin) | (times > begin + 20.0)]
    assert reports(Liveness(), 'fix', times.tolist(), 1200.0) == 3


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


def test_motion_at_the_speed_of_any_vehicle_is_no_jump() -> None:
    for speed in (0.3, 1.0, 30.0, 55.0):
        for period in (0.01, 0.1, 1.0):
            places = [(1.0 + step * period, speed * step * period) for step in range(50)]
            assert all(drive(PoseContinuity(60.0), *places)), (speed, period)
    # starting and braking as hard as a car can, 10 m/s^2
    places = [(1.0 + step * 0.05, 5.0 * (step * 0.05)**2) for step in range(60)]
    assert all(drive(PoseContinuity(60.0), *places))


def test_a_robot_is_not_faster_than_the_parameter_says() -> None:
    places = [(1.0 + step * 0.1, 0.5 * step) for step in range(20)]
    assert all(drive(PoseContinuity(60.0), *places))
    assert not any(drive(PoseContinuity(1.0), *places, newest=1.0)[1:])
    continuity = PoseContinuity(60.0)
    assert all(drive(continuity, *places[:10], newest=1.0))
    continuity.maximum_speed = 1.0
    assert not any(drive(continuity, *places[10:], newest=1.0))


def test_old_samples_and_no_estimate() -> None:
    continuity = PoseContinuity(60.0)
    assert drive(continuity, (2.0, 0.0), (1.0, 50.0), (2.0, 70.0), (2.1, 0.1)) == 4 * [True]
    assert not continuity.covers(None, OdometrySample(3_000_000_000, np.zeros(3)))


def test_one_stamp_from_the_future_does_not_stop_the_output() -> None:
    continuity = PoseContinuity(60.0)
    assert drive(continuity, (1.0, 0.0), (1.1, 0.1), newest=1.1) == [True, True]
    assert drive(continuity, (31.0, 0.2), newest=1.1) == [False]
    # the engine has an estimate with that stamp, and later drops it
    assert drive(continuity, (1.2, 0.2), newest=31.0) == [True]
    assert drive(continuity, (1.3, 0.3), (1.4, 0.4), newest=1.2) == [True, True]
    # jumps are detected again
    assert drive(continuity, (1.5, 50.0), newest=1.4) == [False]
