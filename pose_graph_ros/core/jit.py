# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The decorator of all compiled functions.

A kernel is a function of arrays and numbers that Numba compiles to machine code, once for each
signature it is called with; `kernel_cache` keeps the code, so that only the first start takes that
time. Kernels release the GIL and divide as NumPy does (x / 0.0 is inf or NaN, never an exception).

What a kernel calls or reads of a module must be a kernel, an intrinsic, a number, an array, an
enumeration or a tuple of these: a change of one is noticed, in whichever module it stands.
"""

from collections.abc import Callable
from contextlib import suppress
from types import MappingProxyType
from typing import Any, overload

import numba
from numba import types
from numba.core.dispatcher import Dispatcher

from pose_graph_ros.core.kernel_cache import KernelCache

# Arguments may be what only Numba knows, so signatures are not handed through to the type checker.
Function = Callable[..., Any]

# All of them are said: what is not, a kernel takes over from the caller that it is first compiled
# for, and its code would depend on the order.
OPTIONS = MappingProxyType({
    'nogil': True, 'error_model': 'numpy', 'no_cfunc_wrapper': True, 'fastmath': False})
# Counting references to arrays, which is what Numba's run time is for, took a fifth of the time.
OWNS = MappingProxyType({'_nrt': True})
BORROWS = MappingProxyType({'_nrt': False})

_registered: dict[str, Dispatcher] = {}


@overload
def kernel(function: Function) -> Function: ...


@overload
def kernel(*, allocates: bool = False, **options: Any) -> Callable[[Function], Function]: ...


def kernel(
    function: Function | None = None, *, allocates: bool = False, **options: Any,
) -> Any:
    """
    Compile a function at its first call with each signature: `@kernel`, `@kernel(fastmath=True)`.

    Parameters
    ----------
    function : callable
    allocates : bool
        Whether it makes arrays, or is handed back one that another kernel has made: only then are
        references counted. Without it all arrays are those of the caller or of `tables`.
    **options
        Those of `numba.njit`, on top of `OPTIONS`.

    """
    if function is None:
        return lambda function: _compiled(function, allocates, options)
    return _compiled(function, allocates, options)


def _compiled(function: Function, allocates: bool, options: dict[str, Any]) -> Any:
    ownership = OWNS if allocates else BORROWS
    compiled = numba.njit(**{**OPTIONS, **ownership, **options})(function)
    if isinstance(compiled, Dispatcher):    # NUMBA_DISABLE_JIT=1 leaves functions as they are
        _widen_calls(compiled)
        if options.get('inline') != 'always':   # such a one is compiled as a part of others alone
            _registered[f'{function.__module__}.{function.__qualname__}'] = compiled
        with suppress(RuntimeError):    # there is no folder for it; kernel_cache has said why
            # what njit(cache=True) does, with a cache of our own
            compiled._cache = KernelCache(compiled)  # noqa: SLF001
    return compiled


def _widen_calls(compiled: Dispatcher) -> None:
    """
    Have calls from other kernels compile one version for all integers, constants or not.

    Numba compiles one for each width and for each constant, which triples the time it takes.
    """
    template = compiled.get_call_template

    def widened(arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        return template(tuple(map(_widest, arguments)),
                        {name: _widest(argument) for name, argument in keywords.items()})

    compiled.get_call_template = widened


def _widest(argument: Any) -> Any:
    argument = types.unliteral(argument)
    return types.int64 if isinstance(argument, types.Integer) else argument


def registered() -> dict[str, Dispatcher]:
    """
    Return all kernels of the modules imported so far by their full names.

    `registered()[name].signatures` are the signatures that this process has compiled or loaded.
    """
    return dict(_registered)


def is_cached(*kernels: Function) -> bool:
    """
    Tell whether the code of kernels is kept from an earlier start.

    A kernel counts once the code for one of its signatures is. Takes about a millisecond each, and
    neither loads nor compiles anything.

    Parameters
    ----------
    *kernels : kernel
        All those imported so far if there are none.

    """
    caches = [kernel._cache for kernel in kernels or _registered.values()  # noqa: SLF001
              if isinstance(kernel, Dispatcher)]
    return all(isinstance(cache, KernelCache) and cache.holds_code() for cache in caches)


def can_be_kept() -> bool:
    """Tell whether there are folders for the code of the kernels imported so far."""
    return all(isinstance(dispatcher._cache, KernelCache)  # noqa: SLF001
               for dispatcher in _registered.values())


def compile_only(compiled: Any, signature: tuple[Any, ...]) -> None:
    """
    Compile a kernel for one signature, so that a call with another is a TypeError.

    Parameters
    ----------
    compiled : kernel
    signature : tuple of numba types

    """
    if isinstance(compiled, Dispatcher) and len(compiled.signatures) == 0:
        compiled.compile(signature)
        compiled.disable_compile()
