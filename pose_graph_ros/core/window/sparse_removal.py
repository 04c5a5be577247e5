# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Nodes leave a graph that stays sparse.

What they tell of their neighbours becomes edges and observed nodes of the kind PRIOR. Those that
are between the same neighbours already go into the same approximation, so that their number stays
in proportion to the number of nodes however often nodes leave.
"""

from dataclasses import replace

import numpy as np

from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.graph_update import Left
from pose_graph_ros.core.graph.incidence import constraints_on
from pose_graph_ros.core.graph.priors import Prior
from pose_graph_ros.core.marginalization.marginalize import marginal, marginalize
from pose_graph_ros.core.marginalization.sparsification import SparsePrior, sparsify
from pose_graph_ros.core.window.bias_cuts import Cuts, NO_CUTS

# So many loop closures leave at once.
MOST_CLOSURES = 5
NONE: IntArray = np.empty(0, dtype=np.int64)
# Edges beyond the tree, for each of its nodes. A tree alone costs 8 % in rms where a hall is
# driven 30 times, this 1 %.
EXTRA = 0.5
# The same for the prior that a window leaves: every group that leaves is approximated again, and
# the losses of all of them add up. No more are added where the divergence is small [nats], or
# where there are so many measurements that the convex problem takes too long.
MOST_EXTRA, ENOUGH, MOST = 3.0, 0.1, 50
# Priors on more poses stay dense: the convex problem takes 0.3 s of a processor for so many.
MOST_POSES = 20


def sparse_removal(
    graph: Graph, nodes: IntArray, edges: IntArray = NONE, observed: IntArray = NONE,
    cuts: Cuts = NO_CUTS,
) -> GraphUpdate | None:
    """
    Return the update by which nodes leave, and edges and observed nodes take their place.

    No covariance becomes smaller by it. None if something else than poses is connected with them,
    or what they tell is too stiff for double precision.

    Parameters
    ----------
    graph : Graph
    nodes : ndarray of int, ids of poses, and of biases that leave with them
    edges, observed : ndarray of int, ids of further constraints that leave
    cuts : Cuts, of the chains of the biases

    """
    table, of_nodes = graph.edges, graph.observed
    with_nodes = constraints_on(graph, nodes)
    leaves = (np.isin(graph.edge_ids, np.union1d(with_nodes[0], edges)) & (table.weight > 0.0)
              & ~np.isin(graph.edge_ids, [cut.edge for cut in cuts.cuts]))
    leave = np.isin(graph.observed_ids, observed) & (of_nodes.weight > 0.0)
    of_priors = [prior.nodes for prior in graph.priors if np.any(np.isin(prior.nodes, nodes))]
    around = np.setdiff1d(np.concatenate((
        table.i[leaves], table.j[leaves], table.k[leaves], of_nodes.node[leave], *of_priors)),
        (*nodes, -1))
    if not np.all(graph.is_pose[graph.node_rows(around)]):
        return None
    earlier = ((table.kind == EdgeKind.PRIOR) & np.isin(table.i, around)
               & np.isin(table.j, around))
    earlier_observed = (of_nodes.kind == ObservedKind.PRIOR) & np.isin(of_nodes.node, around)
    more = np.union1d(edges, graph.edge_ids[earlier])
    more_observed = np.union1d(observed, graph.observed_ids[earlier_observed])
    sparse = _approximation(
        marginal(graph, nodes, more.tolist(), more_observed.tolist(), cuts.cuts).prior)
    if sparse is None:
        return None
    return GraphUpdate(
        edges=sparse.edges, observed=ObservedNodes.joined([sparse.observed, cuts.observed]),
        remove_nodes=nodes.tolist(),
        # the others leave with the nodes
        drop_edges=np.setdiff1d(more, with_nodes[0]).tolist(),
        drop_observed=np.setdiff1d(more_observed, with_nodes[1]).tolist())


def sparse_marginalization(graph: Graph, nodes: IntArray) -> GraphUpdate:
    """
    Return the update by which nodes of any kind leave, with as few dense priors as possible.

    As `marginalize`, but priors on poses become edges and observed nodes, by which no covariance
    becomes smaller, and those with biases small priors of each bias and a pose as well. Those with
    landmarks stay dense, and so do those on more than `MOST_POSES` nodes.

    Parameters
    ----------
    graph : Graph
    nodes : ndarray of int, ids of hidden nodes

    """
    update = marginalize(graph, nodes.tolist())
    edges, observed, dense = [update.edges], [update.observed], list[Prior]()
    for prior in update.priors:
        sparse = _of_window(graph, prior) if len(prior.nodes) <= MOST_POSES else None
        if sparse is not None:
            dense += sparse.priors
            edges.append(sparse.edges)
            observed.append(sparse.observed)
        else:
            dense.append(prior)
    return update._replace(
        edges=Edges.joined(edges), observed=ObservedNodes.joined(observed), priors=dense)


def _of_window(graph: Graph, prior: Prior) -> SparsePrior | None:
    """Return what stands for a prior that a window leaves; None if it has to stay dense."""
    rows = graph.node_rows(prior.nodes)
    order = np.argsort(~graph.is_pose[rows], kind='stable')
    n = int(np.count_nonzero(graph.is_pose[rows]))
    n_biases = len(rows) - n
    if n == 0 or np.count_nonzero(graph.is_bias[rows]) < n_biases:
        return None
    if n_biases > 0:
        # alone they are as sparse as they can be
        if n <= 1 or not prior.anchored:
            return None
        at = (3 * order[:, None] + np.arange(3)).ravel()
        prior = replace(
            prior, nodes=prior.nodes[order], reference=prior.reference[order],
            information=prior.information[np.ix_(at, at)], vector=prior.vector[at])
    return _approximation(prior, min(MOST_EXTRA, MOST / n - 1.0), ENOUGH, n_biases)


def _approximation(
    prior: Prior | None, extra: float = EXTRA, enough: float = 1e-9, n_biases: int = 0,
) -> SparsePrior | None:
    """
    Return what stands for a prior; None if it is too stiff for double precision.

    Parameters
    ----------
    prior : Prior, optional
    extra : float, most edges beyond the tree, for each of its nodes
    enough : float, divergence from which on none is added [nats]
    n_biases : int, how many of its nodes, the last ones, are biases

    """
    if prior is None:
        return SparsePrior(Edges(), ObservedNodes(), 0.0)
    try:
        return sparsify(
            prior.nodes, prior.reference, prior.information, prior.vector, enough=enough,
            anchored=prior.anchored, n_extra=round(extra * (len(prior.nodes) - n_biases)),
            n_biases=n_biases)
    except np.linalg.LinAlgError:
        return None


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
            ids = graph.edge_ids[inside].tolist()
            sparse = _approximation(marginal(graph, (), ids).prior)
            if sparse is not None:
                return GraphUpdate(edges=sparse.edges, drop_edges=ids)
    return None


def old_closures(graph: Graph, newest: int, most: float) -> IntArray:
    """
    Return ids of loop closures that nothing else lets go, some of the oldest, if there are many.

    They are between poses that stay, and were there before the newest poses.

    Parameters
    ----------
    graph : Graph
    newest : int, number of poses that are not old
    most : float, number of such closures for each pose up to which they stay

    """
    edges, older = graph.edges, graph.node_ids[graph.is_pose][:-newest]
    old = np.isin(edges.i, older) & np.isin(edges.j, older)
    first = int(np.min(np.flatnonzero(~old & (edges.kind == EdgeKind.ODOMETRY)), initial=len(old)))
    closures = np.flatnonzero(old[:first] & (edges.kind[:first] == EdgeKind.LOOP_CLOSURE))
    many = len(closures) > most * np.count_nonzero(graph.is_pose)
    return graph.edge_ids[closures[:MOST_CLOSURES]] if many else NONE


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
    gone = np.isin(edges.i, nodes) | np.isin(edges.j, nodes) | np.isin(edges.k, nodes)
    return Left(
        np.sort(nodes), np.union1d(graph.edge_ids[gone], list(update.drop_edges)).astype(np.int64),
        np.union1d(graph.observed_ids[np.isin(observed.node, nodes)],
                   list(update.drop_observed)).astype(np.int64))
