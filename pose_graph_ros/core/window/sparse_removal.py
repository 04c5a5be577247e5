# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Nodes leave a graph that stays sparse.

What they tell of their neighbours becomes edges and observed nodes of the kind PRIOR. Those that
are between the same neighbours already go into the same approximation, so that their number stays
in proportion to the number of nodes however often nodes leave.
"""

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.graph_update import Left
from pose_graph_ros.core.marginalization.pose_marginal import POSE_EDGES, pose_marginal
from pose_graph_ros.core.marginalization.sparsification import SparsePrior, sparsify

# Edges beyond the tree, for each of its nodes. A tree alone costs 8 % in rms where a hall is
# driven 30 times, this 1 %.
EXTRA = 0.5


def can_leave(graph: Graph, nodes: IntArray) -> bool:
    """
    Tell whether all edges of nodes lead to other poses, as `sparse_removal` needs it.

    Parameters
    ----------
    graph : Graph
    nodes : ndarray of int, ids of hidden nodes

    """
    edges = graph.edges
    return bool(np.all(np.isin(edges.kind[_touching(edges, nodes)], POSE_EDGES)))


def sparse_removal(graph: Graph, nodes: IntArray) -> GraphUpdate:
    """
    Return the update by which nodes leave, and edges and observed nodes take their place.

    No covariance becomes smaller by it.

    Parameters
    ----------
    graph : Graph
    nodes : ndarray of int, ids of hidden nodes that `can_leave`

    """
    edges, observed = graph.edges, graph.observed
    of_edges = _touching(edges, nodes)
    around = np.setdiff1d(np.concatenate((edges.i[of_edges], edges.j[of_edges])), nodes)
    earlier = ((edges.kind == EdgeKind.PRIOR) & np.isin(edges.i, around)
               & np.isin(edges.j, around))
    earlier_observed = (observed.kind == ObservedKind.PRIOR) & np.isin(observed.node, around)
    sparse = _approximation(
        graph, nodes, of_edges | earlier,
        (np.isin(observed.node, nodes) & (observed.weight > 0.0)) | earlier_observed)
    return GraphUpdate(
        edges=sparse.edges, observed=sparse.observed, remove_nodes=nodes.tolist(),
        drop_edges=graph.edge_ids[earlier].tolist(),
        drop_observed=graph.observed_ids[earlier_observed].tolist())


def _touching(edges: Edges, nodes: IntArray) -> BoolArray:
    """Return which edges with a weight have one of the nodes, shape (M,)."""
    return (edges.weight > 0.0) & (
        np.isin(edges.i, nodes) | np.isin(edges.j, nodes) | np.isin(edges.k, nodes))


def _approximation(
    graph: Graph, nodes: IntArray, edges: BoolArray, observed: BoolArray,
) -> SparsePrior:
    """Return what stands for some constraints, by row, when nodes leave."""
    prior = pose_marginal(graph, nodes, edges, observed)
    return sparsify(prior.nodes, prior.poses, prior.information, prior.vector,
                    anchored=prior.anchored, n_extra=round(EXTRA * len(prior.nodes)))


def with_fewer_edges(graph: Graph, most: float) -> GraphUpdate | None:
    """
    Return an update that replaces edges of the kind PRIOR by fewer ones, or None if there are few.

    They are those within a group of nodes that have many of them to each other.

    Parameters
    ----------
    graph : Graph
    most : float, number of such edges for each pose up to which nothing is done

    """
    edges = graph.edges
    prior = np.flatnonzero(edges.kind == EdgeKind.PRIOR)
    if len(prior) <= most * np.count_nonzero(graph.is_pose):
        return None
    near: dict[int, set[int]] = {}
    for i, j in zip(edges.i[prior].tolist(), edges.j[prior].tolist(), strict=True):
        near.setdefault(i, set()).add(j)
        near.setdefault(j, set()).add(i)
    for first in sorted(near, key=lambda node: -len(near[node])):
        group = _dense_group(near, first)
        inside = prior[np.isin(edges.i[prior], group) & np.isin(edges.j[prior], group)]
        if len(inside) > len(group) - 1 + round(EXTRA * len(group)):
            chosen = np.zeros(len(edges), dtype=bool)
            chosen[inside] = True
            sparse = _approximation(graph, group[:0], chosen, np.zeros(graph.n_observed, bool))
            return GraphUpdate(
                edges=sparse.edges, drop_edges=graph.edge_ids[inside].tolist())
    return None


def _dense_group(near: dict[int, set[int]], first: int, size: int = 10) -> IntArray:
    """Return nodes around a first one, each time the one with the most edges to the others."""
    group = [first]
    links = dict.fromkeys(near[first], 1)
    while links and len(group) < size:
        node = max(links, key=lambda node: (links[node], len(near[node]), -node))
        del links[node]
        group.append(node)
        for other in near[node].difference(group):
            links[other] = links.get(other, 0) + 1
    return np.array(sorted(group), dtype=np.int64)


def leaving(graph: Graph, update: GraphUpdate) -> Left:
    """
    Return what leaves a graph with an update, constraints with weight 0 included.

    Parameters
    ----------
    graph : Graph, before the update
    update : GraphUpdate

    """
    edges, observed = graph.edges, graph.observed
    nodes = np.array(update.remove_nodes, dtype=np.int64)
    gone = np.isin(edges.i, nodes) | np.isin(edges.j, nodes)
    return Left(
        np.sort(nodes), np.union1d(graph.edge_ids[gone], list(update.drop_edges)).astype(np.int64),
        np.union1d(graph.observed_ids[np.isin(observed.node, nodes)],
                   list(update.drop_observed)).astype(np.int64))
