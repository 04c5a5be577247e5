# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Small nodes to start from, which import nothing of this package: front ends."""
