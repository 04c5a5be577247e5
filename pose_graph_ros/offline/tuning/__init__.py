# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The noise of sources, estimated from the measurements of a whole drive.

A replayed drive comes in, factors on what sources claim go out, with intervals. `noise` finds
them as the engine does while it drives (`core.sources.error_estimate`), and says what of them a
drive proves. `held_out` splits a drive into stretches that are held out in turn, and compares a
path with what was measured there.
"""
