# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Batch optimisation: all poses of a graph at a minimum of chi2, in one call.

Input is a `Graph` with constraints and present poses; the optimised poses are written into it and
a `BatchResult` is returned. `optimizer`, the module to read first, holds the entry points.
"""
