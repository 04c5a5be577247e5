# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The cache of compiled kernels on disk: where it is, and when an entry is valid.

Numba's own cache has four faults on a robot. It raises at import where it finds no writeable
folder (a package that belongs to root, a service without a home directory). It raises at a call if
a power failure has truncated a file. It does not detect that a function which the kernel calls has
changed. Two processes that compile different signatures at once can store the code of one under
the name of the other. So each signature of a kernel has a file of its own here, named by it:

- The folder is the first writeable one of: `NUMBA_CACHE_DIR` if it is set, `__pycache__` beside
  the source, `pose_graph_ros` in the user's cache. Code is also loaded from those before it, such
  as the `__pycache__` that root has filled when it made a robot's image. If there is none, a
  warning is logged and every start compiles again.
- Each file begins with a fingerprint of everything that its code was made from, and a check sum.
  It is used only if both are correct.
- A cache that cannot be read or written costs time, but never raises an exception.

Only the dispatchers of our kernels are changed. Numba's settings and the environment belong to the
whole process and stay as they are.
"""

from collections.abc import Iterator
import contextlib
from enum import Enum
import functools
import hashlib
import logging
import os
from pathlib import Path
import sys
import tempfile
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np

from pose_graph_ros.core.compiled import numba_internals as ni

logger = logging.getLogger(__name__)

OWNER = 'pose_graph_ros'
LAYOUT = 2  # of the files, counted up when it changes
# Settings of Numba that change the generated code.
SETTINGS = ('OPT', 'LOOP_VECTORIZE', 'SLP_VECTORIZE', 'BOUNDSCHECK', 'DEBUGINFO_DEFAULT')


# --- the folder ---------------------------------------------------------------------------------

@functools.cache
def find_folders(source: Path) -> tuple[Path | None, list[Path]]:
    """
    Return the cache folders for the modules in a source folder.

    That is the first one that can be written to, and those before it, from which code is only
    loaded.
    """
    others, tried = [], []
    for folder in _candidates(source):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()  # whether files can be written
        except OSError as error:
            tried.append(f'{folder} ({error.strerror or error})')
            if folder.is_dir() and os.access(folder, os.R_OK):
                others.append(folder)
        else:
            return folder, others
    if len(others) == 0:
        logger.warning(
            'compiled kernels cannot be kept, every start compiles them again; set '
            'NUMBA_CACHE_DIR to a folder that can be written to; tried: %s', ', '.join(tried))
    return None, others


def _candidates(source: Path) -> Iterator[Path]:
    # one folder per installation, with a readable name
    own = f'{source.name}_{hashlib.sha256(os.fsencode(source)).hexdigest()[:16]}'
    if numba.config.CACHE_DIR:
        yield Path(numba.config.CACHE_DIR) / own
    yield source / '__pycache__'
    caches = Path(os.environ.get('XDG_CACHE_HOME', '')), Path(os.path.expanduser('~')) / '.cache'
    for cache in caches:
        if cache.is_absolute():     # '~' is not expanded if the user has no home directory
            yield cache / OWNER / own


# --- the fingerprint ----------------------------------------------------------------------------

@functools.cache
def fingerprint(dispatcher: ni.Dispatcher) -> bytes:
    """Return a digest of all inputs of a kernel's machine code except its signature."""
    parts: list[object] = [
        LAYOUT, numba.__version__, dispatcher.targetctx.codegen().magic_tuple(),
        [(name, getattr(numba.config, name, None)) for name in SETTINGS]]
    ours = {_top(__name__), _top(dispatcher.py_func.__module__)}
    todo: list[Any] = [dispatcher]
    seen: set[FunctionType] = set()
    while len(todo) > 0:
        value = todo.pop()
        is_kernel = isinstance(value, ni.Dispatcher)
        if is_kernel:
            options = value.targetoptions
            parts += [(name, _ordered(options[name])) for name in sorted(options)]
            value = value.py_func
        value = getattr(value, '_defn', value)      # the function that defines an intrinsic
        if isinstance(value, FunctionType):
            if value not in seen and (is_kernel or _top(value.__module__) in ours):
                seen.add(value)
                codes = list(_codes(value.__code__))
                parts += [value.__module__, value.__qualname__]
                for code in codes:
                    parts += [code.co_code.hex(), code.co_names, code.co_varnames,
                              code.co_freevars, [_ordered(item) for item in code.co_consts
                                                 if not isinstance(item, CodeType)]]
                cells = value.__closure__ or ()
                todo += [value.__defaults__, [cell.cell_contents for cell in cells]]
                todo += _globals(value, {name for code in codes for name in code.co_names}, ours)
        elif isinstance(value, tuple | list):
            parts.append(len(value))
            todo += value
        elif isinstance(value, np.ndarray | np.generic):
            parts += [str(value.dtype), value.shape, value.tobytes().hex()]
        elif isinstance(value, numba.types.Type | np.dtype):
            parts.append(str(value))
        elif isinstance(value, type):
            members = value if issubclass(value, Enum) else ()
            parts += [getattr(value, '_fields', ()),
                      [(member.name, member.value) for member in members]]
        elif isinstance(value, int | float | complex | str | bytes | None):
            parts.append(value)
    return hashlib.sha256(repr(parts).encode()).digest()


