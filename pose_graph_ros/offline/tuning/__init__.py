# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The noise of sources, estimated from the measurements of a whole drive.

Measurements come in, settings with intervals go out. `drive_rows` lines up odometry and what was
measured in the map; `likelihood` says how likely these are for given noise; `fit` is the module to
read first, and finds the noise that makes them the most likely, with its interval. `closure_fit`
does so for loop closures, where nothing else is there. `held_out` splits a drive into stretches
that are held out in turn, and compares a path with what was measured there.
"""
