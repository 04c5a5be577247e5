# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How hidden nodes leave the graph, and which do where a place is driven often.

`thinning` decides which nodes and measurements leave; `sparse_removal` makes the update of the
graph by which they do, with few constraints in their place. Who else has to forget them is told by
`core/forgetting.py`.
"""
