# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Names of types that say the unit of a number; those of poses are in `geometry.se2`."""

import numpy as np
import numpy.typing as npt

NANOSECONDS = 1_000_000_000  # in a second
Metres = float
Radians = float
Seconds = float
StampNs = int  # nanoseconds since the epoch of the clock of the robot
StampsNs = npt.NDArray[np.int64]  # (N,) stamps
