# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Graphs to look at: the four views of a small one (`views`), and patterns of H and R (`pattern`).

Nothing here knows of colours or files.
"""
