# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The source that contradicts the others is found, and none is blamed where all agree."""

from collections.abc import Callable, Iterator
from dataclasses import replace
import math
import re

from honest_drive import HonestDrive
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    MeasurementSource,
    OdometrySource,
    POSITIONS,
    WindowConfig,
)
from pose_graph_ros.core.disagreement import Disagreement
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.measurements import (
    HeadingOnly,
    Measurement,
    OdometrySample,
    Position,
    YawRate,
)

Events = Iterator[tuple[str, OdometrySample | Measurement]]
SECOND = 10**9


def headings(wrong: Callable[[float], float]) -> Callable[[HonestDrive], Events]:
    def made(drive: HonestDrive) -> Events:
        rng = np.random.default_rng(7)
        for stamp, pose in list(zip(drive.truth.stamps_ns, drive.truth.poses, strict=True))[::5]:
            yaw = wrong(float(pose[2])) + 0.02 * float(rng.standard_normal())
            yield 'imu', HeadingOnly(int(stamp), math.remainder(yaw, 2.0 * math.pi), 4e-4)
    return made


def rates(factor: float, sigma: float = 2e-3) -> Callable[[HonestDrive], Events]:
    def made(drive: HonestDrive) -> Events:
        rng = np.random.default_rng(7)
        true = np.diff(np.unwrap(drive.truth.poses[:, 2])) / 0.1
        for stamp, rate in zip(drive.truth.stamps_ns[:-1], true, strict=True):
            yield 'gyro', YawRate(int(stamp), float(factor * rate + sigma * rng.normal()))
    return made


def odometry(factor: float) -> Callable[[HonestDrive], Events]:
    """Return a second odometry, whose turns are wrong by a factor."""
    def made(drive: HonestDrive) -> Events:
        steps = se2.between(drive.odometry.poses[:-1], drive.odometry.poses[1:])
        pose = np.zeros(3)
        for stamp, step in zip(drive.odometry.stamps_ns[1:], steps, strict=True):
            pose = se2.compose(pose, step * (1.0, 1.0, factor))
            yield 'visual', OdometrySample(int(stamp), pose)
    return made


def found(
    *more: Callable[[HonestDrive], Events], seed: int = 1, times: float = 1.0,
    fixes: MeasurementSource = POSITIONS, window: float = 0.0, seconds: float = 90.0,
) -> Disagreement | None:
    drive = HonestDrive(seed, seconds=seconds, closures=0, times=times)
    events = [('fix' if isinstance(each, Position) else source, each)
              for source, each in drive.measurements()]
    for each in more:
        events += each(drive)
    backend, due = PoseGraphBackend(BackendConfig(
        odometry={'odom': OdometrySource(), 'visual': OdometrySource()},
        measurements={'fix': fixes}, window=WindowConfig(seconds=window))), 0
    for source, event in sorted(events, key=lambda event: event[1].stamp_ns):
        if isinstance(event, OdometrySample):
            backend.add_odometry(event, source)
        else:
            backend.add_measurement(event, source)
        if event.stamp_ns > due:
            due = event.stamp_ns + SECOND
            backend.update()
    poses = backend.graph.poses.copy()
    result = backend.disagreement()
    assert np.array_equal(poses, backend.graph.poses)
    return result


@pytest.mark.parametrize('seed', range(2))
def test_sources_that_agree_are_not_blamed(seed: int) -> None:
    assert found(headings(lambda yaw: yaw), rates(1.0), odometry(1.0), seed=seed) is None


@pytest.mark.parametrize(('wrong', 'source', 'words'), [
    ([headings(lambda yaw: yaw + 0.5 * math.pi)], 'imu',
     r'off by (89|90|91) .* add -1.5\d rad to imu.yaw_offset'),
    # beside another sensor that is right
    ([headings(lambda yaw: yaw - 0.35), rates(1.0)], 'imu',
     r'off by -(19|2[0-3]) .* add 0.3\d rad'),
    ([headings(lambda yaw: 0.5 * math.pi - yaw), rates(1.0)], 'imu', 'NED'),
    ([headings(lambda _: 0.3)], 'imu', 'do not change'),
    ([rates(0.0, 0.0)], 'gyro', 'does not turn'), ([rates(0.0, 0.02)], 'gyro', 'does not turn'),
    ([rates(-1.0)], 'gyro', 'the other way'),
    ([odometry(-1.0), rates(1.0)], 'visual', 'contradicts')])
def test_what_is_wrong_is_named_with_the_reason(
    wrong: list[Callable[[HonestDrive], Events]], source: str, words: str,
) -> None:
    result = found(*wrong)
    assert result is not None
    assert result.source == source
    assert re.search(words, result.text), result.text


def test_with_two_sources_it_is_said_that_either_may_be_wrong() -> None:
    result = found(times=8.0, fixes=replace(POSITIONS, correlation_time=0.0), seconds=150.0)
    assert result is not None
    assert 'fix contradicts odom, and no third source' in result.text


def test_with_a_window_the_source_is_named_as_well() -> None:
    result = found(rates(0.0), window=30.0, seconds=150.0)
    assert result is not None
    assert result.source == 'gyro'


def test_no_other_source_is_blamed_for_fixes_with_larger_errors_than_claimed() -> None:
    result = found(rates(1.0), headings(lambda yaw: yaw), times=8.0)
    assert result is None or result.source == 'fix'
