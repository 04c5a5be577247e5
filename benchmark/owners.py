# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What holds the memory of an object and of all that it refers to, by owner."""

from array import array
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from enum import Enum
from mmap import mmap
import sys
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np

DEPTH = 3
"""Names of attributes in the name of an owner."""
LEAVES = (str, bytes, bytearray, int, float, complex, bool, array, np.generic, Enum, mmap)
OTHERS = (type, ModuleType, FunctionType, BuiltinFunctionType)
"""What belongs to nobody."""


def holdings(root: Any) -> Counter[str]:
    """Return the number of bytes by owner: the first attributes on the way from an object."""
    found: Counter[str] = Counter()
    # what is nearer to the root owns what several refer to
    seen, level = {id(root)}, [('', root)]
    while level:
        further = []
        for owner, item in level:
            found[owner] += _size(item)
            for name, part in _parts(item):
                if id(part) not in seen and part is not None and not isinstance(part, OTHERS):
                    seen.add(id(part))
                    further.append((_joined(owner, name), part))
        level = further
    return found


def _joined(owner: str, name: str) -> str:
    if name == '' or (owner != '' and owner.count('.') + 1 >= DEPTH):
        return owner
    return f'{owner}.{name}' if owner else name


def _size(item: Any) -> int:
    if isinstance(item, np.ndarray):
        # a view owns nothing
        return sys.getsizeof(item) if item.base is None else 0
    return len(item) if isinstance(item, mmap) else sys.getsizeof(item)


def _parts(item: Any) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of what an object refers to; without a name what it contains."""
    if isinstance(item, LEAVES):
        return
    if isinstance(item, memoryview):
        yield '', item.obj
    if isinstance(item, np.ndarray):
        if item.base is not None:
            yield '', item.base
    elif isinstance(item, Mapping):
        for key, value in list(item.items()):
            yield '', key
            # names of streams and sources; other keys are too many to name
            yield (key if isinstance(key, str) else ''), value
    elif isinstance(item, list | tuple | set | frozenset | deque):
        for value in list(item):
            yield '', value
    elif isinstance(item, MethodType):
        yield '', item.__self__
    else:
        for name in _attributes(item):
            value = getattr(item, name, None)
            # tables that are mappings of arrays have names as well
            yield name.strip('_'), value


def _attributes(item: Any) -> list[str]:
    names = list(getattr(item, '__dict__', ()))
    for kind in type(item).__mro__:
        slots = kind.__dict__.get('__slots__', ())
        names += [slots] if isinstance(slots, str) else list(slots)
    return [name for name in names if not name.startswith('__')]
