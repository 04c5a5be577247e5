# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What poses that leave a graph say about their neighbours, all of which are poses.

With the system `H delta = b` of all constraints of the leaving nodes m, at the present poses, that
is the Schur complement on the others k:

    U = H_kk - H_km H_mm^-1 H_mk,    u = b_k - H_km H_mm^-1 b_m

Edges measure `h_j - T h_i` in map axes, as in `sparsification`; observed nodes `h_i`, with a third
column for the arm of their offset.
"""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedNodes
from pose_graph_ros.core.graph.error_functions import edge_errors, observed_errors
from pose_graph_ros.core.graph.graph import Graph

# Kinds of edges between two poses with the error (3.48).
POSE_EDGES = (EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE, EdgeKind.PRIOR)


class PoseMarginal(NamedTuple):
    """A Gaussian of poses: its minimum is at `information @ delta = vector`."""

    nodes: IntArray
    """Ids, ascending, shape (k,)."""
    poses: FloatArray
    """From which delta counts, shape (k, 3) [m, m, rad]."""
    information: FloatArray
    """Shape (3 k, 3 k)."""
    vector: FloatArray
    """Shape (3 k,)."""
    anchored: bool
    """Whether it tells where the poses are in the map."""


def pose_marginal(
    graph: Graph, leaving: IntArray, edges: BoolArray, observed: BoolArray,
) -> PoseMarginal:
    """
    Return what constraints say about those of their nodes that do not leave.

    Parameters
    ----------
    graph : Graph
    leaving : ndarray of int, ids
    edges : ndarray of bool, shape (M,), which edges by row, of the kinds `POSE_EDGES`
    observed : ndarray of bool, shape (K,), which observed nodes by row

    """
    some, seen = graph.edges.rows(edges), graph.observed.rows(observed)
    ids = np.unique(np.concatenate((leaving, some.i, some.j, seen.node)))
    poses = graph.poses_of(ids)
    H, b = _system(
        poses, some.renumbered(lambda nodes: np.searchsorted(ids, nodes)),
        seen.renumbered(lambda nodes: np.searchsorted(ids, nodes)))
    fixed = graph.fixed[graph.node_rows(ids)]
    gone = np.isin(ids, leaving)
    m, k = (np.repeat(part, 3) for part in (gone, ~gone))
    gain = np.linalg.solve(H[np.ix_(m, m)], H[np.ix_(m, k)]).T
    information = H[np.ix_(k, k)] - gain @ H[np.ix_(m, k)]
    return PoseMarginal(
        ids[~gone], poses[~gone], 0.5 * (information + information.T), b[k] - gain @ b[m],
        len(seen) > 0 or bool(np.any(fixed & gone)))


def _system(
    poses: FloatArray, edges: Edges, observed: ObservedNodes,
) -> tuple[FloatArray, FloatArray]:
    """Return H and b of constraints whose nodes are rows of the poses."""
    size = 3 * len(poses)
    H, b = np.zeros((size, size)), np.zeros(size)
    errors = edge_errors(poses, edges)
    turns = poses[edges.i, 2] + edges.mean[:, 2]
    to_map = _axes(turns)
    W = to_map @ edges.weighted_information @ np.swapaxes(to_map, 1, 2)
    errors = np.einsum('mij,mj->mi', to_map, errors)
    for n, (i, j) in enumerate(zip(edges.i.tolist(), edges.j.tolist(), strict=True)):
        J = np.hstack((-np.eye(3), np.eye(3)))
        J[:2, 2] = poses[j, 1] - poses[i, 1], poses[i, 0] - poses[j, 0]
        _add(H, b, [i, j], J, W[n], errors[n])
    to_map = _axes(observed.mean[:, 2])
    W = to_map @ observed.weighted_information @ np.swapaxes(to_map, 1, 2)
    errors = np.einsum('mij,mj->mi', to_map, observed_errors(poses, observed))
    for n, i in enumerate(observed.node.tolist()):
        J, (x, y) = np.eye(3), se2.rotation(poses[i, 2]) @ observed.offset[n, :2]
        J[:2, 2] = -y, x
        _add(H, b, [i], J, W[n], errors[n])
    return H, b


def _add(
    H: FloatArray, b: FloatArray, nodes: list[int], J: FloatArray, W: FloatArray,
    error: FloatArray,
) -> None:
    """Add one constraint with the Jacobian J of its nodes, in map axes."""
    at = np.concatenate([np.arange(3 * node, 3 * node + 3) for node in nodes])
    H[np.ix_(at, at)] += J.T @ W @ J
    b[at] -= J.T @ W @ error


def _axes(theta: FloatArray) -> FloatArray:
    """Return rotations of poses, shape (M, 3, 3)."""
    axes = np.zeros((len(theta), 3, 3))
    axes[:, :2, :2], axes[:, 2, 2] = se2.rotation(theta), 1.0
    return axes
