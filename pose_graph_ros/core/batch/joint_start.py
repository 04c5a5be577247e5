# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Initial poses of a batch optimisation from positions: headings and positions solved for together.

With complex headings u as in `chordal_start`, the equation t_j = t_i + u_i t_z of an edge is
linear in t and u together. One linear least-squares problem for both has twice the unknowns, but
does not need a measured heading.

The module loads SciPy, which takes time and memory: import it only where a joint start is needed.
"""

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, ComplexArray, FloatArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph


def joint(graph: Graph) -> FloatArray:
    """
    Return initial poses, shape (N, 3), from the constraints and the poses of fixed nodes alone.

    It applies to graphs with observed positions. If the heading has drifted by any angle while
    nothing was observed, the error is distributed over that part of the graph the short way round;
    Gauss-Newton from the drifted poses does not find that solution.

    Biases start at zero. A measurement with a bias is treated as an observed node whose variance
    includes that of the bias. Raises LinearSolveError if the poses are not determined.
    """
    n, is_bias, fixed = graph.n_nodes, graph.is_bias, graph.fixed
    edges, observed = _of_poses(graph.edges, graph.observed, is_bias)
    edge_rows, observed_rows = np.arange(len(edges)), np.arange(len(observed))
    root_t = np.sqrt(_isotropic(edges.weighted_information))
    root_u = np.sqrt(edges.weighted_information[:, 2, 2])
    seen_t = np.sqrt(_isotropic(observed.weighted_information))
    seen_u = np.sqrt(observed.weighted_information[:, 2, 2])
    # unknowns: t of all nodes, then u of all nodes; one row for each term of the objective
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
    edges: Edges, observed: ObservedNodes, is_bias: BoolArray,
) -> tuple[Edges, ObservedNodes]:
    """Return the constraints without biases, their variance added to that of the measurements."""
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
    """Return the mean information on x and y, shape (M,) [1/m^2]."""
    return 0.5 * (information[:, 0, 0] + information[:, 1, 1])


def _least_squares(
    matrix: scipy.sparse.csc_array, right: ComplexArray, known: ComplexArray,
    fixed: BoolArray,
) -> ComplexArray:
    """Return v that minimises |matrix v - right|^2, equal to `known` where it is fixed."""
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
