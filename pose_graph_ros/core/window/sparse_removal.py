# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Nodes leave a graph that stays sparse.

What they tell of their neighbours becomes edges and observed nodes of the kind PRIOR. Those that
are between the same neighbours already go into the same approximation, so that their number stays
in proportion to the number of nodes however often nodes leave.

Where the older part of a chain of biases leaves and the rest stays, the chain is cut. The leaving
part and the next state y are connected by one edge, `E(x, y)`, of the last leaving state x. With
a, the information that its own part of the chain has on x, y alone would know

    F(y) = min_x (a x^2 + E(x, y)),

and since F is that minimum, for each share w between 0 and 1

    E(x, y) >= (1 - w) F(y) - (1 - w) a x^2.

So the edge may be replaced by an observation of y with the information of (1 - w) F, if
(1 - w) a is taken off x, whose own part has a of it: what remains of both parts, independent now,
is nowhere more than what both know together. w is the share that the leaving part keeps of what
is common to both: small where the part is short against the time constant of the bias.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.graph_update import Left
from pose_graph_ros.core.graph.priors import model, Prior
from pose_graph_ros.core.marginalization.marginalize import (
    as_observed,
    columns_of,
    Cut,
    eliminate,
    equations,
    marginal,
    marginalize,
    part_of,
    schur_complement,
)
from pose_graph_ros.core.marginalization.sparsification import SparsePrior, sparsify


@dataclass(frozen=True, slots=True)
class Limits:
    """When and how much leaves at once, and how sparse the rest becomes."""

    # a window: nodes leave in groups of this share of it, the newest few stay, and what is needed
    # stays until it is so many times as old; after a failure none leaves before so many have come
    group: float = 0.125
    newest: int = 3
    longest_hold: float = 2.0
    rest: int = 20
    # its prior: edges beyond the tree for each node, as every group that leaves is approximated
    # again and the losses add up; none is added for less divergence [nats], or where there are so
    # many that the convex problem takes too long; on more poses it stays dense, as that problem
    # takes 0.3 s of a processor for so many
    window_extra: float = 3.0
    window_enough: float = 0.1
    window_edges: int = 50
    window_poses: int = 20

    # thinning: nodes leave whenever so many new ones have been made; so many are looked at each
    # time, and for each new node a group leaves, but not more than so many
    every: int = 10
    looked_at: int = 40
    pieces: int = 20
    # so many poses are compared at once, or as many as stay: the pairs of all would need too much
    # memory where a place has been driven often before it is thinned
    compared: int = 256
    # a group has at most this many nodes, and about this many neighbours in all
    group_nodes: int = 10
    group_neighbours: int = 12
    # edges beyond the tree for each node; a tree alone costs 8 % in rms where a hall is driven 30
    # times, this 1 %
    extra: float = 0.5
    # edges of the kind PRIOR for each pose, above which some are replaced by fewer ones, and how
    # often in one step
    prior_edges: float = 2.5
    replaced: int = 3

    # fixes, poses and rotations for each pose that stays, up to which they stay as well, with
    # their nodes: what they tell of the errors they have in common is exact only as long as they
    # are in the graph; a small area counts as so many times the newest nodes
    measurements: float = 2.0
    least_area: int = 4
    # they leave by stretches of so many poses, with about so many in or around it that stay, or of
    # so many if a bias is in use that long: half a minute of a car in a town
    stretch: int = 10
    stretch_around: int = 12
    longest_stretch: int = 100
    # loop closures between nodes that stay, for each pose, above which the oldest become priors,
    # and how many at once
    old_closures: float = 0.5
    closures_at_once: int = 5
    # a measurement that comes twice is refused the second time, if it is not older than that [ns]
    repeated_ns: int = 3600 * 1_000_000_000


LIMITS = Limits()


class Cuts(NamedTuple):
    """Edges of chains of biases that are cut, and what stays on the other side."""

    cuts: Sequence[Cut]
    observed: Factors  # on the first states that stay, of the kind NODE_PRIOR


NO_CUTS = Cuts((), Factors())


def cut_chains(graph: Graph, biases: IntArray) -> Cuts | None:
    """Return where the chains of some biases are cut; None if one has several ends that stay."""
    edges = graph.factors
    rows = np.flatnonzero((edges.weight > 0.0) & (edges.j >= 0) & (edges.k < 0)
                          & (np.isin(edges.i, biases) | np.isin(edges.j, biases)))
    ends = np.column_stack((edges.i[rows], edges.j[rows]))
    rows, ends = (each[np.all(graph.is_bias[graph.node_rows(ends)], axis=1)]
                  for each in (rows, ends))
    leaves = np.isin(ends, biases)
    inside = np.all(leaves, axis=1)
    found, observed, seen = list[Cut](), list[Factors](), set[int]()
    for row, pair, first in zip(rows[~inside].tolist(), ends[~inside].tolist(),
                                leaves[~inside, 0].tolist(), strict=True):
        x, y = pair if first else pair[::-1]
        chain = _chain(x, ends[inside])
        if not seen.isdisjoint(chain):
            return None
        seen.update(chain)
        cut, rest = _cut(graph, np.array((*chain, y)), rows[inside], row)
        found.append(cut)
        observed.append(rest)
    return Cuts(found, Factors.joined(observed))


