# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Marginalisation: nodes leave a graph, and what their constraints say about the others remains.

With m the leaving nodes, s their neighbours, and the system `H delta = b` of all constraints and
priors that have a leaving node, linearized at the present poses, the marginal is

    U = H_ss - H_sm H_mm^+ H_ms,    u = b_s - H_sm H_mm^+ b_m,    c = chi2 - b_m^T H_mm^+ b_m

The pseudo-inverse minimises over what is not determined, as the heading of a node of which only
the position was observed: that says nothing about any neighbour. A fixed leaving node keeps its
pose, so it has no column in H_mm. `docs/solver.md` tells what is exact and what is not.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.compiled.jit import kernel, ROWS
from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import normal_equations, tables as tb
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphRows, GraphUpdate
from pose_graph_ros.core.graph.priors import model, Prior
from pose_graph_ros.core.marginalization.sparsification import edges_between, sparsify, turned
from pose_graph_ros.core.sparse import components

# Kinds of edges that turn with their poses, but for a third node that remains.
_RELATIVE = (FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE, FactorKind.PRIOR)
# Those to landmarks turn with poses and landmarks; a prior does with poses alone.
_TO_LANDMARKS = (FactorKind.POINT, FactorKind.RANGE)


class Cut(NamedTuple):
    """An edge that is left out, and what is taken off its leaving end for that."""

    edge: int
    node: int   # the end that leaves
    information: FloatArray     # (3, 3) in map axes; less than what else is known of the node
    vector: FloatArray  # (3,)


def marginalize(graph: Graph, nodes: Collection[int]) -> GraphUpdate:
    """
    Return the update with which nodes leave a graph; their information remains.

    It is linear at the present poses of the nodes and their neighbours. Each connected part of the
    leaving nodes makes one new constraint on its neighbours: an edge between two poses if nothing
    in it knows where they are in the map, an observed node on a single pose, else a `Prior`.
    Constraints with weight 0 just leave. The graph does not change. Raises GraphUpdateError for a
    node that is not in the graph.
    """
    factors, priors = [], []
    leaving = _checked(graph, nodes)
    used = graph.factors.rows(graph.factors.weight > 0.0)
    ends = np.stack((used.i, used.j, used.k))
    pairs = [ends[[0, 1]], ends[[0, 2]], ends[[1, 2]]]
    for known in graph.priors:
        inside = known.nodes[np.isin(known.nodes, leaving)]
        pairs.append(np.stack((inside[:-1], inside[1:])))
    joined = np.hstack(pairs)
    i, j = np.searchsorted(leaving, joined[:, np.all(np.isin(joined, leaving), axis=0)])
    part = components(i, j, len(leaving))
    for first in np.unique(part):   # of the connected parts of the leaving nodes
        prior = marginal(graph, leaving[part == first])
        if prior is None:
            continue
        is_pose = bool(np.all(graph.is_pose[graph.node_rows(prior.nodes)]))
        if len(prior.nodes) == 2 and not prior.anchored and is_pose:
            factors.append(as_edge(prior))
        # a heading that is next to unknown may have its minimum turns away, which a mean has not
        elif len(prior.nodes) == 1 and is_pose and abs(
                (_pseudo_inverse(prior.information) @ prior.vector)[2]) < np.pi:
            factors.append(as_observed(prior))
        else:
            priors.append(prior)
    return GraphUpdate(
        factors=Factors.joined([each for each in factors if np.any(each.information)]),
        remove_nodes=leaving.tolist(), priors=tuple(priors))


