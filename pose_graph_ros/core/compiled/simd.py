# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Vectors of four numbers for the innermost loops of kernels.

A loop over two rows of a front is too short for the compiler's own vectorisation, which first
tests whether the rows overlap, and computes the last columns one by one. Rows that are padded to
whole vectors, with explicit loads and stores, need neither. The compiler chooses the instructions
of the processor.

The functions with the first argument `_context` are Numba intrinsics: Numba passes that argument,
kernels call them without it. All arrays are flat and of type float64.
"""

from collections.abc import Callable
from typing import Any, Final

from numba import types
from numba.extending import intrinsic, models, register_model

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.compiled.numba_internals import ir

# Number of elements of a vector.
WIDTH: Final = 4

_LLVM = ir.VectorType(ir.DoubleType(), WIDTH)


class _VectorType(types.Type):  # type: ignore[misc]  # Numba is untyped
    def __init__(self) -> None:
        super().__init__(name='Vector')


VECTOR: Final = _VectorType()


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, type_: Any) -> None:
        super().__init__(manager, type_, _LLVM)


# Numba's decorator has no type annotations.
_intrinsic: Callable[..., Any] = intrinsic


def _address(context: Any, builder: Any, array_type: Any, array: Any, at: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), _LLVM.as_pointer())


@_intrinsic
def load(_context: Any, array: Any, at: Any) -> Any:
    """Return the vector `array[at:at + 4]`."""
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _address(context, builder, signature.args[0], *arguments)
        return builder.load(pointer, align=8)
    return VECTOR(array, types.int64), codegen


@_intrinsic
def store(_context: Any, array: Any, at: Any, vector: Any) -> Any:
    """Write a vector to `array[at:at + 4]`."""
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _address(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], pointer, align=8)
        return context.get_dummy_value()
    return types.void(array, types.int64, VECTOR), codegen


@_intrinsic
def fetch(_context: Any, array: Any, at: Any) -> Any:
    """Prefetch the cache line of `array[at]`, for a later read."""
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        byte = ir.IntType(8).as_pointer()
        three = [ir.IntType(32)] * 3
        function = builder.module.declare_intrinsic(
            'llvm.prefetch', (byte,), ir.FunctionType(ir.VoidType(), [byte, *three]))
        address = builder.bitcast(_address(context, builder, signature.args[0], *arguments), byte)
        # arguments of llvm.prefetch: for reading, keep in all caches, data cache
        builder.call(function, [address, *(kind(value) for kind, value in zip(
            three, (0, 3, 1), strict=True))])
        return context.get_dummy_value()
    return types.void(array, types.int64), codegen


@_intrinsic
def spread(_context: Any, number: Any) -> Any:
    """Return a vector with the number in all four elements."""
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = ir.Constant(_LLVM, ir.Undefined)
        for k in range(WIDTH):
            vector = builder.insert_element(vector, arguments[0], ir.IntType(32)(k))
        return vector
    return VECTOR(types.float64), codegen


@_intrinsic
def total(_context: Any, vector: Any) -> Any:
    """Return the sum of the four elements."""
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b, c, d = (builder.extract_element(arguments[0], ir.IntType(32)(k))
                      for k in range(WIDTH))
        return builder.fadd(builder.fadd(a, c), builder.fadd(b, d))
    return types.float64(VECTOR), codegen


def _of_vectors(n: int, build: Callable[..., Any]) -> Callable[..., Any]:
    """Return an operation on n vectors, element by element, given what builds it."""
    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return build(builder, *arguments)

    if n == 2:
        return _intrinsic(lambda _context, a, b: (VECTOR(VECTOR, VECTOR), codegen))
    return _intrinsic(lambda _context, total, a, b: (VECTOR(VECTOR, VECTOR, VECTOR), codegen))


# `total - a * b`, with a single rounding where the processor can
fnmadd = _of_vectors(3, lambda builder, total, a, b: builder.fsub(
    total, builder.fmul(a, b, flags=('contract',)), flags=('contract',)))
times = _of_vectors(2, lambda builder, a, b: builder.fmul(a, b))
plus = _of_vectors(2, lambda builder, a, b: builder.fadd(a, b))


@kernel(inline='always')
def add(source, begin, target, to, n):  # type: ignore[no-untyped-def]
    """Add `source[begin:begin + n]` to `target[to:to + n]`."""
    k = 0
    while k + WIDTH <= n:
        store(target, to + k, plus(load(target, to + k), load(source, begin + k)))
        k += WIDTH
    while k < n:
        target[to + k] += source[begin + k]
        k += 1
