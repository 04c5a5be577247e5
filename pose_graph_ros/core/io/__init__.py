# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Files of the engine: g2o graphs and TUM trajectories."""
