# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Start values for a batch optimisation, without a guess: chordal rotations, then translations.

The heading of node i is written as the complex number u_i = exp(i th_i). An edge asks that
u_j = exp(i th_z) u_i, an observed node that u_i = exp(i (th_z - th_o)): both are linear in u once
|u| = 1 is given up, and a weighted least-squares problem solves them all at once; u is then
scaled back to the circle. With the headings known the translations are linear too. This is the
chordal relaxation of L. Carlone et al., "Initialization techniques for 3D SLAM", ICRA 2015, in the
plane. Its start leads Gauss-Newton to the best known optimum where odometry as a start does
not.

Where headings are not measured, positions tell them: a translation t_j = t_i + u_i t_z is linear
in t and u at once. Solving for both together costs twice the unknowns and needs no heading.
"""

import math

import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.sparse.linalg

from pose_graph_ros.core import complex_system, se2, symbolic, tables as tb
from pose_graph_ros.core.complex_system import Terms
from pose_graph_ros.core.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.factors import wrap
from pose_graph_ros.core.graph import Graph
from pose_graph_ros.core.jit import kernel
from pose_graph_ros.core.se2 import FloatArray

# A heading whose measurements cancel leaves less than this of a unit vector.
SMALLEST_ROTATION = 1e-9

ComplexArray = npt.NDArray[np.complex128]


def chordal(graph: Graph) -> FloatArray:
    """
    Return start poses, shape (N, 3), from the constraints; only fixed nodes keep their pose.

    Raises
    ------
    LinearSolveError
        If headings or positions are not determined, as where only positions are observed; or if
        there are biases.

    """
    head = graph.memory.head
    return chordal_poses(head, symbolic.analyse(head).cliques)


def chordal_poses(head: tb.IntHead, cliques: symbolic.Cliques) -> FloatArray:
    """Do what `chordal` does, where the cliques of the whole graph are known."""
    if _n_biases(head) > 0:
        raise LinearSolveError('chordal start: a bias has no heading')
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


@kernel
def _n_biases(head):  # type: ignore[no-untyped-def]
    node_i, n = tb.node_i(head), 0
    for v in range(head[tb.N_NODES]):
        n += node_i[v, tb.IS_BIAS]
    return n


@kernel(allocates=True)
def _rotation_terms(head):  # type: ignore[no-untyped-def]
    """Return what asks for u_j = exp(i th_z) u_i and u_i = exp(i (th_z - th_o))."""
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
        theta = f[tb.MEAN + 2] - f[tb.OBS_OFFSET + 2]
        of_observed[k, 0] = f[tb.WEIGHT] * f[tb.INFO + 5]
        of_observed[k, 1], of_observed[k, 2] = math.cos(theta), math.sin(theta)
    return Terms(of_edges, of_observed, known)


@kernel(allocates=True)
def _translation_terms(head, u):  # type: ignore[no-untyped-def]
    """Return what asks for t_j = t_i + u_i t_z and t_i = t_z - u_i t_o, as complex numbers."""
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
        x, y = f[tb.OBS_OFFSET], f[tb.OBS_OFFSET + 1]
        of_observed[k, 0] = 0.5 * f[tb.WEIGHT] * (f[tb.INFO] + f[tb.INFO + 3])
        of_observed[k, 1] = f[tb.MEAN] - (u[v, 0] * x - u[v, 1] * y)
        of_observed[k, 2] = f[tb.MEAN + 1] - (u[v, 1] * x + u[v, 0] * y)
    return Terms(of_edges, of_observed, known)


@kernel(allocates=True)
def _poses(head, u, t):  # type: ignore[no-untyped-def]
    """Return the start, shape (N, 3); fixed nodes are where they are."""
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


def joint(graph: Graph) -> FloatArray:
    """
    Return start poses, shape (N, 3), from headings and translations solved for together.

    For graphs that are held by positions: a heading that has drifted by any angle where nothing
    was observed is spread over that part the short way round, which Gauss-Newton from the drifted
    poses does not find. Only fixed nodes keep their pose.

    Biases start at zero; what was measured with one is an observed node, less certain by it.

    Raises
    ------
    LinearSolveError
        If the poses are not determined.

    """
    n, is_bias, fixed = graph.n_nodes, graph.is_bias, graph.fixed
    edges, observed = _of_poses(graph.edges, graph.observed, is_bias)
    edge_rows, observed_rows = np.arange(len(edges)), np.arange(len(observed))
    root_t = np.sqrt(_isotropic(edges.weighted_information))
    root_u = np.sqrt(edges.weighted_information[:, 2, 2])
    seen_t = np.sqrt(_isotropic(observed.weighted_information))
    seen_u = np.sqrt(observed.weighted_information[:, 2, 2])
    # unknowns: all translations, then all rotations; a row for each term of the sum
    terms = (
        (edge_rows, edges.j, root_t),
        (edge_rows, edges.i, -root_t),
        (edge_rows, n + edges.i, -root_t * _complex(edges.mean)),
        (len(edges) + edge_rows, n + edges.j, root_u),
        (len(edges) + edge_rows, n + edges.i, -root_u * np.exp(1j * edges.mean[:, 2])),
        (2 * len(edges) + observed_rows, observed.node, seen_t),
        (2 * len(edges) + observed_rows, n + observed.node, seen_t * _complex(observed.offset)),
        (2 * len(edges) + len(observed) + observed_rows, n + observed.node, seen_u),
    )
    rows, columns, values = (np.concatenate(part) for part in zip(*terms, strict=True))
    matrix = scipy.sparse.coo_array(
        (values, (rows, columns)), shape=(2 * len(edges) + 2 * len(observed), 2 * n),
        dtype=complex).tocsc()
    right = np.concatenate((
        np.zeros(2 * len(edges)), seen_t * _complex(observed.mean),
        seen_u * np.exp(1j * (observed.mean[:, 2] - observed.offset[:, 2]))))
    known = np.concatenate((_complex(graph.poses), np.exp(1j * graph.poses[:, 2])))
    solution = _least_squares(matrix, right, known, np.tile(fixed | is_bias, 2))
    t, u = solution[:n], solution[n:]
    theta = np.where(fixed, graph.poses[:, 2], se2.wrap(np.angle(u)))
    poses = np.column_stack((t.real, t.imag, theta))
    poses[is_bias & ~fixed] = 0.0
    return poses


def _of_poses(
    edges: Edges, observed: ObservedNodes, is_bias: npt.NDArray[np.bool_],
) -> tuple[Edges, ObservedNodes]:
    """Return the constraints of poses alone, as if the noise of biases were white."""
    to_bias = edges.kind == EdgeKind.BIAS
    observed = observed.rows(~is_bias[observed.node])
    measured = edges.rows(to_bias & ~is_bias[edges.i])
    if len(measured) > 0:
        offset, information = np.zeros((len(measured), 3)), np.zeros((len(measured), 3, 3))
        offset[:, :2] = measured.bias[:, :2]
        weighted = measured.weighted_information
        of_t, of_th = _isotropic(weighted), weighted[:, 2, 2]
        of_t = of_t / (1.0 + of_t * measured.bias[:, 2]**2)
        information[:, 0, 0] = information[:, 1, 1] = of_t
        information[:, 2, 2] = of_th / (1.0 + of_th * measured.bias[:, 3]**2)
        observed = ObservedNodes.joined([observed, ObservedNodes(
            measured.i, offset, measured.mean, information,
            [ObservedKind.GLOBAL_POSE] * len(measured))])
    return edges.rows(~to_bias), observed


def _complex(pose: FloatArray) -> ComplexArray:
    return np.asarray(pose[:, 0] + 1j * pose[:, 1])


def _isotropic(information: FloatArray) -> FloatArray:
    return 0.5 * (information[:, 0, 0] + information[:, 1, 1])


def _least_squares(
    matrix: scipy.sparse.csc_array, right: ComplexArray, known: ComplexArray,
    fixed: npt.NDArray[np.bool_],
) -> ComplexArray:
    """Minimise |matrix v - right|^2 with v as known where it is fixed."""
    solution = np.where(fixed, known, 0.0)
    right = right - matrix @ solution
    free = matrix[:, np.flatnonzero(~fixed)]
    adjoint = free.conj().T.tocsc()
    try:
        factorized = scipy.sparse.linalg.splu(
            (adjoint @ free).tocsc(), permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
            options={'SymmetricMode': True})
        solution[~fixed] = factorized.solve(np.asarray(adjoint @ right))
    except RuntimeError as error:
        raise LinearSolveError(f'linear start: not determined ({error})') from error
    if not np.all(np.isfinite(solution)):
        raise LinearSolveError('linear start: not determined to working precision')
    return solution
