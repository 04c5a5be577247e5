# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Files of the engine: saved graphs, g2o graphs, and paths (TUM, KITTI, CSV, GPX, KML, GeoJSON).

`saved_graph` is the module to read first: its `SavedGraph` is the whole state of a back end as a
value, which `core.parts` makes and restores. `graph_files` writes it as three text files and reads
it back bit for bit.
"""
