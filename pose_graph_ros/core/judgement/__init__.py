# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which constraints are believed: loop closures, fixes and odometry are judged by the graph.

A constraint that is not believed stays in the graph with weight 0. No decision is final: each is
judged again when the evidence changes. Read `verdicts` first.
"""
