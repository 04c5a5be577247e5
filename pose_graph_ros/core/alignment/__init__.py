# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The motion that takes the graph from the odometry frame into the map.

Observed nodes on hidden nodes and the poses of these by odometry come in; the pose of the odometry
frame in the map comes out once it is known well enough. `consensus` fits a motion to positions of
which some are wrong, `estimator` requires that the fits of several parts of the drive agree, and
`monitor` decides when to align the graph and when to check that again. Read `monitor` first.
"""
