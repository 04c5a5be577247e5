# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where on the hidden nodes a stamp or a name falls, or why it falls on none."""

import numpy as np

from pose_graph_ros.core.binding import Anchor
from pose_graph_ros.core.hidden_nodes import HiddenNodes
from pose_graph_ros.core.measurements import Answer, LoopClosure, rejected


def anchor_at(nodes: HiddenNodes, stamp_ns: int) -> Anchor | Answer:
    """Return an instant that odometry has reached, as seen from the last node before it."""
    first_ns = int(nodes.stamps_ns[0])
    if stamp_ns < first_ns:
        return rejected('before_odometry', f'stamp {stamp_ns}, odometry begins at {first_ns}')
    anchor = nodes.anchor(stamp_ns)
    if anchor is None:
        return rejected('no_odometry', f'no odometry tells of the motion up to {stamp_ns}')
    return anchor


def reference_of(nodes: HiddenNodes, closure: LoopClosure) -> Anchor | Answer:
    """Return the earlier end of a loop closure, named by stamp or by hidden node."""
    if closure.reference_ns is not None:
        return anchor_at(nodes, closure.reference_ns)
    node = closure.reference_node
    if node is None or not 0 <= node < len(nodes):
        return rejected('unknown_node', f'there is no hidden node {node}')
    return Anchor(int(nodes.rows[node]), np.zeros(3), np.zeros((3, 3)))
