# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The engine: pose graph, errors, solver and facade. Knows nothing of ROS and has no clock."""
