# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Files of the engine: saved graphs, g2o graphs, and paths (TUM, KITTI, CSV, GPX, KML, GeoJSON).

`saved_graph` is the module to read first: its `SavedGraph` is the whole state of a back end as a
value. `capture` makes it from the parts of the engine, and fills the parts of a new one from it.
`graph_files` writes it as three text files and reads it back bit for bit, with the help of `g2o`,
`path_files`, `json_values` and `atomic_files`. `g2o` also reads planar graphs of other programs.
`path_files` writes paths in the map and on the Earth.
"""
