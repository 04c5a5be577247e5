# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From parameter files of robot_localization, fuse and slam_toolbox to one of this node.

`inputs` reads them, and says which source an input becomes, `rules` what becomes of each of their
parameters, `engine` puts that together, and `text` writes it down, with what is left to do. To
know one more parameter is one more row in rules.yaml.
"""
