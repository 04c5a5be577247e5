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

import numpy as np
import numpy.typing as npt
import scipy.sparse
import scipy.sparse.linalg

from pose_graph_ros.core import se2
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.graph import Graph
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
        If headings or positions are not determined, as where only positions are observed.

    """
    edges, observed = graph.edges, graph.observed
    u = _solve(
        graph, np.exp(1j * graph.poses[:, 2]), edges.information[:, 2, 2],
        observed.information[:, 2, 2], factor=np.exp(1j * edges.mean[:, 2]),
        shift=np.zeros(len(edges), dtype=complex),
        target=np.exp(1j * (observed.mean[:, 2] - observed.offset[:, 2])))
    if np.any(np.abs(u) < SMALLEST_ROTATION):
        raise LinearSolveError('chordal start: the measured headings cancel each other out')
    u /= np.abs(u)

    # positions as complex numbers too: t_j = t_i + u_i t_z, t_i = t_z - u_i t_o
    t = _solve(
        graph, _complex(graph.poses), _isotropic(edges.information),
        _isotropic(observed.information), factor=np.ones(len(edges), dtype=complex),
        shift=u[edges.i] * _complex(edges.mean),
        target=_complex(observed.mean) - u[observed.node] * _complex(observed.offset))
    theta = np.where(graph.fixed, graph.poses[:, 2], se2.wrap(np.angle(u)))
    return np.column_stack((t.real, t.imag, theta))


def joint(graph: Graph) -> FloatArray:
    """
    Return start poses, shape (N, 3), from headings and translations solved for together.

    For graphs that are held by positions: a heading that has drifted by any angle where nothing
    was observed is spread over that part the short way round, which Gauss-Newton from the drifted
    poses does not find. Only fixed nodes keep their pose.

    Raises
    ------
    LinearSolveError
        If the poses are not determined.

    """
    edges, observed, n = graph.edges, graph.observed, graph.n_nodes
    edge_rows, observed_rows = np.arange(len(edges)), np.arange(len(observed))
    root_t, root_u = np.sqrt(_isotropic(edges.information)), np.sqrt(edges.information[:, 2, 2])
    seen_t = np.sqrt(_isotropic(observed.information))
    seen_u = np.sqrt(observed.information[:, 2, 2])
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
    solution = _least_squares(matrix, right, known, np.tile(graph.fixed, 2))
    t, u = solution[:n], solution[n:]
    theta = np.where(graph.fixed, graph.poses[:, 2], se2.wrap(np.angle(u)))
    return np.column_stack((t.real, t.imag, theta))


def _complex(pose: FloatArray) -> ComplexArray:
    return np.asarray(pose[:, 0] + 1j * pose[:, 1])


def _isotropic(information: FloatArray) -> FloatArray:
    return 0.5 * (information[:, 0, 0] + information[:, 1, 1])


def _solve(
    graph: Graph, known: ComplexArray, weight: FloatArray, unary_weight: FloatArray, *,
    factor: ComplexArray, shift: ComplexArray, target: ComplexArray,
) -> ComplexArray:
    """
    Minimise sum w |v_j - factor v_i - shift|^2 + sum w |v_node - target|^2.

    The sums run over edges and observed nodes; v is `known` at the fixed nodes.
    """
    edges, node, fixed = graph.edges, graph.observed.node, graph.fixed
    rows = np.arange(len(edges) + len(node))
    edge_rows = rows[:len(edges)]
    root, unary_root = np.sqrt(weight), np.sqrt(unary_weight)
    matrix = scipy.sparse.coo_array((
        np.concatenate((root, -root * factor, unary_root)),
        (np.concatenate((edge_rows, edge_rows, rows[len(edges):])),
         np.concatenate((edges.j, edges.i, node)))),
        shape=(len(rows), graph.n_nodes), dtype=complex).tocsc()
    right = np.concatenate((root * shift, unary_root * target))
    return _least_squares(matrix, right, known, fixed)


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
