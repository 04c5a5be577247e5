# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Nodes leave the graph, and what is known of the others by them stays.

A Gaussian prior over the nodes that they were connected to takes their place. `sparsification`,
with the convex problem of `conservative`, turns it into a tree of edges and observed nodes that
tells no more than it, so that the graph stays sparse.
"""
