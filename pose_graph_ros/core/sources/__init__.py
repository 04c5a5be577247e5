# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From a measurement with its own stamp to constraints of the graph.

Global poses, positions, headings and loop closures come in, in any order of stamps; updates of the
graph go out. Read `pipeline` first: a measurement is checked (`validation`), waits until odometry
covers its stamp, and is attached to the hidden node before it (`kinds`).
`factor_builder` turns the queue into one update.
"""
