# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Initial poses of a batch optimisation by linear least squares, without a guess.

With headings as complex numbers u = exp(i th) and positions as t = x + i y, an edge requires
u_j = r u_i and t_j + u_j b = t_i + u_i a, with r = exp(i th_z), a the measured position and b the
offset at its end. An observed node is an edge from the map, where u = 1 and t = 0. Without the
condition |u| = 1 both equations are linear.

- `chordal` solves for all headings, normalises them, and solves for all positions: the chordal
  relaxation of L. Carlone et al., "Initialization techniques for 3D SLAM", ICRA 2015, in the
  plane. Over the cliques, headings are improved together with the positions, by the Jacobians of
  ends that are where they were measured: L. Carlone et al., "A fast and accurate approximation for
  planar pose graph optimization", IJRR 2014. From this start Gauss-Newton reaches the best known
  optimum of graphs on which it fails from odometry.
- `joint` solves for both together, which needs no measured heading.

Nothing in here is compiled. `gauss_newton.solve_chordal` solves the systems of `chordal` over
the cliques of a graph.
"""

from collections.abc import Callable, Iterator, Sequence
import math
from typing import Any, NamedTuple, Protocol, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, ComplexArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.constraints import FactorKind, FACTORS, Factors, NodeKind
from pose_graph_ros.core.sparse import BlockFactors, BlockPattern, order_of

if TYPE_CHECKING:
    from pose_graph_ros.core.graph.graph import Graph

Blocks = npt.NDArray[Any]   # real or complex, shape (M, r, b)
Ends = Sequence[Blocks]   # one for each end of a constraint
ChordalSolve = Callable[[Poses, bool], Poses]
"""
Returns poses with the best positions for the headings of given ones, if it is to place them.

