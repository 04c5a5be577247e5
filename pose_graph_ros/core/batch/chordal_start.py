# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Initial poses of a batch optimisation by chordal relaxation: headings first, then positions.

The heading of node i is written as the complex number u_i = exp(i th_i). An edge requires
u_j = exp(i th_z) u_i, an observed node u_i = exp(i (th_z - th_o)). Without the condition |u| = 1
both are linear in u, so all headings are the solution of one weighted linear least-squares
problem, after normalisation of u. Given the headings, the positions are the solution of another.
This is the chordal relaxation of L. Carlone et al., "Initialization techniques for 3D SLAM", ICRA
2015, in the plane. From this start Gauss-Newton reaches the best known optimum of graphs on which
it fails from odometry.

If no heading is measured, `joint_start` gets the headings from the positions.
"""

import math

import numpy as np

from pose_graph_ros.core.batch import complex_system
from pose_graph_ros.core.batch.complex_system import Terms
from pose_graph_ros.core.compiled.jit import kernel, ROWS
from pose_graph_ros.core.elimination import symbolic
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.factors import wrap
from pose_graph_ros.core.graph.graph import Graph

# Smallest |u| before normalisation; below it the measured headings cancel each other out, and what
# remains of u often leads to a minimum that is not the lowest one.
SMALLEST_ROTATION = 1e-6


def chordal(graph: Graph, cliques: symbolic.Cliques) -> FloatArray:
    """
    Return initial poses, shape (N, 3), from the constraints and the poses of fixed nodes alone.

    Raises LinearSolveError if headings or positions are not determined, for example if only
    positions are observed, or if the graph has priors or nodes that are no poses.

    Parameters
    ----------
    graph : Graph
    cliques : Cliques, cliques of the whole graph

    """
    head = graph.memory.head
    if _n_others(head) > 0:
        raise LinearSolveError('chordal start: a bias or a landmark has no heading')
    if head[tb.N_PRIORS] > 0:
        raise LinearSolveError('chordal start: a prior has no term for a heading alone')
    u, bad = complex_system.solve(head, cliques, _rotation_terms(head))
    length = np.hypot(u[:, 0], u[:, 1])
    if bad >= 0:
        raise LinearSolveError(
            f'chordal start: the heading of hidden node {bad} is not determined')
    if np.any(length < SMALLEST_ROTATION):
        raise LinearSolveError('chordal start: the measured headings cancel each other out')
    u /= length[:, None]
    t, bad = complex_system.solve(head, cliques, _translation_terms(head, u))
    if bad >= 0:
        raise LinearSolveError(
            f'chordal start: the position of hidden node {bad} is not determined')
    return np.asarray(_poses(head, u, t))


@kernel(signature=(tb.HEAD,))
def _n_others(head):  # type: ignore[no-untyped-def]
    node_i, n = tb.node_i(head), 0
    for v in range(head[tb.N_NODES]):
        n += node_i[v, tb.NODE_TYPE] != 0
    return n


@kernel(signature=(tb.HEAD,), allocates=True)
def _rotation_terms(head):  # type: ignore[no-untyped-def]
    """Return the terms for u_j = exp(i th_z) u_i and u_i = exp(i (th_z - th_o))."""
    node_f, edge_f, observed_f = tb.node_f(head), tb.edge_f(head), tb.observed_f(head)
    known = np.empty((head[tb.N_NODES], 2))
    for v in range(head[tb.N_NODES]):
        theta = node_f[v, tb.POSE + 2]
        known[v, 0], known[v, 1] = math.cos(theta), math.sin(theta)
    of_edges = np.empty((head[tb.N_EDGES], 5))
    for e in range(head[tb.N_EDGES]):
        f = edge_f[e]
        of_edges[e, 0] = f[tb.WEIGHT] * f[tb.INFO + 5]
        of_edges[e, 1], of_edges[e, 2] = math.cos(f[tb.MEAN + 2]), math.sin(f[tb.MEAN + 2])
        of_edges[e, 3] = of_edges[e, 4] = 0.0
    of_observed = np.empty((head[tb.N_OBSERVED], 3))
    for k in range(head[tb.N_OBSERVED]):
        f = observed_f[k]
        theta = f[tb.MEAN + 2] - f[tb.OFFSET + 2]
        of_observed[k, 0] = f[tb.WEIGHT] * f[tb.INFO + 5]
        of_observed[k, 1], of_observed[k, 2] = math.cos(theta), math.sin(theta)
    return Terms(of_edges, of_observed, known)


@kernel(signature=(tb.HEAD, ROWS), allocates=True)
def _translation_terms(head, u):  # type: ignore[no-untyped-def]
    """Return the terms for t_j = t_i + u_i t_z and t_i = t_z - u_i t_o, as complex numbers."""
    node_f, edge_f, observed_f = tb.node_f(head), tb.edge_f(head), tb.observed_f(head)
    edge_i, observed_i = tb.edge_i(head), tb.observed_i(head)
    known = np.empty((head[tb.N_NODES], 2))
    for v in range(head[tb.N_NODES]):
        known[v, 0], known[v, 1] = node_f[v, tb.POSE], node_f[v, tb.POSE + 1]
    of_edges = np.empty((head[tb.N_EDGES], 5))
    for e in range(head[tb.N_EDGES]):
        f, i = edge_f[e], edge_i[e, tb.END_I]
        of_edges[e, 0] = 0.5 * f[tb.WEIGHT] * (f[tb.INFO] + f[tb.INFO + 3])
        of_edges[e, 1], of_edges[e, 2] = 1.0, 0.0
        of_edges[e, 3] = u[i, 0] * f[tb.MEAN] - u[i, 1] * f[tb.MEAN + 1]
        of_edges[e, 4] = u[i, 1] * f[tb.MEAN] + u[i, 0] * f[tb.MEAN + 1]
    of_observed = np.empty((head[tb.N_OBSERVED], 3))
    for k in range(head[tb.N_OBSERVED]):
        f, v = observed_f[k], observed_i[k, tb.OBS_NODE]
        x, y = f[tb.OFFSET], f[tb.OFFSET + 1]
        of_observed[k, 0] = 0.5 * f[tb.WEIGHT] * (f[tb.INFO] + f[tb.INFO + 3])
        of_observed[k, 1] = f[tb.MEAN] - (u[v, 0] * x - u[v, 1] * y)
        of_observed[k, 2] = f[tb.MEAN + 1] - (u[v, 1] * x + u[v, 0] * y)
    return Terms(of_edges, of_observed, known)


@kernel(signature=(tb.HEAD, ROWS, ROWS), allocates=True)
def _poses(head, u, t):  # type: ignore[no-untyped-def]
    """Return poses, shape (N, 3), from headings u and positions t; those of fixed nodes stay."""
    node_f, node_i = tb.node_f(head), tb.node_i(head)
    poses = np.empty((head[tb.N_NODES], 3))
    for v in range(head[tb.N_NODES]):
        if node_i[v, tb.FIXED] == 0:
            poses[v, 0], poses[v, 1] = t[v, 0], t[v, 1]
            poses[v, 2] = wrap(math.atan2(u[v, 1], u[v, 0]))
        else:
            for k in range(3):
                poses[v, k] = node_f[v, tb.POSE + k]
    return poses
