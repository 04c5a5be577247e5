# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The decorator of all compiled functions.

A kernel is a function of arrays and numbers that Numba compiles to machine code, once for each
signature it is called with. `kernel_cache` keeps the code, so that only the first start takes the
time to compile. Kernels release the GIL and divide as NumPy does: x / 0.0 is inf or NaN, never an
exception.

A kernel may only use module globals that are kernels, intrinsics, numbers, arrays, enumerations or
tuples of these. `kernel_cache` recompiles a kernel if any of them changes, in whichever module it
is defined.
"""

from collections.abc import Callable
from contextlib import suppress
from types import MappingProxyType
from typing import Any

import numba
from numba import types
from numba.core.dispatcher import Dispatcher

from pose_graph_ros.core.compiled.kernel_cache import KernelCache

# Arguments may have types that only Numba knows, so the type checker does not see signatures.
Function = Callable[..., Any]

# Options of `numba.njit` for all kernels. All are explicit: a kernel inherits a missing option
# from the caller that it is first compiled for, so its code would depend on the order of calls.
OPTIONS = MappingProxyType({
    'nogil': True, 'error_model': 'numpy', 'no_cfunc_wrapper': True, 'fastmath': False})
# Numba's run time counts references to arrays, which took a fifth of the computing time. OWNS is
# for kernels that allocate arrays, BORROWS for all others.
OWNS = MappingProxyType({'_nrt': True})
BORROWS = MappingProxyType({'_nrt': False})

_registered: dict[str, Dispatcher] = {}


def kernel(
    function: Function | None = None, *, allocates: bool = False, **options: Any,
) -> Function:
    """
    Return a function that is compiled at its first call with each signature.

    It is a decorator, used as `@kernel` or with options as `@kernel(fastmath=True)`.

    Parameters
    ----------
    function : callable, optional
    allocates : bool
        Whether the kernel allocates arrays, or calls a kernel that returns a new array. Only then
        are references counted; without it all arrays must belong to the caller or the tables.
    **options : options of `numba.njit`, which override `OPTIONS`

    """
    if function is None:
        return lambda function: _compiled(function, allocates, options)
    return _compiled(function, allocates, options)


def _compiled(function: Function, allocates: bool, options: dict[str, Any]) -> Any:
    ownership = OWNS if allocates else BORROWS
    compiled = numba.njit(**{**OPTIONS, **ownership, **options})(function)
    if isinstance(compiled, Dispatcher):    # NUMBA_DISABLE_JIT=1 leaves functions as they are
        _widen_calls(compiled)
        if options.get('inline') != 'always':   # inlined kernels are compiled within their callers
            _registered[f'{function.__module__}.{function.__qualname__}'] = compiled
        with suppress(RuntimeError):    # no folder for the cache; kernel_cache has logged why
            # as njit(cache=True) does, with our own class of cache
            compiled._cache = KernelCache(compiled)  # noqa: SLF001
    return compiled


def _widen_calls(compiled: Dispatcher) -> None:
    """
    Make calls from other kernels pass every integer as int64.

    Numba would compile one version for each width and each constant, which triples the time.
    """
    template = compiled.get_call_template

    def widened(arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        return template(tuple(map(_widest, arguments)),
                        {name: _widest(argument) for name, argument in keywords.items()})

    compiled.get_call_template = widened


def _widest(argument: Any) -> Any:
    argument = types.unliteral(argument)
    return types.int64 if isinstance(argument, types.Integer) else argument


def is_cached(*kernels: Function) -> bool:
    """
    Tell whether all kernels have valid code in the cache, for at least one signature each.

    This takes about a millisecond per kernel, and neither loads nor compiles code. By default it
    tells so of all kernels imported so far.
    """
    caches = [kernel._cache for kernel in kernels or _registered.values()  # noqa: SLF001
              if isinstance(kernel, Dispatcher)]
    return all(isinstance(cache, KernelCache) and cache.holds_code() for cache in caches)


def can_be_kept() -> bool:
    """Tell whether all kernels imported so far have a folder for their cached code."""
    return all(isinstance(dispatcher._cache, KernelCache)  # noqa: SLF001
               for dispatcher in _registered.values())


def compile_only(compiled: Any, signature: tuple[Any, ...]) -> None:
    """
    Compile a kernel for one signature; a call with another one then raises TypeError.

    Parameters
    ----------
    compiled : kernel
    signature : tuple of numba types

    """
    if isinstance(compiled, Dispatcher) and len(compiled.signatures) == 0:
        compiled.compile(signature)
        compiled.disable_compile()
