# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From parameter files of robot_localization, fuse and slam_toolbox to one of this node.

`files` reads them, `tables` says what becomes of each of their parameters, `inputs` which source
an input becomes, `engine` puts that together, `steps` says what is left to do, and `text` writes
it down. Read `tables` first: to know one more parameter is one more row there.
"""
