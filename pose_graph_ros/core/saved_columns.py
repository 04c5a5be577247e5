# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Saved states: the types of their columns, and their conversion to JSON values and back.

Each part of the engine defines a plain dataclass `Saved...` of its own state. The arrays in it are
annotated with the types of this module, which decoding follows. A value that does not have the
form of its annotation raises one of `MISMATCHES`.
"""

from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from types import UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints, NamedTuple, Union

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Pose

MISMATCHES = (AttributeError, LookupError, OverflowError, TypeError, ValueError)


class Column(NamedTuple):
    """
    Type and shape of the rows of an array; None for any shape.

    A type with named fields is that of the records of a table.
    """

    kind: Any
    shape: tuple[int, ...] | None = ()


Integers = Annotated[IntArray, Column(int)]
Flags = Annotated[BoolArray, Column(bool)]
Numbers = Annotated[FloatArray, Column(float)]
Rows2 = Annotated[FloatArray, Column(float, (2,))]
Rows3 = Annotated[FloatArray, Column(float, (3,))]
Rows8 = Annotated[FloatArray, Column(float, (8,))]
Matrix = Annotated[FloatArray, Column(float, None)]


def as_pose(numbers: FloatArray) -> Pose:
    """Return a pose, shape (3,), as plain numbers."""
    x, y, theta = numbers.tolist()
    return x, y, theta


def encoded(value: Any, array: Callable[[Any], Any] = np.ndarray.tolist) -> Any:
    """Return a value as lists, dictionaries, strings, numbers and what `array` makes of arrays."""
    if isinstance(value, Mapping):
        return {key: encoded(item, array) for key, item in value.items()}
    # `Factors` and `GrowingArray` are their arrays
    value = getattr(value, 'records', getattr(value, 'values', value))
    if isinstance(value, np.ndarray):
        return array(value) if value.dtype.names is None else {
            name: array(value[name]) for name in value.dtype.names}
    if is_dataclass(value) or hasattr(value, '_fields'):
        return {name: encoded(getattr(value, name), array)
                for name in type(value).__annotations__}
    return [encoded(each, array) for each in value] if isinstance(value, tuple) else value


def decoded(kind: Any, plain: Any) -> Any:
    """Return the value that `encoded` was given."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        kind, shape = arguments[1]
        names = np.dtype(kind).names or ()
        array = np.empty(len(plain[names[0]]), kind) if names else np.array(plain, dtype=kind)
        for name in names:
            array[name] = np.reshape(plain[name], array[name].shape)
        if not all(np.all(np.isfinite(array[name])) for name in names or (...,)):
            raise ValueError('numbers that are not finite')     # are never written
        return arguments[0].of(array) if names else (
            array if shape is None else array.reshape(-1, *shape))
    if origin in (UnionType, Union):     # of something and None
        return None if plain is None else decoded(arguments[0], plain)
    if origin is tuple:
        items = [arguments[0]] * len(plain) if arguments[-1] is Ellipsis else arguments
        return tuple(decoded(item, each) for item, each in zip(items, plain, strict=True))
    if origin is not None:      # a mapping of names
        return {name: decoded(arguments[1], each) for name, each in plain.items()}
    if is_dataclass(kind) or hasattr(kind, '_fields'):
        hints = get_type_hints(kind, include_extras=True)
        return kind(**{name: decoded(hints[name], each) for name, each in plain.items()})
    return kind(plain)
