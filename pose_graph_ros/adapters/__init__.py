# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Convert between ROS formats and the values of the engine, without rclpy.

Bags, ROS messages and parameter values come in; measurements, settings of the engine and
serialised messages go out. The node and the offline tools share these modules. Read first
`sources`, which has the table of the kinds of sources, and what reads their messages.
"""
