# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What holds the memory of an object and of all that it refers to, by owner."""

from collections import Counter
from collections.abc import Iterator, Mapping
from enum import Enum
import gc
from mmap import mmap
import sys
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any

import numpy as np

DEPTH = 3
"""Names of attributes in the name of an owner."""
OTHERS = (type, ModuleType, FunctionType, BuiltinFunctionType, Enum)
"""What belongs to nobody."""


def holdings(root: Any) -> Counter[str]:
    """Return the number of bytes by owner: the first attributes on the way from an object."""
    found: Counter[str] = Counter()
    # what is nearer to the root owns what several refer to
    seen, level = {id(root)}, [('', root)]
    while level:
        further = []
        for owner, item in level:
            found[owner] += len(item) if isinstance(item, mmap) else (
                # a view owns nothing
                0 if getattr(item, 'base', None) is not None else sys.getsizeof(item))
            for name, part in _parts(item):
                if id(part) not in seen and part is not None and not isinstance(part, OTHERS):
                    seen.add(id(part))
                    named = name != '' and owner.count('.') + 1 < DEPTH
                    further.append((f'{owner}.{name}'.strip('.') if named else owner, part))
        level = further
    return found


def _parts(item: Any) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of what an object refers to; without a name what it contains."""
    if isinstance(item, np.ndarray):
        yield '', item.base
    elif isinstance(item, memoryview):
        yield '', item.obj
    elif isinstance(item, Mapping):
        for key, value in list(item.items()):
            # names of streams and sources; other keys are too many to name
            yield (key if isinstance(key, str) else ''), value
    else:
        names = list(getattr(item, '__dict__', ()))
        for kind in type(item).__mro__:
            slots = kind.__dict__.get('__slots__', ())
            names += [slots] if isinstance(slots, str) else list(slots)
        for name in names:
            if not name.startswith('__'):
                yield name.strip('_'), getattr(item, name, None)
        if len(names) == 0:
            for part in gc.get_referents(item):
                yield '', part
