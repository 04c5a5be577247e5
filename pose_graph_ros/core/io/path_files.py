# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Text of files with a path in the map: KITTI, and a table with covariances (CSV)."""

from collections.abc import Iterator
import math

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.tum import PART, seconds_text

COLUMNS = 'stamp,x,y,yaw,xx,xy,xyaw,yy,yyaw,yawyaw'


def kitti_lines(path: Trajectory) -> Iterator[str]:
    """Yield a line for each pose: the upper three rows of its 4x4 matrix; there are no stamps."""
    for begin in range(0, len(path), PART):
        poses = path.poses[begin:begin + PART]
        cos, sin = np.cos(poses[:, 2]).tolist(), np.sin(poses[:, 2]).tolist()
        for (x, y, _), c, s in zip(poses.tolist(), cos, sin, strict=True):
            yield f'{c!r} {-s!r} 0 {x!r} {s!r} {c!r} 0 {y!r} 0 0 1 0'


def csv_lines(path: Trajectory, covariances: FloatArray) -> Iterator[str]:
    """
    Yield a header and a row for each pose: stamp [s], pose, upper triangle of its covariance.

    Parameters
    ----------
    covariances : ndarray, shape (N, 3, 3)
        In map axes [m, m, rad]; their cells are empty where they are NaN.

    """
    yield COLUMNS
    rows, columns = np.triu_indices(3)
    for begin in range(0, len(path), PART):
        part = slice(begin, begin + PART)
        for stamp, pose, upper in zip(
                path.stamps_ns[part].tolist(), path.poses[part].tolist(),
                covariances[part, rows, columns].tolist(), strict=True):
            numbers = [*map(repr, pose), *('' if math.isnan(x) else repr(x) for x in upper)]
            yield f'{seconds_text(stamp)},{",".join(numbers)}'