def _top(module: str) -> str:
    return module.partition('.')[0]


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Yield a code object and those of the functions inside it."""
    yield code
    for item in code.co_consts:
        if isinstance(item, CodeType):
            yield from _codes(item)


def _ordered(value: object) -> str:
    """Return a value as text; sets are sorted, as their order differs between processes."""
    return repr(sorted(map(repr, value)) if isinstance(value, set | frozenset) else value)


def _globals(function: FunctionType, names: set[str], ours: set[str]) -> list[tuple[str, Any]]:
    """Return the globals that a function names, also from modules of this package."""
    own = function.__globals__
    modules = [own[name] for name in sorted(names & own.keys())
               if isinstance(own[name], ModuleType)]
    spaces = [own, *(vars(each) for each in modules if _top(each.__name__) in ours)]
    return [(name, space[name]) for space in spaces for name in sorted(names & space.keys())]


# --- the files ----------------------------------------------------------------------------------

class KernelCache:
    """The cache of one kernel, which its dispatcher calls instead of one of Numba's."""

    def __init__(self, dispatcher: ni.Dispatcher) -> None:
        self._dispatcher = dispatcher
        source = Path(dispatcher.py_func.__code__.co_filename).absolute()
        self._own, others = find_folders(source.parent)
        self._name = f'{source.stem}.{dispatcher.py_func.__qualname__}'.replace('<locals>.', '')
        # its own folder first
        self._folders = others if self._own is None else [self._own, *others]
        self.cache_path = str(next(iter(self._folders), ''))    # empty without one
        self.is_writable = self._own is not None    # whether its code can be kept

    def holds_code(self, signature: Any) -> bool:
        """Tell whether there is valid code for a signature; it is not loaded."""
        return any(self._code(path) is not None for path in self._files(signature))

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the code for a signature; None if there is none that is valid."""
        for path in self._files(signature):
            with _tolerated('read', path.parent):
                if (code := self._code(path)) is not None:
                    return ni.loaded(target_context, code)
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Store the code for a signature; log a warning if that fails."""
        # with dynamic globals the code contains addresses of this process
        if self._own is None or result.library.has_dynamic_globals:
            return
        path = next(self._files(signature))
        with _tolerated('written', path.parent):
            code = ni.dumped(result)
            with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
                file.write(fingerprint(self._dispatcher) + hashlib.sha256(code).digest() + code)
            os.replace(file.name, path)

    def _files(self, signature: Any) -> Iterator[Path]:
        """Yield the places of the code for a signature."""
        arguments, _ = ni.sigutils.normalize_signature(signature)
        processor = self._dispatcher.targetctx.codegen().magic_tuple()
        key = repr((str(arguments), processor, sys.implementation.cache_tag)).encode()
        name = f'{self._name}-{hashlib.sha256(key).hexdigest()[:16]}.nbc'
        return (folder / name for folder in self._folders)

    def _code(self, path: Path) -> bytes | None:
        """Return the code in a file; None if it is not valid."""
        with _tolerated('read', path.parent), contextlib.suppress(FileNotFoundError):
            kept = path.read_bytes()
            made_from, check_sum, code = kept[:32], kept[32:64], kept[64:]
            if made_from == fingerprint(self._dispatcher):
                if check_sum != hashlib.sha256(code).digest():
                    raise ValueError('the check sum is wrong')
                return code
        return None


@contextlib.contextmanager
def _tolerated(what: str, folder: Path) -> Iterator[None]:
    """Log an exception in place of raising it."""
    try:
        yield
    except Exception as error:
        _warn_once(f'the compiled kernels in {folder} could not be {what}: '
                   f'{type(error).__name__}: {error}; they are compiled again')


@functools.cache
def _warn_once(text: str) -> None:
    logger.warning('%s', text)
