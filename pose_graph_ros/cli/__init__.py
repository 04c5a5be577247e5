# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Offline tools around the engine, behind the command `pose-graph`; none of them imports rclpy.

Bags, g2o files and command line options come in. Corrected paths, pictures, tables of errors,
graphs and simulated bags go out. Read first `main`, which lists the tools, then `replay`, which
runs a bag through the engine.
"""
