# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which fixes are believed, and how noisy everything is held to be, beside an oracle that knows.

`odometry` has the drives, `scenarios` what is done to their fixes, `engine` runs ours and the
oracles, `peers` robust losses over the whole graph, `__main__` reads the command line and writes
the page.
"""
