# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Copies of a graph to decide on, in which nodes and constraints are numbered by their rows.

What works on such a copy indexes arrays with these numbers; only its result is given ids again.
"""

from dataclasses import replace

import numpy as np

from pose_graph_ros.core.graph.constraints import Edges, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph, GraphRows, NextIds
from pose_graph_ros.core.graph.reweighting import Reweighting


def copied_rows(graph: Graph) -> GraphRows:
    """Return copies of all rows of a graph, with rows in place of ids."""
    rows = graph.rows()
    observed = rows.observed
    n_nodes, n_edges, n_observed = len(rows.poses), len(rows.edges), len(observed)
    return rows._replace(
        edges=in_rows(graph, rows.edges), observed=ObservedNodes(
            graph.node_rows(observed.node), *observed.columns[1:]),
        node_ids=np.arange(n_nodes), edge_ids=np.arange(n_edges),
        observed_ids=np.arange(n_observed), next_ids=NextIds(n_nodes, n_edges, n_observed),
        priors=[replace(prior, nodes=graph.node_rows(prior.nodes)) for prior in rows.priors])


def in_rows(graph: Graph, edges: Edges) -> Edges:
    """
    Return edges whose ends are rows instead of ids.

    Parameters
    ----------
    graph : Graph, that has the nodes

    """
    return edges.renumbered(graph.node_rows)


def losses_in_rows(graph: Graph, reweighting: Reweighting) -> Reweighting:
    """
    Return a copy of the losses of a graph, by row instead of by id.

    Parameters
    ----------
    reweighting : Reweighting, of its constraints

    """
    edges, observed = reweighting.saved()
    copy = Reweighting()
    copy.restore(replace(edges, rows=graph.edge_rows(edges.rows)),
                 replace(observed, rows=graph.observed_rows(observed.rows)))
    return copy
