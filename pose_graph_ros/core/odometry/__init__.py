# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From odometry samples to hidden nodes and the edges between them.

Odometry samples of one or several sources come in. Each `stream` sorts its samples by stamp,
removes jumps, and appends them to a `timeline`, which gives the motion between any two instants.
The primary source makes hidden nodes with an edge from each to the next; the other sources add
secondary edges between these nodes. Measurements are attached to a node by their stamps. Read
`hidden_nodes` first.
"""
