# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is written after tuning is never surer than the drive proves."""

from helpers.noisy_drive import made
import pytest

from pose_graph_ros.core.config import BackendConfig, OdometrySource, POSITIONS
from pose_graph_ros.offline.tuning import drive_rows as dr
from pose_graph_ros.offline.tuning.fit import estimate, Fit
from pose_graph_ros.offline.tuning.held_out import proven, shown_variances
from pose_graph_ros.offline.tuning.likelihood import Role

GOOD = 0.002, 0.001, 2e-5, 2e-5


def found(seconds: int, **fixes: float) -> tuple[Fit, Fit]:
    """Return what is the most likely, and what of it is proven, beside good odometry."""
    odometry, positions = made(3, seconds, GOOD, **fixes)
    settings = OdometrySource()
    config = BackendConfig(odometry={'odom': settings}, measurements={'fix': POSITIONS})
    timeline, of = dr.timeline(odometry, settings), {'fix': dr.measured(positions)}
    fits = estimate({'odom': timeline}, of, config)
    rows = dr.drive_rows(timeline, of, config)
    return fits['odom'], proven(fits, shown_variances(rows, 1), float(seconds))['odom']


@pytest.mark.parametrize('fixes', [
    {'white': 0.003}, {'white': 0.003, 'slow': 0.3, 'tau': 100.0}])
def test_a_minute_of_smooth_fixes_does_not_prove_millimetres(fixes: dict[str, float]) -> None:
    likely, written = found(60, **fixes)
    assert likely.value(Role.WHITE, 0, likely.value(Role.CORRELATED, 0, 1.0)) < 0.02
    assert all(each.kept for each in written.found if each.parameter.role is not Role.ODOMETRY)


def test_a_source_that_keeps_more_than_was_found_is_not_outweighed_by_odometry() -> None:
    likely, written = found(60, white=0.003)
    for one, other in zip(likely.found, written.found, strict=False):
        assert other.value >= min(one.parameter.setting, one.high)
    assert all(each.kept for each in written.found)


def test_good_odometry_proves_in_a_long_drive_that_fixes_claim_too_much() -> None:
    likely, written = found(3000, white=0.5, claimed=5.0)
    size = written.value(Role.WHITE, 0, 1.0)
    assert likely.value(Role.WHITE, 0, 1.0) < size < 0.1
    assert size * 5.0**2 > 0.5**2


def test_noise_of_odometry_is_lowered_to_the_end_of_its_interval() -> None:
    likely, written = found(300, white=1.0)
    lowered = [(one, other) for one, other in zip(likely.found, written.found, strict=True)
               if one.parameter.role is Role.ODOMETRY and not other.kept]
    assert len(lowered) > 0
    assert all(one.value < one.high <= other.value < one.parameter.setting
               for one, other in lowered)
