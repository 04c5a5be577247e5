# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Noise of a made drive is found again, and what cannot be seen keeps its setting."""

from helpers.noisy_drive import made
import numpy as np
import pytest

from pose_graph_ros.core.config import BackendConfig, OdometrySource, POSITIONS
from pose_graph_ros.core.measurements import HeadingOnly, OdometrySample, Position
from pose_graph_ros.offline.tuning import drive_rows as dr
from pose_graph_ros.offline.tuning.fit import estimate, Fit
from pose_graph_ros.offline.tuning.likelihood import FIRST_MEASUREMENTS, Problem, Role


def found(odometry: list[OdometrySample], fixes: list[Position]) -> Fit:
    settings = OdometrySource()
    config = BackendConfig(odometry={'odom': settings}, measurements={'fix': POSITIONS})
    return estimate({'odom': dr.timeline(odometry, settings)}, {'fix': dr.measured(fixes)},
                    config)['odom']


@pytest.mark.parametrize('claimed', [1.0, 0.03, 5.0])
def test_white_errors_are_found_whatever_is_claimed(claimed: float) -> None:
    fit = found(*made(3, 300, claimed=claimed))
    variance = next(each for each in fit.found if each.parameter.role is Role.WHITE)
    assert variance.low * claimed**2 < 1.0 < variance.high * claimed**2
    assert variance.kept == (claimed == 1.0)
    assert variance.high < 1.6 * variance.low


def test_noise_of_odometry_is_found() -> None:
    sigmas = 0.3, 0.2, 0.05, 0.05
    fit = found(*made(2, 400, sigmas, white=0.3, claimed=0.3))
    for each in fit.found:
        if each.parameter.role is Role.ODOMETRY and not each.kept:
            assert each.low < sigmas[each.parameter.index] < each.high
    assert sum(not each.kept for each in fit.found) >= 2


def test_the_same_measurements_give_the_same_noise() -> None:
    odometry, fixes = made(5, 120)
    assert found(odometry, fixes) == found(odometry, fixes[::-1])


def test_headings_before_the_first_fix_do_not_hide_the_first_heading() -> None:
    odometry, fixes = made(6, 120)
    settings = OdometrySource()
    config = BackendConfig(odometry={'odom': settings}, measurements={'fix': POSITIONS})
    timeline, late = dr.timeline(odometry, settings), fixes[80:]
    # the map is turned by 0.4 - 1 from odometry
    compass = [HeadingOnly(each.stamp_ns, each.pose[2] - 0.6, 0.01) for each in odometry
               if each.stamp_ns < late[0].stamp_ns]
    assert len(compass) > FIRST_MEASUREMENTS
    headings = []
    for sources in ({'fix': dr.measured(late)},
                    {'fix': dr.measured(late), 'imu': dr.measured(compass)}):
        problem = Problem(
            dr.drive_rows(timeline, sources, config), dr.odometry_noise(settings)**2,
            np.tile([1.0, 0.0, 1.0, 1.0], (len(sources), 1)))
        problem.find_heading()
        headings.append(problem.heading)
    assert headings[0] == headings[1] != 0.0
