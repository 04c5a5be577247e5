# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Conversion of dataclasses and named tuples of numbers and arrays to JSON values, and back.

Decoding follows the annotations of the fields. Values of other types are rejected, as are numbers
that are not finite. Members of enumerations (`Choices`) become the names in use and, for each
row, the position of its name among these.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, MISSING
import math
from types import UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints, Union

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.saved_columns import Choices, Column

_KINDS = {int: ('i', np.int64), float: ('fi', np.float64), bool: ('b', np.bool_)}


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
    return value.tolist() if isinstance(value, np.ndarray) else value


def _has_fields(kind: Any) -> bool:
    return is_dataclass(kind) or hasattr(kind, '_fields')


def annotations(kind: Any) -> Mapping[str, Any]:
    """Return the annotations of the fields of a class."""
    return get_type_hints(kind, include_extras=True)


def decoded(kind: Any, plain: Any, where: str) -> Any:
    """
    Return the value that `encoded` was given, or raise ValueError if it is not of its kind.

    The message names the place, what was expected and what was found.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Annotated:
        read = _chosen if isinstance(arguments[1], Choices) else _array
        return read(arguments[1], plain, where)
    if origin in (UnionType, Union):     # of something and None
        return None if plain is None else decoded(arguments[0], plain, where)
    if origin is tuple:
        _expect(isinstance(plain, list), where, 'a list', plain)
        items = [arguments[0]] * len(plain) if arguments[-1] is Ellipsis else arguments
        _expect(len(plain) == len(items), where, f'{len(items)} items', plain)
        return tuple(decoded(item, each, where)
                     for item, each in zip(items, plain, strict=True))
    if origin is not None:      # a mapping of names
        _expect(isinstance(plain, dict), where, 'an object', plain)
        return {name: decoded(arguments[1], each, f'{where}.{name}')
                for name, each in plain.items()}
    if _has_fields(kind):
        _expect(isinstance(plain, dict), where, 'an object', plain)
        hints = annotations(kind)
        # a field with a default may be missing: older versions did not write it
        _expect(plain.keys() <= hints.keys() and plain.keys() >= hints.keys() - optional(kind),
                where, f'the fields {sorted(hints)}', plain)
        return kind(**{name: decoded(hint, plain[name], f'{where}.{name}'.lstrip('.'))
                       for name, hint in hints.items() if name in plain})
    return _single(kind, plain, where)


def optional(kind: Any) -> set[str]:
    """Return the names of the fields of a class that have a default."""
    if not is_dataclass(kind):
        return set(kind._field_defaults)
    return {item.name for item in fields(kind)
            if item.default is not MISSING or item.default_factory is not MISSING}


def _single(kind: type, plain: Any, where: str) -> Any:
    if kind is float and type(plain) is int:
        plain = float(plain) if abs(plain) < 2**63 else math.inf
    _expect(type(plain) is kind, where, f'a value of kind {kind.__name__}', plain)
    if kind is float:
        _expect(math.isfinite(plain), where, 'a finite number', plain)
    if kind is int:
        _expect(abs(plain) < 2**63, where, 'an integer of 64 bits', plain)
    return plain


def _chosen(choices: Choices, plain: Any, where: str) -> npt.NDArray[Any]:
    """Return the numbers of members of an enumeration, given by their names."""
    _expect(isinstance(plain, dict) and plain.keys() == {'names', 'of'}, where,
            "the fields ['names', 'of']", plain)
    names: tuple[str, ...] = decoded(tuple[str, ...], plain['names'], where)
    for name in names:
        _expect(name in choices.numbers, where, f'one of {", ".join(choices.numbers)}', name)
    of = _array(Column(int), plain['of'], where)
    _expect(not np.any((of < 0) | (of >= len(names))), where,
            f'positions among {len(names)} names', plain['of'])
    return np.array([choices.numbers[name] for name in names], dtype=np.int64)[of]


def _array(column: Column, plain: Any, where: str) -> npt.NDArray[Any]:
    """Return an array with any number of rows."""
    codes, dtype = _KINDS[column.kind]
    _expect(isinstance(plain, list), where, 'a list', plain)
    if len(plain) == 0:
        return np.empty((0, *column.shape), dtype=dtype)
    try:
        array = np.array(plain)
    except (ValueError, OverflowError) as error:
        raise ValueError(f'{where}: expected rows of equal length ({error})') from error
    _expect(array.dtype.kind in codes and array.shape[1:] == column.shape, where,
            f'{column.kind.__name__}s in rows of shape {column.shape}', plain)
    _expect(bool(np.all(np.isfinite(array))), where, 'finite numbers', plain)
    return array.astype(dtype)


def _expect(valid: bool, where: str, expected: str, plain: Any) -> None:
    if not valid:
        text = repr(plain)
        raise ValueError(f'{where}: expected {expected}, got '
                         f'{text if len(text) <= 60 else text[:60] + "..."}')
