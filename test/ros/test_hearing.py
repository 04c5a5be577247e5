# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Who is silent, and where odometry cannot be carried on: both without a node."""

from types import SimpleNamespace

import numpy as np
import pytest

from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.ros.continuity import Continuity
from pose_graph_ros.ros.hearing import Hearing


def heard(hearing: Hearing, source: str, start: float, end: float, period: float) -> None:
    for now in np.arange(start, end + 1e-9, period).tolist():
        hearing.hear(source, now)


def test_who_ends_while_another_goes_on_is_silent() -> None:
    hearing = Hearing()
    heard(hearing, 'fix', 0.0, 10.0, 1.0)
    heard(hearing, 'odom', 0.0, 10.0, 0.02)
    assert hearing.silent(10.0) == []
    heard(hearing, 'odom', 10.0, 14.9, 0.02)
    assert hearing.silent(14.9) == []
    # five of its own periods
    heard(hearing, 'odom', 14.9, 20.0, 0.02)
    assert hearing.silent(20.0) == ['fix']
    assert hearing.silence('fix', 12.5) == 2.5
    assert hearing.silence('imu', 12.5) is None
    hearing.hear('fix', 20.1)
    assert hearing.silent(20.2) == []


def test_when_all_end_nobody_is_silent() -> None:
    hearing = Hearing()
    heard(hearing, 'odom', 0.0, 10.0, 0.02)
    heard(hearing, 'fix', 0.0, 10.0, 0.2)
    assert hearing.silent(11.0) == hearing.silent(13.0) == hearing.silent(1000.0) == []


def test_a_source_that_comes_when_it_comes_is_never_silent() -> None:
    hearing = Hearing(rare=['loop_closure'])
    heard(hearing, 'odom', 0.0, 100.0, 0.1)
    heard(hearing, 'loop_closure', 0.0, 10.0, 0.1)
    assert hearing.silent(100.0) == []


@pytest.mark.parametrize('period', [0.01, 0.5, 3.0, 10.0, 60.0])
def test_a_source_with_any_period_is_heard_after_a_few_messages(period: float) -> None:
    slow = Hearing()
    for now in np.arange(0.0, 50.0 * period, min(period, 0.5)).tolist():
        slow.hear('odom', now)
        if now >= 10.0 * period:
            assert slow.silent(now) == []
        if abs(now / period - round(now / period)) < 1e-6:
            slow.hear('fix', now)


def test_a_silence_does_not_make_a_source_slow() -> None:
    hearing = Hearing()
    heard(hearing, 'odom', 0.0, 200.0, 0.1)
    heard(hearing, 'fix', 0.0, 10.0, 0.2)
    heard(hearing, 'fix', 190.0, 195.0, 0.2)
    assert hearing.silent(199.9) == ['fix']


def drive(continuity: Continuity, *places: tuple[float, float], newest: float = 1e9) -> list[bool]:
    """Return whether an estimate is carried to places (seconds, x), along a line."""
    estimate = SimpleNamespace(stamp_ns=newest * 1e9)
    return [continuity.carries(estimate, OdometrySample(round(1e9 * at), np.array([x, 0.0, 0.0])))
            for at, x in places]


def test_nothing_is_carried_over_a_jump_until_an_estimate_knows_of_it() -> None:
    continuity = Continuity(60.0)
    assert drive(continuity, *((step / 10.0, step / 10.0) for step in range(10, 50)),
                 newest=4.9) == 40 * [True]
    # a reset to the start
    assert drive(continuity, (5.0, 0.0), (5.1, 0.1), newest=4.9) == [False, False]
    assert drive(continuity, (5.2, 0.2), newest=5.0) == [True]


def test_speeds_of_any_vehicle_are_carried() -> None:
    for speed in (0.3, 1.0, 30.0, 55.0):
        for period in (0.01, 0.1, 1.0):
            places = [(1.0 + step * period, speed * step * period) for step in range(50)]
            assert all(drive(Continuity(60.0), *places)), (speed, period)
    # starting and braking as hard as a car can, 10 m/s^2
    places = [(1.0 + step * 0.05, 5.0 * (step * 0.05)**2) for step in range(60)]
    assert all(drive(Continuity(60.0), *places))


def test_a_robot_is_not_faster_than_the_parameter_says() -> None:
    places = [(1.0 + step * 0.1, 0.5 * step) for step in range(20)]
    assert all(drive(Continuity(60.0), *places))
    assert not any(drive(Continuity(1.0), *places, newest=1.0)[1:])
    continuity = Continuity(60.0)
    assert all(drive(continuity, *places[:10], newest=1.0))
    continuity.maximum_speed = 1.0
    assert not any(drive(continuity, *places[10:], newest=1.0))


def test_old_samples_and_no_estimate() -> None:
    continuity = Continuity(60.0)
    assert drive(continuity, (2.0, 0.0), (1.0, 50.0), (2.0, 70.0), (2.1, 0.1)) == 4 * [True]
    assert not continuity.carries(None, OdometrySample(3_000_000_000, np.zeros(3)))


def test_one_stamp_from_the_future_does_not_stop_the_output() -> None:
    continuity = Continuity(60.0)
    assert drive(continuity, (1.0, 0.0), (1.1, 0.1), newest=1.1) == [True, True]
    assert drive(continuity, (31.0, 0.2), newest=1.1) == [False]
    # the engine has taken it, then it drops it
    assert drive(continuity, (1.2, 0.2), newest=31.0) == [True]
    assert drive(continuity, (1.3, 0.3), (1.4, 0.4), newest=1.2) == [True, True]
    # and jumps are seen again
    assert drive(continuity, (1.5, 50.0), newest=1.4) == [False]
