# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The ROS 2 node: the only package that imports rclpy and the message packages.

Messages of the sources, transforms and service calls come in; poses, transforms, the path, markers
and diagnostics go out. Read `session` first: it connects `input` (messages to measurements),
`worker` (the thread that owns the engine) and `publishers`. `node` adds the parameters and the
lifecycle around it, and `main` the process. `player` plays a bag to a running node, for the demo.
"""
