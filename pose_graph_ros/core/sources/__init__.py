# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From a measurement with its own stamp to constraints of the graph.

Global poses, positions, headings, yaw rates and loop closures come in, in any order of stamps;
updates of the graph go out. Read `pipeline` first: a measurement is checked (`validation`), waits
until odometry covers its stamp, and is attached to the hidden node before it (`kinds`), by a
constraint that is `queued`. `factor_builder` makes one update of the queue, and keeps what the
graph has of each source; errors that go on in time are chains of states (`bias`).
"""
