# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Files of the engine: graphs, journals, g2o, and paths (TUM, KITTI, CSV, GPX, KML, GeoJSON).

`graph_files` is the module to read first: its `SavedGraph` is the whole state of a back end as a
value, which `core.parts` makes and restores, and which is written as three text files and read
back bit for bit.
"""