def _chain(first: int, ends: IntArray) -> list[int]:
    """Return the nodes that edges connect with a first one, in the order of the way to them."""
    near: dict[int, list[int]] = {}
    for i, j in ends.tolist():
        near.setdefault(i, []).append(j)
        near.setdefault(j, []).append(i)
    chain = [first]
    for node in chain:
        chain += [other for other in near.get(node, ()) if other not in chain]
    return chain


def _cut(graph: Graph, nodes: IntArray, inside: IntArray, edge: int) -> tuple[Cut, Factors]:
    """Return a cut, and what it leaves on the state that stays."""
    factors = graph.factors
    chain = inside[np.isin(factors.i[inside], nodes)]
    seen = np.flatnonzero(
        (factors.j < 0) & np.isin(factors.i, nodes[:-1]) & (factors.weight > 0.0))
    part = part_of(graph, np.sort(nodes), np.sort(np.concatenate((chain, seen, (edge,)))))
    order = np.argsort(np.argsort(nodes))
    (x, y), last = columns_of(order[[0, -1]]).reshape(2, 3), order[-2]
    whole, own_b = equations(part)
    part.apply(GraphUpdate(weigh={int(graph.factor_ids[edge]): 0.0}))
    H, b = equations(part)
    between = (whole - H)[np.ix_((*x, *y), (*x, *y))], (own_b - b)[[*x, *y]]
    # of the state that is cut off, and the same if the first one were known
    _add_priors(graph, nodes, order, H, b)
    own, fixed = (_of_first(H.copy(), b.copy(), order, known) for known in (-1, last))
    after, later = (_through(each, between) for each in (own, fixed))
    if len(nodes) == 2:     # the only one is the first one
        later = between[0][3:, 3:], between[1][3:]
    # so much of the variance of the next state is new since the first one
    new = min(float(after[0][0, 0] / max(later[0][0, 0], 1e-300)), 1.0 - 1e-9)
    given = 1.0 / (1.0 - 0.5 * math.log(1.0 - new))
    if after[0][0, 0] < 1e-9 * between[0][3, 3]:
        # a chain of which nothing is known but its steps, and the rest is rounding
        return Cut(int(graph.factor_ids[edge]), int(nodes[0]), 0.0 * own[0], 0.0 * own[1]), (
            Factors())
    reference = graph.poses_of(nodes[-1:])
    rest = as_observed(
        Prior(nodes[-1:], reference, given * after[0], given * after[1], 0.0, True))
    return Cut(int(graph.factor_ids[edge]), int(nodes[0]), given * own[0], given * own[1]), rest


def _add_priors(
    graph: Graph, nodes: IntArray, order: IntArray, H: FloatArray, b: FloatArray,
) -> None:
    """Add to the equations of a chain what dense priors tell of it alone."""
    for prior in graph.priors:
        known, at, of = np.intersect1d(nodes[:-1], prior.nodes, return_indices=True)
        if len(known) == 0:
            continue
        rows = graph.node_rows(prior.nodes)
        linear = model(prior, graph.poses[rows], graph.is_pose[rows])
        others = np.ones(len(prior.vector), dtype=bool)
        others[columns_of(of)] = False
        U, u = schur_complement(linear.information, -linear.gradient, others)
        # what is left is in the order of the prior's nodes
        columns = columns_of(order[at[np.argsort(of)]])
        H[np.ix_(columns, columns)] += U
        b[columns] += u


def _of_first(
    H: FloatArray, b: FloatArray, order: IntArray, known: int,
) -> tuple[FloatArray, FloatArray]:
    """Return what a chain tells of its first node; its equations are changed."""
    if known >= 0:
        at = columns_of(np.array([known]))
        H[at], H[:, at], b[at] = 0.0, 0.0, 0.0
    others = order[1:-1]
    eliminate(H, b, others, np.diagonal(H).copy())
    at = columns_of(order[:1])
    return H[np.ix_(at, at)], b[at]


