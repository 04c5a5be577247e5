# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Permanent ids of hidden nodes, edges and observed nodes, and the rows that they are in.

Rows are in the order of their ids, so the row of an id is found by bisection. In a graph that
nothing has left, ids are rows; one comparison tells.
"""

from pose_graph_ros.core.compiled.jit import kernel
from pose_graph_ros.core.graph import tables as tb


@kernel
def _row(number, ids, n, next_id):  # type: ignore[no-untyped-def]
    """Return the row of an id among the first n, -1 if it has left; new ones are behind them."""
    if number >= next_id:
        return n + number - next_id
    if next_id == n:
        return number
    low, high = 0, n
    while low < high:
        middle = (low + high) // 2
        if ids[middle] < number:
            low = middle + 1
        else:
            high = middle
    return low if low < n and ids[low] == number else -1


@kernel
def node_row(head, node):  # type: ignore[no-untyped-def]
    """
    Return the row of a hidden node, negative if it has left the graph.

    The next new ids have the rows behind the last; so rows of an update that is being added are
    found as well.

    Parameters
    ----------
    node : int, id

    """
    return _row(node, tb.node_id(head), head[tb.N_NODES], head[tb.NEXT_NODE])


@kernel
def edge_row(head, edge):  # type: ignore[no-untyped-def]
    """
    Return the row of an edge, negative if it has left the graph.

    Parameters
    ----------
    edge : int, id

    """
    return _row(edge, tb.edge_id(head), head[tb.N_EDGES], head[tb.NEXT_EDGE])


@kernel
def observed_row(head, observed):  # type: ignore[no-untyped-def]
    """
    Return the row of an observed node, negative if it has left the graph.

    Parameters
    ----------
    observed : int, id

    """
    return _row(observed, tb.observed_id(head), head[tb.N_OBSERVED], head[tb.NEXT_OBSERVED])
