# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Sparse symmetric systems of equations with a block for each node, without compiled kernels.

For tools that run once: NumPy and the SuperLU of SciPy are loaded in a fraction of the time that
Numba and the kernels take. Input are blocks with the nodes that they couple; output are solutions
and whether the matrix is positive definite. `block_matrix` is the module to read first; `superlu`
loads the factorisation, `components` finds what nodes are connected.
"""
