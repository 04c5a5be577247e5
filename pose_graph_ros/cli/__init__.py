# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Offline tools over the same engine; none of them imports rclpy."""
