# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Saved states: the types of their columns, and their conversion to JSON values and back.

Each part of the engine defines a plain dataclass `Saved...` of its own state. The arrays in it are
annotated with the types of this module, which decoding follows. Members of enumerations
(`Choices`) become the names in use and, for each row, the position of its name among these. A
value that does not have the form of its annotation raises one of `MISMATCHES`.
"""

from collections.abc import Mapping
from dataclasses import is_dataclass
from enum import Enum, IntEnum
from types import UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints, NamedTuple, Union

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Pose

MISMATCHES = (AttributeError, LookupError, OverflowError, TypeError, ValueError)


class Column(NamedTuple):
    """Type and shape of the rows of an array."""

    kind: type
    shape: tuple[int, ...] = ()


class Records(NamedTuple):
    """Type of the rows of a `GrowingArray` with named columns."""

    dtype: np.dtype[Any]


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
Rows6 = Annotated[FloatArray, Column(float, (6,))]
Rows8 = Annotated[FloatArray, Column(float, (8,))]
Pairs = Annotated[IntArray, Column(int, (2,))]


def as_pose(numbers: FloatArray) -> Pose:
    """Return a pose, shape (3,), as plain numbers."""
    x, y, theta = numbers.tolist()
    return x, y, theta


def encoded(value: Any, kind: Any = None) -> Any:
    """Return a value as lists, dictionaries, strings and numbers."""
    if _has_fields(type(value)):
        return {name: encoded(getattr(value, name), hint)
                for name, hint in annotations(type(value)).items()}
    if isinstance(value, Mapping):
        return {key: encoded(item) for key, item in value.items()}
    if get_origin(kind) is Annotated and isinstance(choices := get_args(kind)[1], Choices):
        names = {number: name for name, number in choices.numbers.items()}
        used, which = np.unique(value, return_inverse=True)
        return {'names': [names[number] for number in used.tolist()], 'of': which.tolist()}
    if get_origin(kind) is Annotated and isinstance(get_args(kind)[1], Records):
        return {name: value[name].tolist() for name in value.values.dtype.names}
    if isinstance(value, tuple):
        return [encoded(each) for each in value]
    return value.tolist() if isinstance(value, np.ndarray) else value


def _has_fields(kind: Any) -> bool:
    return is_dataclass(kind) or hasattr(kind, '_fields') or hasattr(kind, 'ANNOTATIONS')


def annotations(kind: Any) -> Mapping[str, Any]:
    """Return the annotations of the fields of a class, which may have them as ANNOTATIONS."""
    own: Mapping[str, Any] | None = getattr(kind, 'ANNOTATIONS', None)
    return get_type_hints(kind, include_extras=True) if own is None else own


def decoded(kind: Any, plain: Any) -> Any:
    """Return the value that `encoded` was given."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        array = _array(arguments[1], plain)
        return arguments[0].of(array) if isinstance(arguments[1], Records) else array
    if origin in (UnionType, Union):     # of something and None
        return None if plain is None else decoded(arguments[0], plain)
    if origin is tuple:
        items = [arguments[0]] * len(plain) if arguments[-1] is Ellipsis else arguments
        return tuple(decoded(item, each) for item, each in zip(items, plain, strict=True))
    if origin is not None:      # a mapping of names
        return {name: decoded(arguments[1], each) for name, each in plain.items()}
    if _has_fields(kind):
        hints = annotations(kind)
        return kind(**{name: decoded(hints[name], each) for name, each in plain.items()})
    return kind(plain)


def _array(column: Choices | Column | Records, plain: Any) -> npt.NDArray[Any]:
    if isinstance(column, Records):
        rows = np.empty(len(plain[(column.dtype.names or ())[0]]), column.dtype)
        for name in rows.dtype.names or ():
            rows[name] = np.reshape(plain[name], rows[name].shape)
        return rows
    if isinstance(column, Column):
        return np.array(plain, dtype=column.kind).reshape(-1, *column.shape)
    numbers = [column.numbers[name] for name in plain['names']]
    return np.array(numbers, dtype=np.int64)[np.array(plain['of'], dtype=np.int64)]
