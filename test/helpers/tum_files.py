# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read the TUM files that the product writes."""

import math
from pathlib import Path

import numpy as np

from pose_graph_ros.core.geometry.trajectory import Trajectory


def read_tum(path: Path) -> Trajectory:
    """Read `stamp x y z qx qy qz qw` a line, the stamps to the nanosecond."""
    stamps, poses = [], []
    for line in path.read_text(encoding='ascii').splitlines():
        if line.startswith('#'):
            continue
        stamp, x, y, z, qx, qy, qz, qw = line.split()
        assert float(z) == float(qx) == float(qy) == 0.0
        assert abs(math.hypot(float(qz), float(qw)) - 1.0) < 1e-12
        seconds, _, nanoseconds = stamp.removeprefix('-').partition('.')
        assert len(nanoseconds) == 9
        stamps.append(int(seconds + nanoseconds) * (-1 if stamp.startswith('-') else 1))
        poses.append((float(x), float(y), 2.0 * np.arctan2(float(qz), float(qw))))
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses).reshape(-1, 3))
