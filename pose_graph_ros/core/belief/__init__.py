# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which positions and poses in the map to believe: a bank of Kalman filters with one hypothesis each.

A receiver is good or in a fault, a fix may be wrong by itself, and odometry may slip. What has
happened is not decided when a measurement comes: a few hypotheses are carried on, and what comes
later turns their weights. See Y. Bar-Shalom et al., "Estimation with applications to tracking and
navigation", sections 11.6 and 11.7.
"""
