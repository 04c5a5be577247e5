# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Trajectories in the TUM format: `stamp x y z qx qy qz qw` a line, stamps in seconds."""

from pathlib import Path

import numpy as np

from pose_graph_ros.core.geometry.trajectory import Trajectory

NANOSECONDS = 1_000_000_000


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """
    Write a trajectory; stamps and positions read back bit for bit, headings to rounding.

    Parameters
    ----------
    trajectory : Trajectory
    path : Path

    """
    path.write_text(tum_text(trajectory), encoding='ascii')


def tum_text(trajectory: Trajectory) -> str:
    """Return the text of a TUM file with a trajectory."""
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