def marginal(graph: Graph, nodes: Collection[int], factors: Collection[int] = (),
             cuts: Sequence[Cut] = ()) -> Prior | None:
    """
    Return what all constraints of leaving nodes, and further ones, say about the other nodes.

    It is a prior at their present poses; None if they say nothing. The nodes of the further ones
    remain unless they leave. Raises as `marginalize` does.
    """
    leaving, table = _checked(graph, nodes), graph.factors
    # the part of the graph with the factors of leaving nodes and further ones
    asked = np.union1d(graph.factors_on(leaving), np.array(list(factors), dtype=np.int64))
    chosen = np.isin(graph.factor_ids, np.setdiff1d(asked, [cut.edge for cut in cuts]))
    chosen &= table.weight > 0.0
    priors = [prior for prior in graph.priors if np.any(np.isin(prior.nodes, leaving))]
    ends = np.concatenate((table.i[chosen], table.j[chosen], table.k[chosen]))
    part = part_of(graph, np.unique(np.concatenate((
        leaving, ends[ends >= 0], *(each.nodes for each in priors)))), chosen, priors)
    inside, fixed, poses = np.isin(part.node_ids, leaving), part.fixed, part.poses
    H, b = equations(part)
    energy = part.energies().chi2
    for cut in cuts:
        of_cut = columns_of(part.node_rows(np.array([cut.node])))
        H[np.ix_(of_cut, of_cut)] -= cut.information
        b[of_cut] -= cut.vector
    for row in np.flatnonzero(inside & fixed):  # it is known to lie where it is
        at = slice(3 * row, 3 * row + 3)
        H[at], H[:, at], b[at] = 0.0, 0.0, 0.0
    scale = np.diagonal(H).copy()
    energy -= eliminate(H, b, np.flatnonzero(inside & ~fixed), scale)
    kept = np.flatnonzero(~inside)
    columns = columns_of(kept)
    U, u = H[np.ix_(columns, columns)], b[columns]
    tiny = np.diagonal(U) <= 1e-14 * scale[columns]     # what rounding leaves of zero
    U[tiny], U[:, tiny], u[tiny] = 0.0, 0.0, 0.0
    # the nodes about which it says anything
    kept = kept[np.any(np.any(U != 0.0, axis=1).reshape(-1, 3), axis=1)]
    if len(kept) == 0:
        return None
    says, table = np.flatnonzero(np.isin(columns // 3, kept)), part.factors
    only_poses = bool(np.all(part.is_pose[kept]))
    relative = [*_RELATIVE, *(_TO_LANDMARKS if only_poses else ())]
    # whether a constraint knows where its nodes are in the map, of which some remain
    anchored = (
        bool(np.any(inside & fixed)) or any(prior.anchored for prior in part.priors)
        or not np.all(np.isin(table.kind, relative) & (only_poses | (table.k < 0))))
    return Prior(part.node_ids[kept].astype(np.int64), poses[kept].copy(),
                 _symmetric(U[np.ix_(says, says)]), u[says], energy, anchored)


def schur_complement(H: FloatArray, b: FloatArray,
                     rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return a semidefinite system without some nodes, which take their best values."""
    H, b = H.copy(), b.copy()
    eliminate(H, b, rows, np.diagonal(H).copy())
    columns = columns_of(np.delete(np.arange(len(b) // 3), rows))
    return _symmetric(H[np.ix_(columns, columns)]), b[columns]


def standing_for(rows: GraphRows) -> Factors:
    """
    Return edges and observed nodes that tell no more of the poses than the priors of a graph.

    They have the minimum of the priors, linear at the present poses, and their ends are ids.
    Biases and landmarks in priors are marginalised out.
    """
    factors = []
    for prior in rows.priors:
        at = rows.rows_of(prior.nodes)
        is_pose = rows.is_pose[at]
        linear = model(prior, rows.poses[at], is_pose)
        if not np.any(is_pose):
            continue
        U, u = schur_complement(linear.information, -linear.gradient, np.flatnonzero(~is_pose))
        if not np.any(np.diagonal(U) > 1e-12):
            continue    # it tells of biases alone, but for rounding
        factors.append(sparsify(Prior(
            prior.nodes[is_pose], rows.poses[at[is_pose]], U, u, 0.0, prior.anchored)).factors)
    return Factors.joined(factors)


def as_edge(prior: Prior) -> Factors:
    """Return an edge between the two poses of a relative prior, with its gradient and Hessian."""
    first, second = np.argsort(prior.nodes)
    at = slice(3 * second, 3 * second + 3)
    information = _semidefinite(prior.information[at, at])
    delta = np.zeros((2, 3))
    delta[second] = _pseudo_inverse(information) @ prior.vector[at]
    return edges_between(prior.nodes, (prior.reference, delta), np.array([first]),
                         np.array([second]), information[None])


def as_observed(prior: Prior) -> Factors:
    """Return an observed node on the single pose of a prior, with its gradient and Hessian."""
    information = _semidefinite(prior.information)
    mean = prior.reference[0] + _pseudo_inverse(information) @ prior.vector
    # without information on the heading the error is in map axes, as that of a position
    mean[2] = se2.wrap(mean[2]) if np.any(information[2]) else 0.0
    return Factors.on(prior.nodes, mean=mean[None], kind=[FactorKind.NODE_PRIOR],
                      information=turned(information[None], mean[2:]))


def _checked(graph: Graph, nodes: Collection[int]) -> IntArray:
    """Return ids of nodes, ascending; raise GraphUpdateError if one is not in the graph."""
    ids = np.unique(np.fromiter(nodes, np.int64, len(nodes)))
    gone = ids[graph.node_rows(ids) < 0]
    if len(gone) > 0:
        raise GraphUpdateError(f'marginalize: hidden node {gone[0]} is not in the graph')
    return ids


def part_of(graph: Graph, ids: IntArray, factors: IntArray | BoolArray,
            priors: Sequence[Prior] = ()) -> Graph:
    """Return a graph of some nodes, by ids, and of some factors on them alone, by rows."""
    rows, part = graph.node_rows(ids), Graph()
    part.fill(GraphRows(
        graph.poses[rows], graph.node_kind[rows], graph.fixed[rows], graph.factors.rows(factors),
        ids, graph.factor_ids[factors], graph.next_ids, graph.dimension[rows], tuple(priors)))
    return part


def equations(graph: Graph) -> tuple[FloatArray, FloatArray]:
    """Return H and b of all constraints and priors of a graph, for changes of its poses."""
    n = 3 * graph.n_nodes
    front = np.zeros((n, n + 1))
    assemble(graph.memory.head, front)
    H, b = np.triu(front[:, :n]), front[:, n].copy()
    H = H + np.triu(H, 1).T
    for prior in graph.priors:
        rows = graph.node_rows(prior.nodes)
        at = columns_of(rows)
        linear = model(prior, graph.poses[rows], graph.is_pose[rows])
        H[np.ix_(at, at)] += linear.information
        b[at] -= linear.gradient
    return H, b


@kernel(signature=(tb.HEAD, ROWS))
def assemble(head, front):  # type: ignore[no-untyped-def]
    """Add all factors to H, of which (3N, 3N + 1) has the upper triangle, and last to b."""
    flat, ld = front.reshape(front.size), front.shape[1]
    for e in range(head[tb.N_FACTORS]):
        f = tb.factors(head)[e]
        if f.weight > 0.0:
            # a missing end has no block: -1
            at = 3 * f.ends[0], max(3 * f.ends[1], -1), max(3 * f.ends[2], -1)
            normal_equations.add(head, e, at, flat, ld)


def eliminate(H: FloatArray, b: FloatArray, nodes: IntArray, scale: FloatArray) -> float:
    """
    Return b_m^T H_mm^+ b_m after eliminating nodes in place, those with few neighbours first.

    The scale, shape (3N,), is what the constraints have added to the diagonal.
    """
    left, decrease = set(nodes.tolist()), 0.0
    linked = np.any(H.reshape(len(H) // 3, 3, len(H) // 3, 3) != 0.0, axis=(1, 3))
    while left:
        v = min(left, key=lambda node: (int(np.count_nonzero(linked[node])), node))
        left.remove(v)
        near = np.flatnonzero(linked[v])
        near = near[near != v]
        at, columns = slice(3 * v, 3 * v + 3), columns_of(near)
        inverse = _pseudo_inverse(H[at, at], scale[at])
        gain = H[columns, at] @ inverse
        decrease += float(b[at] @ inverse @ b[at])
        H[np.ix_(columns, columns)] -= gain @ H[at, columns]
        b[columns] -= gain @ b[at]
        linked[np.ix_(near, near)] = True
        linked[v] = linked[:, v] = False
    return decrease


def _pseudo_inverse(matrix: FloatArray, scale: FloatArray | None = None) -> FloatArray:
    """Return that of a semidefinite matrix; `scale` is its diagonal before cancellation."""
    diagonal = np.diagonal(matrix) if scale is None else scale
    root = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(_symmetric(matrix / np.outer(root, root)))
    good = values > 1e-13   # smaller ones are what rounding leaves of zero
    half = vectors[:, good] / np.sqrt(values[good]) / root[:, None]
    return np.asarray(half @ half.T)


def _semidefinite(matrix: FloatArray) -> FloatArray:
    """Return a matrix whose eigenvalues are below 0 by rounding alone, with 0 for these."""
    root = np.sqrt(np.maximum(np.diagonal(matrix), 0.0))
    root[root == 0.0] = np.inf
    values, vectors = np.linalg.eigh(_symmetric(matrix / np.outer(root, root)))
    if values[0] >= 0.0:
        return matrix
    root[np.isinf(root)] = 0.0
    half = vectors * np.sqrt(np.maximum(values, 0.0)) * root[:, None]
    return np.asarray(half @ half.T)


def columns_of(rows: IntArray) -> IntArray:
    """Return the columns of nodes."""
    return np.asarray((3 * rows[:, None] + np.arange(3)).ravel())


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)
