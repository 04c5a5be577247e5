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

from collections.abc import Iterator, Mapping, Set
from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.priors import model, Prior
from pose_graph_ros.core.marginalization import marginalize as mg, sparsification


class Limits(NamedTuple):
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
    # edges of the kind PRIOR and old loop closures for each pose, above which some are replaced by
    # fewer ones: late closures between nodes that stay would pile up
    edges: float = 2.5

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
    # a measurement that comes twice is refused the second time, if it is not older than that [ns]
    repeated_ns: int = 3600 * 1_000_000_000


LIMITS = Limits()
NONE: IntArray = np.empty(0, dtype=np.int64)


def cut_chains(graph: Graph, biases: IntArray) -> tuple[list[mg.Cut], list[Factors]] | None:
    """
    Return where the chains of some biases, ascending, are cut; None if one has several such ends.

    With each cut comes what it leaves on the first state that stays, of the kind NODE_PRIOR.
    """
    from scipy.sparse.csgraph import breadth_first_order  # noqa: PLC0415  most graphs do not need it

    factors = graph.factors
    rows = np.flatnonzero((factors.weight > 0.0) & (factors.j >= 0) & (factors.k < 0)
                          & (np.isin(factors.i, biases) | np.isin(factors.j, biases)))
    ends = np.column_stack((factors.i[rows], factors.j[rows]))
    rows, ends = (each[np.all(graph.is_bias[graph.node_rows(ends)], axis=1)]
                  for each in (rows, ends))
    leaves = np.isin(ends, biases)
    inside = np.all(leaves, axis=1)
    between = np.searchsorted(biases, ends[inside]).T
    near = np.zeros((len(biases), len(biases)), dtype=bool)
    near[tuple(between)] = True
    cuts, observed, seen = list[mg.Cut](), list[Factors](), set[int]()
    for row, pair, first in zip(rows[~inside].tolist(), ends[~inside].tolist(),
                                leaves[~inside, 0].tolist(), strict=True):
        x, y = pair if first else pair[::-1]
        # from the cut back
        chain = biases[breadth_first_order(
            near, int(np.searchsorted(biases, x)), directed=False, return_predecessors=False)]
        if not seen.isdisjoint(chain.tolist()):
            return None
        seen.update(chain.tolist())
        cut, rest = _cut(graph, np.append(chain, y), rows[inside], row)
        cuts.append(cut)
        observed.append(rest)
    return cuts, observed


def _cut(graph: Graph, nodes: IntArray, inside: IntArray, edge: int) -> tuple[mg.Cut, Factors]:
    """Return a cut, and what it leaves on the state that stays: the last one of the nodes."""
    factors = graph.factors
    chain = inside[np.isin(factors.i[inside], nodes)]
    seen = np.flatnonzero(
        (factors.j < 0) & np.isin(factors.i, nodes[:-1]) & (factors.weight > 0.0))
    priors = []     # what dense priors tell of the chain alone
    for prior in graph.priors:
        known = np.isin(prior.nodes, nodes[:-1])
        if np.any(known):
            rows = graph.node_rows(prior.nodes)
            linear = model(prior, graph.poses[rows], graph.is_pose[rows])
            U, u = mg.schur_complement(
                linear.information, -linear.gradient, np.flatnonzero(~known))
            priors.append(Prior(prior.nodes[known], graph.poses[rows[known]], U, u, 0.0, True))
    rows = np.sort(np.concatenate((chain, seen, (edge,))))
    part = mg.part_of(graph, np.sort(nodes), rows, priors)
    x, first, y = part.node_rows(nodes[[0, -2, -1]])
    H, b = mg.equations(part)
    number = int(graph.factor_ids[edge])
    part.apply(GraphUpdate(weigh={number: 0.0}))
    without, without_b = mg.equations(part)
    own = _of_one(without, without_b, x)
    after, of_edge = _of_one(H, b, y), (H - without)[3 * y, 3 * y]
    # the same if the first state were known: so much of the variance of y is new since then
    at = mg.columns_of(np.array([first]))
    H[at], H[:, at], b[at] = 0.0, 0.0, 0.0
    later = _of_one(H, b, y)
    new = min(float(after[0][0, 0] / max(later[0][0, 0], 1e-300)), 1.0 - 1e-9)
    given = 1.0 / (1.0 - 0.5 * math.log(1.0 - new))
    if after[0][0, 0] < 1e-9 * of_edge:
        # a chain of which nothing is known but its steps, and the rest is rounding
        return mg.Cut(number, int(nodes[0]), 0.0 * own[0], 0.0 * own[1]), Factors()
    rest = mg.as_observed(Prior(
        nodes[-1:], graph.poses_of(nodes[-1:]), given * after[0], given * after[1], 0.0, True))
    return mg.Cut(number, int(nodes[0]), given * own[0], given * own[1]), rest


