# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The sliding window: how many of the oldest hidden nodes leave the graph.

Nodes leave in groups of an eighth of the window. What a group costs is thus spread over the steps
in which none leaves. Where a group ends depends on the nodes alone, not on when it is asked for,
so the same drive gives the same groups, however often the graph is updated.
"""

import math

import numpy as np

from pose_graph_ros.core.config import WindowConfig
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.odometry.node_table import NodeTable

# Nodes leave in groups of this share of the window.
GROUP = 0.125
# Number of newest nodes that stay in any case.
LEAST_NODES = 3
# What is needed stays for at most this many times the window.
LONGEST_HOLD = 2.0


def n_leaving(config: WindowConfig, table: NodeTable, needed_ns: int | None = None) -> int:
    """
    Return how many of the nodes in the graph leave it: the oldest ones.

    Parameters
    ----------
    config : WindowConfig
    table : NodeTable
    needed_ns : int, optional
        Stamp whose node, the last one up to it, is still needed [ns]; it stays until it is
        `LONGEST_HOLD` times as old as the window.

    """
    n_kept = len(table) - table.n_frozen
    leaving = min(_beyond(config, table, 1.0), n_kept - LEAST_NODES)
    if leaving > 0 and needed_ns is not None:
        at = int(np.searchsorted(table.stamps_ns, needed_ns, side='right')) - 1 - table.n_frozen
        if 0 <= at < leaving:
            leaving = max(at, min(_beyond(config, table, LONGEST_HOLD), leaving))
    return max(leaving, 0)


def _beyond(config: WindowConfig, table: NodeTable, factor: float) -> int:
    """Return how many nodes lie beyond the window times a factor, in whole groups."""
    first, stamps, travelled = table.n_frozen, table.stamps_ns, table.travelled
    most = 0
    if config.nodes > 0:
        group = max(math.floor(GROUP * config.nodes), 1)
        begin = len(table) - math.ceil(factor * config.nodes)
        most = begin // group * group - first
    if config.seconds > 0.0:
        limit_ns, group_ns = (round(share * config.seconds * 1e9) for share in (factor, GROUP))
        # stamps are compared as integers: as floats they would be rounded to 0.2 us
        begin_ns = int(stamps[-1]) - limit_ns - int(stamps[0])
        begin_ns = begin_ns // max(group_ns, 1) * max(group_ns, 1) + int(stamps[0])
        if stamps[first] < begin_ns:
            most = max(most, int(np.searchsorted(stamps[first:], begin_ns)))
    if config.metres > 0.0:
        most = max(most, _before(travelled, factor * config.metres, GROUP * config.metres))
    return most


def _before(travelled: FloatArray, limit: float, group: float) -> int:
    """Return how many path lengths, which increase, are farther than a limit from the last."""
    begin = math.floor((travelled[-1] - limit) / group) * group
    return int(np.searchsorted(travelled, begin)) if travelled[0] < begin else 0
