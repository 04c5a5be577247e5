# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Initial poses of a batch optimisation from positions: headings and positions solved for together.

With complex headings u as in `chordal_start`, the equation t_j = t_i + u_i t_z of an edge is
linear in t and u together. One linear least-squares problem for both has twice the unknowns, but
does not need a measured heading.

The module loads SciPy, which takes time and memory: import it only where a joint start is needed.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, ComplexArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.kinds import FACTORS
from pose_graph_ros.core.graph.priors import Prior

# The headings of `unit_headings` are pulled to length 1 with these fractions of their information,
# so many times with each.
PULLS = (1e-4, 1e-3, 1e-2)
PULLED = 20
# Fraction with which positions follow from the headings at last.
FIRMLY = 1e6
# Kinds of edges that tell where the other end is, and those that are linear in t and u.
_PLACING = [kind for kind, factor in FACTORS.items() if factor.places]
_LINEAR = [*_PLACING, *(kind for kind, factor in FACTORS.items() if 0 not in factor.rows)]


class _Problem(NamedTuple):
    """The objective |matrix v - right|^2 of v = (t, u): t of all nodes, then u of all nodes."""

    matrix: Any
    right: ComplexArray
    known: ComplexArray
    """v of the nodes that are fixed, any numbers for the others."""
    held: BoolArray
    """Which unknowns are fixed."""


def joint(graph: Graph) -> FloatArray:
    """
    Return initial poses, shape (N, 3), from the constraints and the poses of fixed nodes alone.

    It applies to graphs with observed positions. If the heading has drifted by any angle while
    nothing was observed, the error is distributed over that part of the graph the short way round;
    Gauss-Newton from the drifted poses does not find that solution.

    Biases start at zero. A measurement with a bias is treated as an observed node whose variance
    includes that of the bias, a prior as observed nodes or edges at its references. Raises
    LinearSolveError if the poses are not determined.
    """
    problem = _problem(graph)
    return _poses(graph, _solver(problem)(problem.right))


def unit_headings(graph: Graph) -> FloatArray:
    """
    Return initial poses, shape (N, 3), where the measured headings nearly cancel each other out.

    Far from what holds the graph u of the joint start tends to zero, as the mean of headings that
    contradict each other does, and so do all distances. Here |u| = 1 is approached: u is pulled to
    u / |u| of the last solution, at first weakly. The matrix remains the same for each strength
    of the pull. Poses and errors are those of `joint`.
    """
    problem = _problem(graph)
    n = graph.n_nodes
    v = _solver(problem)(problem.right)
    for pull in (*PULLS, FIRMLY):
        solve, weight = _pulled(problem, n, pull)
        for _ in range(PULLED if pull < FIRMLY else 1):
            length = np.abs(v[n:])
            unit = np.where(length > 0.0, v[n:] / np.where(length > 0.0, length, 1.0), 1.0)
            v = solve(np.concatenate((problem.right, weight * unit)))
    return _poses(graph, v)


def _problem(graph: Graph) -> _Problem:
    n, is_bias, fixed = graph.n_nodes, graph.is_bias, graph.fixed
    is_pose, loose = graph.is_pose, ~graph.is_pose
    edges, observed = _of_poses(graph.edges_by_row, graph.observed_by_row, is_bias)
    loose[edges.j[np.isin(edges.kind, _PLACING)]] = False   # landmarks that are seen
    for prior in graph.priors:
        more = _approximated(prior, graph.node_rows(prior.nodes), is_pose)
        edges, observed = Edges.joined([edges, more[0]]), ObservedNodes.joined([observed, more[1]])
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
    return _Problem(matrix, right, known, np.concatenate((fixed | loose, fixed | ~is_pose)))


def _pulled(
    problem: _Problem, n: int, pull: float,
) -> tuple[Callable[[ComplexArray], ComplexArray], FloatArray]:
    """Return a solver with one more row for each u, w u = w u / |u|, and these weights w."""
    columns = problem.matrix[:, n:]
    weight = np.sqrt(pull * np.asarray(abs(columns).power(2).sum(axis=0)).ravel())
    rows = scipy.sparse.hstack((scipy.sparse.csc_array((n, n)), scipy.sparse.diags_array(weight)))
    return _solver(problem._replace(
        matrix=scipy.sparse.vstack((problem.matrix, rows)).tocsc())), weight


def _poses(graph: Graph, v: ComplexArray) -> FloatArray:
    """Return poses, shape (N, 3), from t and u of all nodes; those of fixed nodes stay."""
    n = graph.n_nodes
    theta = np.where(graph.fixed, graph.poses[:, 2], se2.wrap(np.angle(v[n:])))
    poses = np.column_stack((v[:n].real, v[:n].imag, theta))
    poses[graph.is_bias & ~graph.fixed] = 0.0
    poses[~graph.is_pose & ~graph.fixed, 2] = 0.0
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
    return edges.rows(~to_bias & np.isin(edges.kind, _LINEAR)), observed


def _approximated(
    prior: Prior, rows: IntArray, is_pose: BoolArray,
) -> tuple[Edges, ObservedNodes]:
    """
    Return constraints at the reference poses of a prior, which suffice to start from.

    Parameters
    ----------
    prior : Prior
    rows : ndarray of int, shape (k,), its nodes
    is_pose : ndarray of bool, shape (N,), which nodes are poses

    """
    poses = np.flatnonzero(is_pose[rows])
    blocks = prior.information.reshape(len(rows), 3, -1, 3)[poses, :, poses]
    information = np.zeros_like(blocks)
    information[:, 0, 0] = information[:, 1, 1] = _isotropic(blocks)
    information[:, 2, 2] = blocks[:, 2, 2]
    says = np.any(information, axis=(1, 2))
    poses, information = poses[says], information[says]
    nodes, reference = rows[poses], prior.reference[poses]
    if prior.anchored:
        return Edges(), ObservedNodes(
            nodes, None, reference, information, [ObservedKind.GLOBAL_POSE] * len(nodes))
    first, others = nodes[:1].repeat(len(nodes) - 1), nodes[1:]
    mean = se2.between(reference[:1], reference[1:])
    return Edges(first, others, mean, information[1:],
                 [EdgeKind.ODOMETRY] * len(others)), ObservedNodes()


def _complex(pose: FloatArray) -> ComplexArray:
    return np.asarray(pose[:, 0] + 1j * pose[:, 1])


def _isotropic(information: FloatArray) -> FloatArray:
    """Return the mean information on x and y, shape (M,) [1/m^2]."""
    return 0.5 * (information[:, 0, 0] + information[:, 1, 1])


def _solver(problem: _Problem) -> Callable[[ComplexArray], ComplexArray]:
    """Return a function from right-hand sides to v; it and this raise LinearSolveError."""
    matrix, held = problem.matrix, problem.held
    fixed = np.where(held, problem.known, 0.0)
    free = matrix[:, np.flatnonzero(~held)]
    adjoint = free.conj().T.tocsc()
    try:
        factorized = scipy.sparse.linalg.splu(
            (adjoint @ free).tocsc(), permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
            options={'SymmetricMode': True})
    except RuntimeError as error:
        raise LinearSolveError(f'linear start: not determined ({error})') from error

    def solve(right: ComplexArray) -> ComplexArray:
        solution = fixed.copy()
        solution[~held] = factorized.solve(np.asarray(adjoint @ (right - matrix @ fixed)))
        if not np.all(np.isfinite(solution)):
            raise LinearSolveError('linear start: not determined to working precision')
        return solution

    return solve
