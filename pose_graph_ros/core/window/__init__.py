# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which hidden nodes leave the graph.

In come stamps, path lengths and numbers of the hidden nodes, and the settings of the window; out
goes how many of the oldest nodes leave now. What happens with them is not decided here: see
`core/forgetting.py`. Read `policy.py` first; `thinning.py` is about places driven often.
"""
