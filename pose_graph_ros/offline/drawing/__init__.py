# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Small graphs as diagrams: which vertices and arcs a picture of them has, and where these stand.

In come the rows of a graph; out go plain vertices, arcs and patterns, for whoever draws them.
Nothing here knows of colours or files. Read `diagram.py` first: the four views of a graph.
"""
