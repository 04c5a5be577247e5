# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories in the TUM format: `stamp x y z qx qy qz qw` a line, stamps in seconds."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pose_graph_ros.core.geometry.trajectory import Trajectory

NANOSECONDS = 1_000_000_000
PART = 10_000


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory; stamps and positions read back bit for bit, headings to rounding."""
    with path.open('w', encoding='ascii') as file:
        file.writelines(f'{line}\n' for line in _lines(trajectory))


def tum_text(trajectory: Trajectory) -> str:
    """Return the text of a TUM file with a trajectory."""
    return '\n'.join(_lines(trajectory)) + '\n'


def _lines(trajectory: Trajectory) -> Iterator[str]:
    yield '# timestamp tx ty tz qx qy qz qw'
    # in parts: a list of all numbers of a long path takes ten times its memory
    for begin in range(0, len(trajectory), PART):
        poses = trajectory.poses[begin:begin + PART]
        half = poses[:, 2] / 2
        for stamp, (x, y, _), qz, qw in zip(
                trajectory.stamps_ns[begin:begin + PART].tolist(), poses.tolist(),
                np.sin(half).tolist(), np.cos(half).tolist(), strict=True):
            yield f'{seconds_text(stamp)} {x!r} {y!r} 0 0 0 {qz!r} {qw!r}'


def seconds_text(stamp_ns: int) -> str:
    """Return a stamp [ns] in seconds, with all its digits."""
    seconds, nanoseconds = divmod(abs(stamp_ns), NANOSECONDS)
    return f'{"-" if stamp_ns < 0 else ""}{seconds}.{nanoseconds:09d}'