Otherwise it returns the best u of all nodes in place of positions. Fixed nodes stay.
"""

# Kinds of edges that tell where the other end is, and those that are linear in t and u.
_PLACING = [kind for kind, factor in FACTORS.items() if factor.places]
_LINEAR = [*_PLACING, *(kind for kind, factor in FACTORS.items() if 0 not in factor.rows)]


class Constrained(Protocol):
    """What is needed of a graph, a `Graph` or a `PlainGraph`."""

    @property
    def node_kind(self) -> npt.NDArray[Any]: ...
    @property
    def n_priors(self) -> int: ...
    @property
    def poses(self) -> Poses: ...
    @property
    def fixed(self) -> BoolArray: ...
    @property
    def factors_by_row(self) -> Factors: ...  # with rows for ends


class Terms(NamedTuple):
    """The two equations of each constraint; end n is the map of a graph of n nodes."""

    i: IntArray
    j: IntArray
    turn: ComplexArray  # r
    arm_i: ComplexArray  # a [m]
    arm_j: ComplexArray  # b [m]
    tau: FloatArray  # mean information on x and y
    kappa: FloatArray  # information on the heading

    @classmethod
    def of(cls, i: IntArray, j: IntArray, mean: FloatArray, offset: FloatArray | float,
           information: FloatArray) -> 'Terms':
        """Return the terms for measured poses of points of j in i or in the map."""
        offset = np.broadcast_to(offset, mean.shape)
        return cls(i, j, np.exp(1j * (mean[:, 2] - offset[:, 2])), complex_of(mean),
                   complex_of(offset), 0.5 * (information[:, 0, 0] + information[:, 1, 1]),
                   information[:, 2, 2])

    def informative(self) -> 'Terms':
        """Return the terms without those that say nothing."""
        says = (self.tau != 0.0) | (self.kappa != 0.0)
        return Terms(*(column[says] for column in self))

    @classmethod
    def of_factors(cls, factors: Factors, n: int) -> 'Terms':
        """Return the terms of edges and of observed nodes, with rows for their ends."""
        observed = factors.j < 0
        return cls.of(
            np.where(observed, n, factors.i), np.where(observed, factors.i, factors.j),
            factors.mean, np.where(observed[:, None], factors.offset, 0.0),
            factors.weighted_information)


class NodeSystem:
    """
    Normal equations of constraints between two nodes, with a block for each node that is free.

    `i` and `j` are the ends, n is the map; `free` has the shape (n,). `places` are those of the
    free nodes in an order of elimination with little fill; without them one is found.
    """

    def __init__(self, i: IntArray, j: IntArray, free: BoolArray,
                 places: IntArray | None = None) -> None:
        self.free = np.flatnonzero(free)
        self._ends, self._n = (i, j), len(free) + 1
        number = np.full(self._n, -1)
        number[self.free] = nodes = np.arange(len(self.free))
        i, j = number[i], number[j]
        pairs = (i, i), (i, j), (j, i), (j, j)
        self._kept = [(row >= 0) & (column >= 0) for row, column in pairs]
        both = self._kept[1]
        self.places = order_of(i[both], j[both], len(nodes)) if places is None else places
        """Place of each free node in the order of elimination."""
        rows, columns = (np.concatenate([*(
            pair[side][kept] for pair, kept in zip(pairs, self._kept, strict=True)), nodes])
            for side in (0, 1))
        self._pattern = BlockPattern(rows, columns, self.places)

    def factors(self, by: Ends, weighted: Ends, own: Blocks | None = None) -> BlockFactors:
        """
        Return the factors of the sum of by^H weighted, and of blocks of the free nodes.

        What the residuals are weighted with has to be Hermitian.
        """
        def blocks() -> Iterator[Blocks]:
            (i, j), both = by, self._kept[1]
            across = i[both].conj().swapaxes(1, 2) @ weighted[1][both]
            yield i[self._kept[0]].conj().swapaxes(1, 2) @ weighted[0][self._kept[0]]
            yield from (across, across.conj().swapaxes(1, 2))
            yield j[self._kept[3]].conj().swapaxes(1, 2) @ weighted[1][self._kept[3]]
            size = by[0].shape[2]
            yield np.zeros((len(self.free), size, size)) if own is None else own
        return self._pattern.factors(blocks())

    def gathered(self, by: Ends, weighted: Blocks) -> Blocks:
        """
        Return the sums of by^H times weighted residuals at the free nodes, shape (F, b).

        The residuals have the shape (M, r); with C columns, (M, r, C), the sums are (F, b, C).
        """
        total: Blocks = np.zeros(())
        for end, each in zip(self._ends, by, strict=True):
            values = np.ascontiguousarray(np.einsum('mrk,mr...->mk...', each.conj(), weighted))
            # bincount takes one column of real numbers
            columns = values.reshape(len(values), math.prod(values.shape[1:])).view(np.float64).T
            total = total + np.stack([np.bincount(end, column, self._n) for column in columns],
                                     axis=1).view(values.dtype).reshape(-1, *values.shape[1:])
        return np.asarray(total[self.free])

    def solver(self, by: Ends, right: ComplexArray, known: ComplexArray,
               own: Blocks | None = None) -> Callable[..., ComplexArray]:
        """
        Return what finds v at the minimum of the sum of |by_i v_i + by_j v_j - right|^2.

        `known` (n + 1, b) is v of the nodes that are not free, `own` (F, b, b) is added to the
        matrix. The function takes what is added to its right-hand side, (F, b).
        """
        fixed = known.copy()
        fixed[self.free] = 0.0
        rest = right - sum(np.einsum('mrk,mk->mr', each, fixed[end])
                           for end, each in zip(self._ends, by, strict=True))
        gathered, factors = self.gathered(by, rest), self.factors(by, by, own)

        def solve(more: ComplexArray | float = 0.0) -> ComplexArray:
            flat = (gathered + more).reshape(-1, 1)
            # of a real matrix a complex column is two real ones
            solved = np.ascontiguousarray(factors.solve(
                flat if np.iscomplexobj(by[0]) else flat.view(np.float64)))
            v = fixed.copy()
            v[self.free] = solved.view(np.complex128).reshape(-1, v.shape[1])
            if not np.all(np.isfinite(v)):
                raise LinearSolveError('linear start: not determined to working precision')
            return v
        return solve


def sparse_chordal(graph: Constrained, nodes: NodeSystem | None = None) -> ChordalSolve:
    """Return the `ChordalSolve` that is not compiled; `nodes` is that of the edges."""
    terms = Terms.of_factors(graph.factors_by_row, len(graph.poses)).informative()
    system = nodes or NodeSystem(terms.i, terms.j, ~graph.fixed)

    def solve(poses: Poses, place: bool) -> Poses:
        t, u = _known(poses)
        if place:
            root = np.sqrt(terms.tau)[:, None, None]
            by = -root, root
            right = root[:, 0, 0] * (u[terms.i] * terms.arm_i - u[terms.j] * terms.arm_j)
        else:
            root = np.sqrt(terms.kappa)[:, None, None]
            by, t = (-root * terms.turn[:, None, None], root + 0j), u
            right = np.zeros(len(root), complex)
        t = system.solver(by, right[:, None], t[:, None])()[:-1, 0]
        return np.stack((t.real, t.imag, poses[:, 2]), axis=1)
    return solve


def chordal(graph: Constrained, solve: ChordalSolve | None = None, least: float = 1e-6) -> Poses:
    """
    Return initial poses from the constraints and the poses of fixed nodes: headings come first.

    Raises LinearSolveError if headings or positions are not determined, for example if only
    positions are observed, or if the graph has priors or nodes that are no poses.
    """
    if np.any(graph.node_kind != NodeKind.POSE):
        raise LinearSolveError('chordal start: a bias or a landmark has no heading')
    if graph.n_priors > 0:
        raise LinearSolveError('chordal start: a prior has no term for a heading alone')
    solve = solve or sparse_chordal(graph)
    poses = solve(graph.poses.copy(), False)
    # what remains of u where measured headings cancel often leads to another minimum
    if np.any(np.hypot(poses[:, 0], poses[:, 1]) < least):
        raise LinearSolveError('chordal start: the measured headings cancel each other out')
    poses[:, 2] = np.arctan2(poses[:, 1], poses[:, 0])
    poses[:, :2] = 0.0
    poses[graph.fixed] = graph.poses[graph.fixed]
    return se2.wrapped(solve(poses, True))


def joint(graph: 'Graph', *, unit: bool = False) -> Poses:
    """
    Return initial poses from the constraints and the poses of fixed nodes: all at once.

    It applies to graphs with observed positions. If the heading has drifted by any angle while
    nothing was observed, the error is distributed over that part of the graph the short way round;
    Gauss-Newton from the drifted poses does not find that solution.

    Far from what holds the graph u tends to zero, as the mean of headings that contradict each
    other does, and so do all distances. With `unit`, |u| = 1 is approached: u is pulled to u / |u|
    of the last solution, at first weakly.

    Biases start at zero. A measurement with a bias is treated as an observed node whose variance
    includes that of the bias, a prior as observed nodes or edges at its references. Raises
    LinearSolveError if the poses are not determined.
    """
    terms, is_pose = _joint_terms(graph).informative(), graph.is_pose
    factors = graph.factors_by_row
    seen = factors.j[np.isin(factors.kind, _PLACING)]
    free = is_pose | np.isin(np.arange(len(is_pose)), seen)   # landmarks that are seen
    system = NodeSystem(terms.i, terms.j, free & ~graph.fixed)
    root_t, root_u = np.sqrt((terms.tau, terms.kappa))
    by_i, by_j = np.zeros((2, len(root_t), 2, 2), complex)
    by_i[:, 0, 0], by_i[:, 0, 1] = -root_t, -root_t * terms.arm_i
    by_j[:, 0, 0], by_j[:, 0, 1] = root_t, root_t * terms.arm_j
    by_i[:, 1, 1], by_j[:, 1, 1] = -root_u * terms.turn, root_u
    right = np.zeros((len(root_t), 2), complex)
    known = np.stack(_known(graph.poses), axis=1)
    turns = is_pose[system.free]
    own, towards = np.zeros((len(turns), 2, 2)), np.zeros((len(turns), 2), complex)
    own[~turns, 1, 1] = 1.0   # holds the headings that landmarks do not have
    v = system.solver((by_i, by_j), right, known, own)()
    if unit:
        total = sum(np.bincount(end, np.sum(np.abs(by[:, :, 1])**2, axis=1), len(known))
                    for end, by in ((terms.i, by_i), (terms.j, by_j)))
        strength = np.where(turns, np.asarray(total)[system.free], 0.0)
        # fractions of the information, each so many times; at last positions follow
        for pull, times in ((1e-4, 20), (1e-3, 20), (1e-2, 20), (1e6, 1)):
            own[:, 1, 1] = np.where(turns, pull * strength, 1.0)
            solve = system.solver((by_i, by_j), right, known, own)
            for _ in range(times):
                u = v[system.free, 1]
                length = np.abs(u)
                towards[:, 1] = pull * strength * np.where(
                    length > 0.0, u / np.where(length > 0.0, length, 1.0), 1.0)
                v = solve(towards)
    poses = _poses(graph, v[:-1, 0], v[:-1, 1])
    poses[graph.is_bias & ~graph.fixed] = 0.0
    poses[~is_pose & ~graph.fixed, 2] = 0.0
    return poses


def _known(poses: Poses) -> tuple[ComplexArray, ComplexArray]:
    """Return t and u of poses, and behind them of the map, shape (n + 1,)."""
    return np.append(complex_of(poses), 0.0), np.append(np.exp(1j * poses[:, 2]), 1.0)


def _poses(graph: Constrained, t: ComplexArray, u: ComplexArray) -> Poses:
    """Return poses from t and u of all nodes; those of fixed nodes stay."""
    poses = np.stack((t.real, t.imag, se2.wrap(np.angle(u))), axis=1)
    return np.where(graph.fixed[:, None], graph.poses, poses)


def complex_of(poses: FloatArray) -> ComplexArray:
    """Return the positions of poses as complex numbers."""
    return np.asarray(poses[:, 0] + 1j * poses[:, 1])


def _joint_terms(graph: 'Graph') -> Terms:
    """Return the terms of all constraints, without biases, and of the priors."""
    n, is_bias = graph.n_nodes, graph.is_bias
    factors = graph.factors_by_row
    biased = factors.rows((factors.kind == FactorKind.BIAS) & ~is_bias[factors.i])
    of_biased = Terms.of(
        np.full(len(biased), n), biased.i, biased.mean,
        biased.constants[:, :2] @ np.eye(2, 3), biased.weighted_information)
    linear = np.isin(factors.kind, _LINEAR) | ((factors.j < 0) & ~is_bias[factors.i])
    terms = [Terms.of_factors(factors.rows(linear), n), of_biased._replace(
        tau=of_biased.tau / (1.0 + of_biased.tau * biased.constants[:, 2]**2),
        kappa=of_biased.kappa / (1.0 + of_biased.kappa * biased.constants[:, 3]**2))]
    for prior in graph.priors:  # at its reference poses, which suffice to start from
        rows = graph.node_rows(prior.nodes)
        blocks = np.einsum('iaib->iab', prior.information.reshape(len(rows), 3, -1, 3))
        says = np.trace(blocks, axis1=1, axis2=2) > 0.0
        poses = np.flatnonzero(graph.is_pose[rows] & says)
        nodes, reference, information = rows[poses], prior.reference[poses], blocks[poses]
        if prior.anchored:
            terms.append(Terms.of(np.full(len(nodes), n), nodes, reference, 0.0, information))
        else:
            terms.append(Terms.of(
                nodes[:1].repeat(len(nodes) - 1), nodes[1:],
                se2.between(reference[:1], reference[1:]), 0.0, information[1:]))
    return Terms(*map(np.concatenate, zip(*terms, strict=True)))
