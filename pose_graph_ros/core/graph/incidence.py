# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The constraints of a node, edges and observed nodes alike, one after the other.

`at = first(head, v)`, and while `at != END`, `entry_of(at)` is the entry of a constraint as for
`factors.parts`, and `at = following(head, v, at)`. Edges come first: `at` is 4 times an edge and
the side that the node is on, or -2 less an observed node.
"""

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import tables as tb

END = -1


@kernel(forceinline=True)
def first(head, v):  # type: ignore[no-untyped-def]
    """Return where the first constraint of a node is; END if it has none."""
    row = tb.node_i(head)[v]
    return row[tb.EDGE_LIST] if row[tb.EDGE_LIST] >= 0 else -2 - row[tb.OBSERVED_LIST]


@kernel(forceinline=True)
def following(head, v, at):  # type: ignore[no-untyped-def]
    """Return where the next constraint of a node is; END behind the last one."""
    if at < 0:
        return -2 - tb.observed_i(head)[-2 - at, tb.OBS_NEXT]
    after = tb.edge_i(head)[at >> 2, tb.NEXT_I + (at & 3)]
    return after if after >= 0 else -2 - tb.node_i(head)[v, tb.OBSERVED_LIST]


@kernel(forceinline=True)
def entry_of(at):  # type: ignore[no-untyped-def]
    """Return the entry of a constraint: an edge e as e, an observed node k as -1 - k."""
    return at >> 2 if at >= 0 else at + 1
