# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is known of a run, as the JSON object that `pose-graph report` makes a page of: run.json.

The engine at the end of a replay or a demo comes in, with the measurements that the path is
compared with and what was recorded on the way. The object has paths, measurements with what is
believed of them, residuals by source, the constraints under most tension, the updates, the pattern
of H, and sentences on what a person must know. Read first `document`, then `findings`.
"""
