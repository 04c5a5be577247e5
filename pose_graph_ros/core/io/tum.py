# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories in the TUM format: `stamp x y z qx qy qz qw` a line, stamps in seconds."""

from pathlib import Path

import numpy as np

from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.trajectory import Trajectory

NANOSECONDS = 1_000_000_000


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory; stamps and positions read back bit for bit, headings to rounding."""
    path.write_text(tum_text(trajectory), encoding='ascii')


def tum_text(trajectory: Trajectory) -> str:
    """Return a trajectory as text."""
    lines = ['# timestamp tx ty tz qx qy qz qw']
    half = trajectory.poses[:, 2] / 2
    for stamp, (x, y, _), qz, qw in zip(
            trajectory.stamps_ns.tolist(), trajectory.poses.tolist(), np.sin(half).tolist(),
            np.cos(half).tolist(), strict=True):
        seconds, nanoseconds = divmod(abs(stamp), NANOSECONDS)
        sign = '-' if stamp < 0 else ''
        lines.append(
            f'{sign}{seconds}.{nanoseconds:09d} {x!r} {y!r} 0 0 0 {qz!r} {qw!r}')
    return '\n'.join(lines) + '\n'


def read_tum(path: Path) -> Trajectory:
    """
    Read a trajectory; height, roll and pitch are dropped.

    Raises
    ------
    FileFormatError
        Names the file and the line.

    """
    stamps, poses = [], []
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f'{path}: cannot be read as text ({error})') from error
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if len(words) == 0 or words[0].startswith('#'):
            continue
        try:
            stamp = np.int64(_nanoseconds(words[0]))
            x, y, _, qx, qy, qz, qw = (float(word) for word in words[1:])
        except (ValueError, OverflowError) as error:
            raise FileFormatError(
                f'{path}:{number}: expected "stamp x y z qx qy qz qw", got {line!r}') from error
        yaw = np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        if not np.all(np.isfinite((x, y, yaw))):
            raise FileFormatError(f'{path}:{number}: a number is not finite in {line!r}')
        if not any((qx, qy, qz, qw)):
            raise FileFormatError(f'{path}:{number}: the quaternion is zero in {line!r}')
        stamps.append(stamp)
        poses.append((x, y, float(yaw)))
    try:
        return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses).reshape(-1, 3))
    except ValueError as error:
        raise FileFormatError(f'{path}: {error}') from error


def _nanoseconds(text: str) -> int:
    """Parse seconds without going through a float, which would lose the nanoseconds."""
    whole, _, decimals = text.removeprefix('-').partition('.')
    if not whole.isdigit() or (decimals != '' and not decimals.isdigit()):
        return round(float(text) * NANOSECONDS)
    stamp = int(whole) * NANOSECONDS + int(decimals[:9].ljust(9, '0'))
    return -stamp if text.startswith('-') else stamp
