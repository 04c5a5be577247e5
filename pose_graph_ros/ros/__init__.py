# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 side: the only place that imports rclpy and message packages."""
