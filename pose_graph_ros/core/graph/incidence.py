# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which constraints leave the graph with some of its nodes."""

import numpy as np

from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.graph import Graph

_ENDS = [tb.END_I, tb.END_J, tb.END_K]


def constraints_on(graph: Graph, nodes: IntArray) -> tuple[IntArray, IntArray]:
    """
    Return the ids of the edges and of the observed nodes with an end in some nodes.

    Parameters
    ----------
    graph : Graph
    nodes : ndarray of int, ids of hidden nodes that are in it

    """
    chosen = np.zeros(graph.n_nodes + 1, dtype=bool)    # the last one is for no third end, -1
    chosen[graph.node_rows(nodes)] = True
    edges, observed = graph.memory['edge_i'], graph.memory['observed_i']
    on_edges = np.any(chosen[edges[:graph.n_edges, _ENDS]], axis=1)
    on_observed = chosen[observed[:graph.n_observed, tb.OBS_NODE]]
    return graph.edge_ids[on_edges], graph.observed_ids[on_observed]
