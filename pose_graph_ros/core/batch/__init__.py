# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Batch optimisation: all poses of a graph at a minimum of chi2, in one call.

Input is a `Graph` with constraints and present poses; the optimised poses are written into it and
a `BatchResult` is returned. `optimizer`, the module to read first, holds the entry points.
`levenberg_marquardt` is the loop over the iterations of `gauss_newton`, `chordal_start` and
`joint_start` compute initial poses by linear least squares, and `final_optimization` iterates over
the weights of robust losses at the end of a stream. `plain_optimizer` does the usual case without
compiled kernels, for tools that run once; `outcome` has the results of both.
"""
