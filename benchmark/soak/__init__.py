# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The life of a robot, run through: a month through the engine, an hour through the node over DDS.

`life` makes what the sensors say, `engine` and `node` run it, `picture` draws what was found.
"""