def _through(
    own: tuple[FloatArray, FloatArray], edge: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return what is known of one end of an edge from what is known of the other one."""
    H, b = edge[0].copy(), edge[1].copy()
    H[:3, :3] += own[0]
    b[:3] += own[1]
    return schur_complement(H, b, np.arange(6) < 3)


NONE: IntArray = np.empty(0, dtype=np.int64)


def sparse_removal(
    graph: Graph, nodes: IntArray, factors: IntArray = NONE, cuts: Cuts = NO_CUTS,
) -> GraphUpdate | None:
    """
    Return the update by which nodes leave, and edges and observed nodes take their place.

    No covariance becomes smaller by it. None if something else than poses is connected with them,
    or what they tell is too stiff for double precision.
    """
    table, ids, with_nodes = graph.factors, graph.factor_ids, graph.factors_on(nodes)
    leaves = (np.isin(ids, np.union1d(with_nodes, factors)) & (table.weight > 0.0)
              & ~np.isin(ids, [cut.edge for cut in cuts.cuts]))
    of_priors = [prior.nodes for prior in graph.priors if np.any(np.isin(prior.nodes, nodes))]
    around = np.setdiff1d(np.concatenate((
        table.i[leaves], table.j[leaves], table.k[leaves], *of_priors)), (*nodes, -1))
    if not np.all(graph.is_pose[graph.node_rows(around)]):
        return None
    earlier = (np.isin(table.kind, (FactorKind.PRIOR, FactorKind.NODE_PRIOR))
               & np.isin(table.i, around) & np.isin(table.j, (*around, -1)))
    more = np.union1d(factors, ids[earlier])
    sparse = _approximation(marginal(graph, nodes, more.tolist(), cuts.cuts).prior)
    if sparse is None:
        return None
    return GraphUpdate(
        factors=Factors.joined([sparse.factors, cuts.observed]), remove_nodes=nodes.tolist(),
        # the others leave with the nodes
        drop=np.setdiff1d(more, with_nodes).tolist())


def sparse_marginalization(graph: Graph, nodes: IntArray) -> GraphUpdate:
    """
    Return the update by which nodes of any kind leave, with as few dense priors as possible.

    As `marginalize`, but priors on poses become edges and observed nodes, by which no covariance
    becomes smaller, and those with biases small priors of each bias and a pose as well. Those with
    landmarks stay dense, and so do those on many nodes.
    """
    update = marginalize(graph, nodes.tolist())
    factors, dense = [update.factors], list[Prior]()
    for prior in update.priors:
        sparse = _of_window(graph, prior) if len(prior.nodes) <= LIMITS.window_poses else None
        if sparse is not None:
            dense += sparse.priors
            factors.append(sparse.factors)
        else:
            dense.append(prior)
    return update._replace(factors=Factors.joined(factors), priors=dense)


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
    extra = min(LIMITS.window_extra, LIMITS.window_edges / n - 1.0)
    return _approximation(prior, extra, LIMITS.window_enough, n_biases)


def _approximation(
    prior: Prior | None, extra: float = LIMITS.extra, enough: float = 1e-9, n_biases: int = 0,
) -> SparsePrior | None:
    """
    Return what stands for a prior; None if it is too stiff for double precision.

    There are at most `extra` edges beyond the tree for each of its nodes, and none is added once
    the divergence is small `enough` [nats]. The last `n_biases` nodes are biases.
    """
    if prior is None:
        return SparsePrior(Factors(), 0.0)
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
    """
    edges = graph.factors
    prior = np.flatnonzero(edges.kind == FactorKind.PRIOR)
    if len(prior) <= most * np.count_nonzero(graph.is_pose):
        return None
    near: dict[int, set[int]] = {}
    for i, j in zip(edges.i[prior].tolist(), edges.j[prior].tolist(), strict=True):
        near.setdefault(i, set()).add(j)
        near.setdefault(j, set()).add(i)
    for first in sorted(near, key=lambda node: -len(near[node])):
        group = _dense_group(near, first)
        inside = prior[np.isin(edges.i[prior], group) & np.isin(edges.j[prior], group)]
        if len(inside) > len(group) - 1 + round(LIMITS.extra * len(group)):
            ids = graph.factor_ids[inside].tolist()
            sparse = _approximation(marginal(graph, (), ids).prior)
            if sparse is not None:
                return GraphUpdate(factors=sparse.factors, drop=ids)
    return None


def old_closures(graph: Graph, newest: int, most: float) -> IntArray:
    """
    Return ids of loop closures that nothing else lets go, some of the oldest, if there are many.

    They are between poses that stay, and were there before the newest poses.
    """
    edges, older = graph.factors, graph.node_ids[graph.is_pose][:-newest]
    old = np.isin(edges.i, older) & np.isin(edges.j, older)
    newer = np.flatnonzero(~old & (edges.kind == FactorKind.ODOMETRY))
    first = int(np.min(newer, initial=len(old)))
    closures = np.flatnonzero(old[:first] & (edges.kind[:first] == FactorKind.LOOP_CLOSURE))
    many = len(closures) > most * np.count_nonzero(graph.is_pose)
    return graph.factor_ids[closures[:LIMITS.closures_at_once]] if many else NONE


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
    """Return what leaves a graph with an update, factors with weight 0 included."""
    nodes = np.array(update.remove_nodes, dtype=np.int64)
    return Left(np.sort(nodes), np.union1d(
        graph.factors_on(nodes), list(update.drop)).astype(np.int64))
