# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What takes the time of a node's start; `prepared_node` imports it once for many nodes."""

from pose_graph_ros.core.warm_up import warm_up
from pose_graph_ros.ros import node  # noqa: F401

warm_up()
