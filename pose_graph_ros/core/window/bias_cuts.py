# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where a chain of biases is cut, as its older part leaves the graph and the rest stays.

The leaving part and the next state y are connected by one edge, `E(x, y)`, of the last leaving
state x. With a, the information that its own part of the chain has on x, y alone would know

    F(y) = min_x (a x^2 + E(x, y)),

and since F is that minimum, for each share w between 0 and 1

    E(x, y) >= (1 - w) F(y) - (1 - w) a x^2.

So the edge may be replaced by an observation of y with the information of (1 - w) F, if
(1 - w) a is taken off x, whose own part has a of it: what remains of both parts, independent now,
is nowhere more than what both know together. w is the share that the leaving part keeps of what
is common to both: small where the part is short against the time constant of the bias.
"""

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import ObservedNodes
from pose_graph_ros.core.graph.graph import Graph, GraphRows, GraphUpdate
from pose_graph_ros.core.graph.priors import model, Prior
from pose_graph_ros.core.marginalization.marginalize import (
    as_observed,
    Cut,
    eliminate,
    equations,
    schur_complement,
)


class Cuts(NamedTuple):
    """Edges of chains of biases that are cut, and what stays on the other side."""

    cuts: Sequence[Cut]
    observed: ObservedNodes
    """On the first states that stay, of the kind PRIOR."""


# Less information than this part of that of an edge is rounding.
NOTHING = 1e-9
NO_CUTS = Cuts((), ObservedNodes())


def cut_chains(graph: Graph, biases: IntArray) -> Cuts | None:
    """
    Return where the chains of some biases are cut; None if one has several ends that stay.

    Parameters
    ----------
    graph : Graph
    biases : ndarray of int, ids of the biases that leave

    """
    edges = graph.edges
    rows = np.flatnonzero((edges.weight > 0.0) & (edges.k < 0)
                          & (np.isin(edges.i, biases) | np.isin(edges.j, biases)))
    ends = np.column_stack((edges.i[rows], edges.j[rows]))
    rows, ends = (each[np.all(graph.is_bias[graph.node_rows(ends)], axis=1)]
                  for each in (rows, ends))
    leaves = np.isin(ends, biases)
    inside = np.all(leaves, axis=1)
    found, observed, seen = list[Cut](), list[ObservedNodes](), set[int]()
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
    return Cuts(found, ObservedNodes.joined(observed))


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


def _cut(graph: Graph, nodes: IntArray, inside: IntArray, edge: int) -> tuple[Cut, ObservedNodes]:
    """
    Return a cut, and what it leaves on the state that stays.

    Parameters
    ----------
    graph : Graph
    nodes : ndarray of int, ids of the leaving states from the one that is cut off, then the next
    inside : ndarray of int, rows of the edges between states that leave
    edge : int, row of the edge that is cut

    """
    chain = inside[np.isin(graph.edges.i[inside], nodes)]
    part = _part(graph, nodes, np.append(chain, edge))
    order = np.argsort(np.argsort(nodes))
    (x, y), last = _columns(order[[0, -1]]).reshape(2, 3), order[-2]
    whole, own_b = equations(part)
    part.apply(GraphUpdate(weigh_edges={int(graph.edge_ids[edge]): 0.0}))
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
    if after[0][0, 0] < NOTHING * between[0][3, 3]:
        # a chain of which nothing is known but its steps
        return Cut(int(graph.edge_ids[edge]), int(nodes[0]), 0.0 * own[0], 0.0 * own[1]), (
            ObservedNodes())
    reference = graph.poses_of(nodes[-1:])
    rest = as_observed(
        Prior(nodes[-1:], reference, given * after[0], given * after[1], 0.0, True))
    return Cut(int(graph.edge_ids[edge]), int(nodes[0]), given * own[0], given * own[1]), rest


def _part(graph: Graph, nodes: IntArray, edges: IntArray) -> Graph:
    """
    Return a part of a graph, with the observations of all but the last of its nodes.

    Parameters
    ----------
    graph : Graph
    nodes : ndarray of int, ids
    edges : ndarray of int, rows

    """
    ids, observed = np.sort(nodes), graph.observed
    rows, edges = graph.node_rows(ids), np.sort(edges)
    on_these = np.flatnonzero(np.isin(observed.node, nodes[:-1]) & (observed.weight > 0.0))
    part = Graph()
    part.fill(GraphRows(
        graph.poses[rows], graph.node_kind[rows], graph.fixed[rows], graph.edges.rows(edges),
        observed.rows(on_these), ids, graph.edge_ids[edges], graph.observed_ids[on_these],
        graph.next_ids, graph.dimension[rows]))
    return part


def _add_priors(
    graph: Graph, nodes: IntArray, order: IntArray, H: FloatArray, b: FloatArray,
) -> None:
    """
    Add to the equations of a chain what dense priors tell of it alone.

    Parameters
    ----------
    graph : Graph
    nodes, order : ndarray of int, ids of the nodes and their rows; the last one stays
    H, b : ndarray, equations, which are changed

    """
    for prior in graph.priors:
        known, at, of = np.intersect1d(nodes[:-1], prior.nodes, return_indices=True)
        if len(known) == 0:
            continue
        rows = graph.node_rows(prior.nodes)
        linear = model(prior, graph.poses[rows], graph.is_pose[rows])
        others = np.ones(len(prior.vector), dtype=bool)
        others[_columns(of)] = False
        U, u = schur_complement(linear.information, -linear.gradient, others)
        # what is left is in the order of the prior's nodes
        columns = _columns(order[at[np.argsort(of)]])
        H[np.ix_(columns, columns)] += U
        b[columns] += u


def _of_first(
    H: FloatArray, b: FloatArray, order: IntArray, known: int,
) -> tuple[FloatArray, FloatArray]:
    """
    Return what a chain tells of its first node; its equations are changed.

    Parameters
    ----------
    H, b : ndarray, equations of all nodes
    order : ndarray of int, their rows, in the order of the chain; the last one is not in it
    known : int, row of a node that is where it is, or -1

    """
    if known >= 0:
        at = _columns(np.array([known]))
        H[at], H[:, at], b[at] = 0.0, 0.0, 0.0
    others = order[1:-1]
    eliminate(H, b, others, np.diagonal(H).copy())
    at = _columns(order[:1])
    return H[np.ix_(at, at)], b[at]


def _through(
    own: tuple[FloatArray, FloatArray], edge: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return what is known of one end of an edge from what is known of the other one."""
    H, b = edge[0].copy(), edge[1].copy()
    H[:3, :3] += own[0]
    b[:3] += own[1]
    return schur_complement(H, b, np.arange(6) < 3)


def _columns(rows: IntArray) -> IntArray:
    return np.asarray((3 * rows[:, None] + np.arange(3)).ravel())
