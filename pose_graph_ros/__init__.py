# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Online back end of pose-graph SLAM for ROS 2.

`core` holds the engine (arrays and nanoseconds, no ROS), `ros` the node, `cli` the offline tools.
"""

__version__ = '0.1.0'
