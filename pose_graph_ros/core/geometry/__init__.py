# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Geometry of the plane: poses, their covariances, trajectories and the map projection.

`se2` is the module to read first: it composes, inverts and interpolates arrays of poses, and
single ones in plain numbers. `covariance` checks, rotates and
propagates covariances, `trajectory` interpolates stamped poses, and `geodesy` converts latitude
and longitude to map coordinates and back. All are functions of arrays or immutable values,
without any state.
"""
