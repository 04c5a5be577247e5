# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Certificates of global optimality: whether a minimum of a pose graph is the lowest of all.

They apply to an objective that is nearly chi2, but quadratic in complex headings and positions
(`objective`). `certify`, the module to read first, has the proof and, if a minimum is not the
global one, searches for a lower one.
"""
