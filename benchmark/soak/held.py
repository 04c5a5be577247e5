# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What an object of the engine holds in memory, found by following all that it refers to."""

from collections import Counter, deque
from collections.abc import Iterator
from functools import partial
import sys
import types
from typing import Any

import numpy as np

CODE = (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType)
"""What belongs to the program."""


def held(root: Any) -> Counter[str]:
    """Return the bytes that an object holds, by the names on the way to them."""
    seen, found = set[int](), Counter[str]()
    stack = [(root, '')]
    while stack:
        item, name = stack.pop()
        if isinstance(item, np.ndarray):
            while isinstance(item.base, np.ndarray):
                item = item.base    # whose memory a view keeps
        if isinstance(item, CODE) or id(item) in seen:
            continue
        seen.add(id(item))
        found[name] += item.nbytes if isinstance(item, np.ndarray) else sys.getsizeof(item)
        stack += [(each, f'{name}{step}') for step, each in _inside(item)]
    return found


def _inside(item: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(item, dict):
        yield from (('', key) for key in item)
        yield from (('[]', value) for value in item.values())
    elif isinstance(item, list | tuple | set | frozenset | deque):
        yield from (('[]', each) for each in item)
    elif isinstance(item, types.MethodType):
        yield '', item.__self__
    elif isinstance(item, partial):
        yield from (('', each) for each in (item.func, item.args, item.keywords))
    elif type(item).__module__.startswith('pose_graph_ros'):    # and not into libraries
        for name, value in getattr(item, '__dict__', {}).items():
            yield f'.{name}', value
        for kind in type(item).__mro__:
            slots = kind.__dict__.get('__slots__', ())
            for name in (slots,) if isinstance(slots, str) else slots:
                if name not in ('__dict__', '__weakref__') and hasattr(item, name):
                    yield f'.{name}', getattr(item, name)
