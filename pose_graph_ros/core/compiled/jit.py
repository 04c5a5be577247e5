# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The decorator of all compiled functions.

A kernel is a function of arrays and numbers that Numba compiles to machine code. Those that Python
calls declare the types of their arguments: nothing has to be called to compile them
(`compile_kernels`), and other types are a TypeError instead of another version of the code. All
others are compiled as parts of these. `kernel_cache` keeps the code, so that only the first start
takes the time to compile. Kernels release the GIL and divide as NumPy does: x / 0.0 is inf or NaN,
never an exception.

A kernel may only use module globals that are kernels, intrinsics, numbers, arrays, enumerations or
tuples of these. `kernel_cache` recompiles a kernel if any of them changes, in whichever module it
is defined.
"""

from collections.abc import Callable, Iterable
import functools
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numba
from numba import types

from pose_graph_ros.core.compiled.kernel_cache import KernelCache
from pose_graph_ros.core.compiled.numba_internals import Dispatcher

# Arguments may have types that only Numba knows, so the type checker does not see signatures.
Function = Callable[..., Any]

# Options of `numba.njit` for all kernels. All are explicit: a kernel inherits a missing option
# from the caller that it is first compiled for, so its code would depend on the order of calls.
OPTIONS = MappingProxyType({
    'nogil': True, 'error_model': 'numpy', 'no_cfunc_wrapper': True, 'fastmath': {'contract'}})

# Types of arguments in signatures: numbers, then C-contiguous arrays.
INTEGER, NUMBER, FLAG = types.int64, types.float64, types.boolean
INTEGERS, INDICES, BYTES, NUMBERS, ROWS, MATRICES = (
    types.int64[::1], types.int32[::1], types.uint8[::1], types.float64[::1],
    types.float64[:, ::1], types.float64[:, :, ::1])
Signature = tuple[types.Type, ...]

_registered: dict[str, Dispatcher] = {}
_signatures: dict[str, Signature] = {}


def kernel(function: Function | None = None, *, signature: Signature | None = None,
           allocates: bool = False, **options: Any) -> Function:
    """
    Return a function that is compiled at its first call; a decorator, also as `@kernel(...)`.

    A kernel that Python calls has a signature; a call with other types raises TypeError. Only a
    kernel that allocates arrays, or calls one that returns a new array, counts references; without
    it all arrays must belong to the caller or the tables. Options are those of `numba.njit`, which
    override `OPTIONS`.
    """
    if function is None:
        return functools.partial(kernel, signature=signature, allocates=allocates, **options)
    # Numba's run time counts references to arrays, which took a fifth of the computing time; only
    # kernels that allocate need it
    compiled = numba.njit(**{**OPTIONS, '_nrt': allocates, **options})(function)
    if isinstance(compiled, Dispatcher):    # NUMBA_DISABLE_JIT=1 leaves functions as they are
        # Calls from other kernels pass every integer as int64: Numba would compile one version for
        # each width and each constant, which triples the time.
        template = compiled.get_call_template
        compiled.get_call_template = lambda arguments, keywords: template(
            tuple(map(_widest, arguments)),
            {name: _widest(argument) for name, argument in keywords.items()})
        if options.get('inline') != 'always':   # inlined kernels are compiled within their callers
            name = f'{function.__module__}.{function.__qualname__}'
            _registered[name] = compiled
            if signature is not None:
                _signatures[name] = signature
                # Numba calls this with arguments that it has no code for, and what it returns
                # with them
                compiled._compile_for_args = functools.partial(  # noqa: SLF001
                    _compiled_at_first_call, compiled, signature)
        # as njit(cache=True) does, with our own class of cache
        compiled._cache = KernelCache(compiled)  # noqa: SLF001
    return compiled


def _widest(argument: Any) -> Any:
    argument = types.unliteral(argument)
    return types.int64 if isinstance(argument, types.Integer) else argument


def _compiled_at_first_call(compiled: Dispatcher, signature: Signature, *arguments: Any) -> Any:
    """Return the code of a kernel for its declared signature alone; compile it if necessary."""
    given = tuple(map(compiled.typeof_pyval, arguments))
    convert = compiled.typingctx.can_convert
    if len(given) != len(signature) or None in map(convert, given, signature):
        raise TypeError(f'{compiled.py_func.__name__} takes {signature}, not {given}')
    _compile(compiled, signature)
    return compiled.overloads[signature].entry_point


def _compile(compiled: Dispatcher, signature: Signature) -> None:
    """Compile a kernel, or load it from the cache; then it raises TypeError for other types."""
    if signature not in compiled.overloads:
        compiled.compile(signature)
    compiled.disable_compile()


def declared() -> list[str]:
    """Return the names of all kernels with a declared signature that were imported so far."""
    return list(_signatures)


def compile_kernels(names: Iterable[str] | None = None) -> None:
    """Compile kernels, or load them from the cache: all `declared` ones, or some of them."""
    for name in declared() if names is None else names:
        _compile(_registered[name], _signatures[name])


def is_cached(*names: str) -> bool:
    """
    Tell whether declared kernels have valid code in the cache: all of them, or some.

    This takes about a millisecond per kernel, and neither loads nor compiles code.
    """
    return all(_registered[name]._cache.holds_code(_signatures[name])  # noqa: SLF001
               for name in names or _signatures)


def can_be_kept() -> bool:
    """Tell whether all kernels imported so far have a writeable folder for their code."""
    return all(each._cache.is_writable for each in _registered.values())  # noqa: SLF001


def cache_folders() -> set[Path]:
    """Return the folders that the code of all kernels imported so far is kept in."""
    paths = {each._cache.cache_path for each in _registered.values()}  # noqa: SLF001
    return {Path(path) for path in paths if path != ''}


def processor() -> str:
    """Return the name of the processor that kernels are compiled for."""
    dispatcher = next(iter(_registered.values()))
    return str(dispatcher.targetctx.codegen().magic_tuple()[1])