def _of_one(H: FloatArray, b: FloatArray, row: int) -> tuple[FloatArray, FloatArray]:
    """Return what the equations of a chain tell of one of its nodes."""
    return mg.schur_complement(H, b, np.delete(np.arange(len(b) // 3), row))


def sparse_removal(graph: Graph, nodes: IntArray, factors: IntArray = NONE) -> GraphUpdate | None:
    """
    Return the update by which nodes, ascending, and factors leave, and few take their place.

    These are edges and observed nodes. No covariance becomes smaller by it. None if something else
    than poses is connected with what leaves, but for chains of biases that can be cut, or if what
    it tells is too stiff for double precision.
    """
    cut = cut_chains(graph, nodes[graph.is_bias[graph.node_rows(nodes)]])
    if cut is None:
        return None
    cuts, observed = cut
    table, ids, with_nodes = graph.factors, graph.factor_ids, graph.factors_on(nodes)
    leaves = (np.isin(ids, np.union1d(with_nodes, factors)) & (table.weight > 0.0)
              & ~np.isin(ids, [cut.edge for cut in cuts]))
    of_priors = [prior.nodes for prior in graph.priors if np.any(np.isin(prior.nodes, nodes))]
    around = np.setdiff1d(np.concatenate((
        table.i[leaves], table.j[leaves], table.k[leaves], *of_priors)), (*nodes, -1))
    if not np.all(graph.is_pose[graph.node_rows(around)]):
        return None
    earlier = (np.isin(table.kind, (FactorKind.PRIOR, FactorKind.NODE_PRIOR))
               & np.isin(table.i, around) & np.isin(table.j, (*around, -1)))
    more = np.union1d(factors, ids[earlier])
    prior = mg.marginal(graph, nodes, more.tolist(), cuts)
    try:
        told = [] if prior is None else [
            sparsification.sparsify(prior, n_extra=round(LIMITS.extra * len(prior.nodes))).factors]
    except np.linalg.LinAlgError:
        return None
    return GraphUpdate(
        factors=Factors.joined([*told, *observed]), remove_nodes=nodes.tolist(),
        # the others leave with the nodes
        drop=np.setdiff1d(more, with_nodes).tolist())


def sparse_marginalization(graph: Graph, nodes: IntArray) -> GraphUpdate:
    """
    Return the update by which nodes of any kind leave, with as few dense priors as possible.

    As `marginalize`, but priors on poses become edges and observed nodes, by which no covariance
    becomes smaller, and those with biases small priors of each bias and a pose as well. Those with
    landmarks stay dense, and so do those on many nodes.
    """
    update = mg.marginalize(graph, nodes.tolist())
    factors, dense = [update.factors], list[Prior]()
    for prior in update.priors:
        try:
            sparse = _of_window(graph, prior) if len(prior.nodes) <= LIMITS.window_poses else None
        except np.linalg.LinAlgError:   # too stiff for double precision
            sparse = None
        dense += [prior] if sparse is None else sparse.priors
        factors += [] if sparse is None else [sparse.factors]
    return update._replace(factors=Factors.joined(factors), priors=dense)


def _of_window(graph: Graph, prior: Prior) -> sparsification.SparsePrior | None:
    """Return what stands for a prior that a window leaves; None if it has to stay dense."""
    rows = graph.node_rows(prior.nodes)
    is_pose = graph.is_pose[rows]
    n = int(np.count_nonzero(is_pose))
    n_biases = len(rows) - n
    if n == 0 or np.count_nonzero(graph.is_bias[rows]) < n_biases:
        return None
    if n_biases > 0:
        # alone they are as sparse as they can be
        if n <= 1 or not prior.anchored:
            return None
        order = np.argsort(~is_pose, kind='stable')
        at = mg.columns_of(order)
        prior = replace(
            prior, nodes=prior.nodes[order], reference=prior.reference[order],
            information=prior.information[np.ix_(at, at)], vector=prior.vector[at])
    extra = min(LIMITS.window_extra, LIMITS.window_edges / n - 1.0)
    return sparsification.sparsify(
        prior, n_extra=round(extra * n), enough=LIMITS.window_enough, n_biases=n_biases)


def crowded_edges(graph: Graph, newest: int) -> Iterator[IntArray]:
    """
    Yield ids of edges that fewer ones could replace, if there are many in all.

    They are those within a group of nodes that have many of them to each other, the most first:
    edges of the kind PRIOR, and loop closures that were there before the newest poses.
    """
    edges, older = graph.factors, graph.node_ids[graph.is_pose][:-newest]
    ends = np.column_stack((edges.i, edges.j))
    old = np.all(np.isin(ends, older), axis=1)
    # what waits on new poses is still to be judged
    newer = np.flatnonzero(~old & (edges.kind == FactorKind.ODOMETRY))
    old[int(np.min(newer, initial=len(old))):] = False
    rows = np.flatnonzero((edges.kind == FactorKind.PRIOR)
                          | (old & (edges.kind == FactorKind.LOOP_CLOSURE)))
    if len(rows) <= LIMITS.edges * np.count_nonzero(graph.is_pose):
        return
    ends = ends[rows]
    near = neighbours(np.unique(ends), ends)
    for first in sorted(near, key=lambda node: -len(near[node])):
        group = grown(near, first, LIMITS.group_nodes, math.inf)
        inside = rows[np.all(np.isin(ends, group), axis=1)]
        if len(inside) > len(group) - 1 + round(LIMITS.extra * len(group)):
            yield graph.factor_ids[inside]


def neighbours(nodes: IntArray, ends: IntArray) -> dict[int, set[int]]:
    """Return what edges, given by their ends, shape (M, 2), connect each of some nodes with."""
    near: dict[int, set[int]] = {node: set() for node in nodes.tolist()}
    for i, j in ends[np.isin(ends, nodes).any(axis=1)].tolist():
        for one, other in ((i, j), (j, i)):
            if one in near:
                near[one].add(other)
    return near


def grown(near: Mapping[int, Set[int]], first: int, size: int, most_around: float) -> IntArray:
    """
    Return a node with others, each time the one that is next to most of those before it.

    There are at most so many nodes in it, and as many as keep the number of those around below a
    limit. A node may be near to some that are not to be chosen.
    """
    group, links = [first], dict.fromkeys(near[first] & near.keys(), 1)
    around = set(near[first])
    while links and len(group) < size:
        node = max(links, key=lambda node: (links[node], -node))
        around |= near[node]
        if len(around.difference(group, (node,))) > most_around:
            break
        del links[node]
        group.append(node)
        for other in (near[node] & near.keys()).difference(group):
            links[other] = links.get(other, 0) + 1
    return np.array(sorted(group), dtype=np.int64)
