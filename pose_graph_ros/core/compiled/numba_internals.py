# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
All that this package uses of Numba beyond its public interface; no other module imports such.

Numba promises nothing about these, so versions that the tests have not run with are refused. To
take a newer one, run all tests with it, and raise the bound here, in setup.py and in package.xml.

- `Dispatcher` is the type of kernels. Its `_cache` holds our cache instead of the one of
  `njit(cache=True)`; `targetctx`, its `magic_tuple` (the processor), `targetoptions` and the
  function `_defn` of an intrinsic are part of a kernel's fingerprint; `get_call_template` is
  replaced, as without widening of integers the compilation takes three times as long;
  `_compile_for_args` is replaced, with `typeof_pyval`, `typingctx`, `overloads` and their
  `entry_point`, so that the first call compiles for the declared signature alone.
- The options `_nrt` and `no_cfunc_wrapper` of `njit`: kernels that own no array count no
  references, and no wrapper for C is compiled.
- `CompileResult` makes of compiled code what can be pickled by `serialize` (`_reduce`), unless its
  `library` has dynamic globals, and code of that (`_rebuild`), see `dumped` and `loaded`;
  `_defined_symbols` of the engine and `_get_module_for_linking` of a library are what these
  replace. `sigutils` gives the types in a signature. `rtsys`, which kernels that allocate arrays
  run on, has to be initialized before their code is loaded.
- `ir` makes vectors of numbers, `populate_array` an array over the memory of the tables.
"""

import functools
import pickle
import re
from typing import Any
import zlib

import numba

from pose_graph_ros.core.exceptions import NumbaVersionError

OLDEST, NEWEST = (0, 60), (0, 68)  # tested with


def check_version(version: str) -> None:
    """Raise `NumbaVersionError` for a version of Numba that is not supported."""
    major, minor = map(int, re.findall(r'\d+', version)[:2])
    if not OLDEST <= (major, minor) <= NEWEST:
        bounds = f'>={OLDEST[0]}.{OLDEST[1]},<{NEWEST[0]}.{NEWEST[1] + 1}'
        raise NumbaVersionError(f"Numba {version} is not supported: pip install 'numba{bounds}'")


check_version(numba.__version__)

# ruff: noqa: E402  another version may lack them
from numba.core import serialize, sigutils
from numba.core.cgutils import ir
from numba.core.codegen import ll
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.runtime import rtsys

__all__ = ['CompileResult', 'Dispatcher', 'ir', 'sigutils']


def populate_array(*arguments: Any) -> None:
    """Call Numba's function, whose module only the compiler needs, and which takes 0.1 s."""
    from numba.np import arrayobj  # noqa: PLC0415
    arrayobj.populate_array(*arguments)


def dumped(result: CompileResult) -> bytes:
    """
    Return compiled code as bytes, laid out for `loaded`.

    Numba parses the intermediate code of all machine code that it loads, which takes half of the
    time of loading and two thirds of its memory, and imports the modules of those of its own
    functions that were compiled into it. Of the environments only constants are read, and the
    types of all variables are for people.
    """
    (name, kind, (code, bitcode)), *parts, _, reload_init, environments = (
        result._reduce())  # noqa: SLF001
    kept = tuple(each for each in environments if len(each.consts) > 0)
    empty = ll.parse_assembly('').as_bitcode()
    return bytes(serialize.dumps((
        (name, kind, (code, empty)), *parts, '', reload_init, kept, zlib.compress(bitcode))))


def loaded(target_context: Any, code: bytes) -> CompileResult:
    """Return the code of `dumped`, ready to be called."""
    # Numba refreshes the context instead, which also imports all that can be compiled (0.5 s)
    rtsys.initialize(target_context)
    library, descriptor, *parts, bitcode = pickle.loads(code)
    target_context.codegen()._engine._defined_symbols |= {  # noqa: SLF001
        descriptor.llvm_func_name, descriptor.llvm_cpython_wrapper_name}
    result = CompileResult._rebuild(target_context, library, descriptor, *parts)  # noqa: SLF001
    # the kernel may be a part of one that is compiled later
    result.library._get_module_for_linking = functools.cache(  # noqa: SLF001
        lambda: ll.parse_bitcode(zlib.decompress(bitcode)))
    return result
