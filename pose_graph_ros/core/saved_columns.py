# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Types of the columns of saved states.

Each part of the engine defines a plain dataclass `Saved...` of its own state. The arrays in it are
annotated with the types of this module, which `io` uses to read, check and write them.
"""

from enum import Enum, IntEnum
from typing import Annotated, NamedTuple

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Pose


class Column(NamedTuple):
    """Type and shape of the rows of an array."""

    kind: type
    shape: tuple[int, ...] = ()


class Choices(NamedTuple):
    """
    Members of an enumeration, as an array of numbers: values of an `IntEnum`, else positions.

    Files hold their names, so that the enumeration can grow and be sorted.
    """

    kind: type[Enum]

    @property
    def numbers(self) -> dict[str, int]:
        """Number of each member by its name in files."""
        return {member.name.lower(): int(member) if isinstance(member, IntEnum) else position
                for position, member in enumerate(self.kind)}


Integers = Annotated[IntArray, Column(int)]
Flags = Annotated[BoolArray, Column(bool)]
Numbers = Annotated[FloatArray, Column(float)]
Rows2 = Annotated[FloatArray, Column(float, (2,))]
Rows3 = Annotated[FloatArray, Column(float, (3,))]
Rows4 = Annotated[FloatArray, Column(float, (4,))]
Rows5 = Annotated[FloatArray, Column(float, (5,))]
Rows6 = Annotated[FloatArray, Column(float, (6,))]
Rows7 = Annotated[FloatArray, Column(float, (7,))]
Rows8 = Annotated[FloatArray, Column(float, (8,))]
Pairs = Annotated[IntArray, Column(int, (2,))]
Matrix = tuple[Pose, Pose, Pose]


def as_pose(numbers: FloatArray) -> Pose:
    """Return a pose, shape (3,), as plain numbers."""
    x, y, theta = numbers.tolist()
    return x, y, theta


def as_matrix(numbers: FloatArray) -> Matrix:
    """Return a matrix, shape (3, 3), as plain numbers."""
    first, second, third = numbers
    return as_pose(first), as_pose(second), as_pose(third)
