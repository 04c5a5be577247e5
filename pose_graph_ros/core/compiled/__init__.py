# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What makes the numerical code fast: compiled functions, their cache on disk, and flat arrays.

`jit` is the module to read first: its decorator `kernel` turns a Python function of numbers and
arrays into machine code with Numba. `kernel_cache` keeps that code from one start to the next,
and discards it when anything it was made from changes. `simd` gives kernels operations on four
numbers at once; `growing_array` is an array that rows are appended to, `pages` the memory of
large ones. `numba_internals` has all that is used of Numba beyond its public interface, and the
versions that have it. Nothing in here depends on poses or graphs.
"""
