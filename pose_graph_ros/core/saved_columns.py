# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the columns of saved states are.

Each part of the engine that has something to save has a plain dataclass for it, `Saved...`, beside
it. The arrays in these are annotated with what stands here, by which `io` reads, checks and writes
them.
"""

from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.motion import Pose
from pose_graph_ros.core.se2 import FloatArray, IntArray


class Column(NamedTuple):
    """What the rows of an array are."""

    kind: type
    shape: tuple[int, ...] = ()


Integers = Annotated[IntArray, Column(int)]
Flags = Annotated[npt.NDArray[np.bool_], Column(bool)]
Numbers = Annotated[FloatArray, Column(float)]
Rows3 = Annotated[FloatArray, Column(float, (3,))]
Rows4 = Annotated[FloatArray, Column(float, (4,))]
Rows6 = Annotated[FloatArray, Column(float, (6,))]
Rows7 = Annotated[FloatArray, Column(float, (7,))]
Rows8 = Annotated[FloatArray, Column(float, (8,))]
Pairs = Annotated[IntArray, Column(int, (2,))]
Matrix = tuple[Pose, Pose, Pose]


def as_pose(numbers: FloatArray) -> Pose:
    """Return three numbers as plain ones."""
    x, y, theta = numbers.tolist()
    return x, y, theta


def as_matrix(numbers: FloatArray) -> Matrix:
    """Return a matrix, shape (3, 3), in plain numbers."""
    first, second, third = numbers
    return as_pose(first), as_pose(second), as_pose(third)
