# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The objective to which certificates of global optimality apply, from the constraints of a graph.

With the heading of node i as a unit complex number z_i, its position as a complex number t_i, and
an edge from i to j with the measured pose (t_e, th_e), the objective is

    f = sum_e  kappa_e |z_j - z_i exp(i th_e)|^2  +  tau_e |t_j - t_i - z_i t_e|^2,

a Hermitian quadratic form in (t, z). `kappa` is the entry of the information for the heading and
`tau = 2 / trace(inverse of its block for the position)`, both as in D. Rosen et al., "SE-Sync: a
certifiably correct algorithm for synchronization over the special Euclidean group", IJRR 2019,
section 3.1. (In the plane their chordal distance of rotations is 2 |z - z'|^2; here a small error
counts as in chi2.) chi2, with the errors (3.48) and (3.52), differs by the angle itself in place
of the chord, 2 sin(e/2), which is never longer, and by information on the position that differs
with the direction or is correlated with the heading. Without these f is nowhere above chi2.

The map is unknown 0, with z = 1 and t = 0 at the origin. Fixed nodes are parts of it: their z and
t are constants times z_0. An observed node is an edge from the map, a position one with kappa = 0.
So every constraint is, with arms a and b (0 unless the end is fixed or observed with an offset),

    kappa |z_j - z_i r|^2 + tau |t_j + z_j b - t_i - z_i a|^2.

`QuadraticForm` is this objective in the headings alone, positions eliminated. With whitened
residuals `C_t t + C_z z` the best positions for given headings solve a real linear system,
`L t = -C_t^T C_z z`, L a weighted Laplacian. What remains is f = z^H Q z, with
`Q = C_z^H (C_z + C_t (positions per z))`, which is dense, but never formed: a product with it
takes one sparse solve. M is the sparse form in (t, z) whose Schur complement Q is, with a block
for each node. Headings may also be rows of r complex numbers each (`certify`): then t has r
columns as well.
"""


from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.linear_starts import complex_of, Constrained, NodeSystem, Terms
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.geometry.se2 import ComplexArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.constraints import NodeKind
from pose_graph_ros.core.sparse import BlockFactors, components


class NotCoveredError(PoseGraphError):
    """The objective does not cover a graph; the message is the reason."""


class Formulation(NamedTuple):
    """Terms of the objective, M of them; unknown 0 is the map."""

    i: IntArray
    j: IntArray
    rotation: ComplexArray  # unit numbers r
    arm_i: ComplexArray  # a [m]
    arm_j: ComplexArray  # b [m]
    kappa: FloatArray  # [1/rad^2]
    tau: FloatArray  # [1/m^2]
    number: IntArray  # unknown of each hidden node, shape (N,), 0 for fixed ones
    fixed: Poses  # of all hidden nodes; those of fixed ones are used
    # whether f is nowhere above chi2, as no information depends on the direction or is correlated:
    # a lower bound of f is one of chi2 then
    below_chi2: bool
    origin: complex  # where the positions begin in the map [m]

    @property
    def n_unknowns(self) -> int:
        """Number of unknown headings, with that of the map."""
        return int(np.max(self.number, initial=0)) + 1

    def headings(self, poses: FloatArray) -> ComplexArray:
        """Return z, shape (n_unknowns,), of poses of all hidden nodes, shape (N, 3)."""
        z, free = np.ones(self.n_unknowns, dtype=np.complex128), self.number > 0
        z[self.number[free]] = np.exp(1j * poses[free, 2])
        return z

    def poses(self, positions: ComplexArray, headings: ComplexArray) -> FloatArray:
        """Return poses of all hidden nodes in the map, given t and z, shape (n_unknowns,)."""
        turn = headings[0].conjugate()
        t, z = positions * turn + self.origin, headings * turn
        poses = np.stack((t.real, t.imag, np.angle(z)), axis=1)[self.number]
        return np.where(self.number[:, None] > 0, poses, self.fixed)


def formulate(graph: Constrained) -> Formulation:
    """
    Return the objective for a graph, or raise NotCoveredError with the reason.

    Weights count as they are, also those that a robust loss gave. Not covered are biases,
    landmarks, priors of marginalisation, and parts of a graph that nothing holds.
    """
    for each, name in ((NodeKind.LANDMARK, 'landmarks'), (NodeKind.BIAS, 'biases')):
        if np.any(graph.node_kind == each):
            raise NotCoveredError(f'the graph has {name}, which have no heading')
    if graph.n_priors > 0:
        raise NotCoveredError('the graph has priors on several nodes, which are not isotropic')
    factors = graph.factors_by_row
    factors = factors.rows(factors.weight > 0.0)
    poses, fixed = graph.poses, graph.fixed
    information = factors.weighted_information
    xx, yy, xy = information[:, 0, 0], information[:, 1, 1], information[:, 0, 1]
    kappa = np.maximum(information[:, 2, 2], 0.0)
    with np.errstate(over='ignore', invalid='ignore'):
        trace = xx + yy
        tau = np.maximum(2.0 * (xx * yy - xy * xy) / np.where(trace > 0.0, trace, 1.0), 0.0)
    terms = Terms.of_factors(factors, len(poses))
    places = np.concatenate((complex_of(poses[fixed]), terms.arm_i[(factors.j < 0) & (tau > 0.0)]))
    origin = complex(np.mean(places)) if len(places) > 0 else 0j
    # of all nodes, and of the map behind them: unknown, its heading and position as far as known
    number = np.append(np.where(fixed, 0, np.cumsum(~fixed)), 0)
    own = np.append(np.where(fixed, np.exp(1j * poses[:, 2]), 1.0), 1.0)
    at = np.append(np.where(fixed, complex_of(poses) - origin, 0.0), -origin)
    arm_i, arm_j = (at[end] + own[end] * arm for end, arm in (
        (terms.i, terms.arm_i), (terms.j, terms.arm_j)))
    # squares of longer distances may overflow
    if not (np.all(np.isfinite(tau)) and np.all(np.abs(arm_i) < 1e100)):
        raise NotCoveredError('the numbers are too large')
    # diag(tau, tau, kappa) is nowhere above the information, as far as the six numbers of a file
    # tell
    rest = information.copy()
    rest[:, (0, 1, 2), (0, 1, 2)] -= np.stack((tau, tau, kappa), axis=1)
    least = np.sqrt(np.maximum(np.einsum('mii->mi', information), np.finfo(float).tiny))
    scaled = rest / least[:, :, None] / least[:, None, :]
    is_below = bool(np.min(np.linalg.eigvalsh(scaled), initial=0.0) > -1e-9)
    form = Formulation(
        number[terms.i], number[terms.j], own[terms.i] * terms.turn * own[terms.j].conj(),
        arm_i, arm_j, kappa, tau, number[:-1], poses.copy(), is_below, origin)
    part = components(form.i[tau > 0.0], form.j[tau > 0.0], form.n_unknowns)
    if np.any(part != 0):
        raise NotCoveredError(f'constraints on positions join {int(np.sum(part != 0))} nodes to '
                              'nothing fixed and nothing observed')
    return form


class QuadraticForm:
    """
    The objective as a function of headings; t of the map is 0.

    `places` are those of all unknowns in an order of elimination with little fill; without them
    one is found.
    """

    def __init__(self, form: Formulation, places: IntArray | None = None) -> None:
        self.n = form.n_unknowns
        """Number of headings."""
        self._ends = form.i, form.j
        root_tau, root_kappa = np.sqrt((form.tau, form.kappa))
        # what the residuals of position and heading are of t and z of both ends
        by = self._by = np.zeros((2, len(form.tau), 2, 2), dtype=np.complex128)
        by[:, :, 0, 0] = -root_tau, root_tau
        by[:, :, 0, 1] = -root_tau * form.arm_i, root_tau * form.arm_j
        by[:, :, 1, 1] = -root_kappa * form.rotation, root_kappa
        self._nodes = NodeSystem(form.i, form.j, np.ones(self.n, dtype=bool), places)
        squares = self._nodes.gathered([*np.abs(by)**2], np.ones(by.shape[1:3]))
        self.diagonal: FloatArray = squares[:, 1]
        """Entries of M at the headings, shape (n,)."""
        # f depends on differences of positions, so to pull that of the map to 0 holds it there
        self._pull = squares[0, 0] or 1.0
        self._by_t = by[0, :, :1, :1].real.copy(), by[1, :, :1, :1].real.copy()
        own = np.zeros((self.n, 1, 1))
        own[0] = self._pull
        self._laplacian = self._nodes.factors(self._by_t, self._by_t, own)
        # headings with what was found for them, as f and its gradient are asked for one by one
        self._last: tuple[ComplexArray, ComplexArray, ComplexArray] | None = None

    def factors(self, shift: FloatArray, *, turned: bool = True) -> BlockFactors:
        """
        Return the factors of M with numbers added to the diagonal at the headings.

        The position of the map is held, and nearly its heading unless `turned`. Raises
        LinearSolveError if the matrix is singular.
        """
        own = np.zeros((self.n, 2, 2))
        own[0, 0, 0], own[:, 1, 1] = self._pull, shift
        if not turned:
            own[0, 1, 1] = 1e8 * np.max(self.diagonal)
        return self._nodes.factors([*self._by], [*self._by], own)

    def inverse(self, factors: BlockFactors, v: ComplexArray) -> ComplexArray:
        """
        Return the headings, shape (n, r), of the solution for a right-hand side.

        The latter is v, shape (n, r), at the headings, and zero at the positions.
        """
        right = np.zeros((2 * self.n, v.shape[1]), dtype=np.complex128)
        right[1::2] = v
        return factors.solve(right)[1::2]

    def positions(self, z: ComplexArray) -> ComplexArray:
        """Return the best positions, shape (n, r), for headings of this shape; 0 of the map."""
        return self._solved(z)[1]

    def residuals(self, z: ComplexArray) -> ComplexArray:
        """Return the whitened residuals of positions and headings, shape (M, 2, r)."""
        return self._solved(z)[2]

    def _solved(self, z: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return headings, which must not change later, with their positions and residuals."""
        if self._last is None or self._last[0] is not z:
            (i, j), (by_i, by_j) = self._ends, self._by[:, :, :, 1:]
            residuals = np.asarray(by_i * z[i, None] + by_j * z[j, None])
            right = self._nodes.gathered(self._by_t, residuals[:, :1])[:, 0]
            # a complex column as two real ones
            solved = self._laplacian.solve(-np.ascontiguousarray(right).view(np.float64))
            t = np.ascontiguousarray(solved).view(np.complex128)
            residuals[:, 0] += self._by_t[1][:, 0] * (t[j] - t[i])
            self._last = z, t, residuals
        return self._last

    def cost(self, z: ComplexArray) -> float:
        """Return f for headings z of shape (n, r)."""
        return float(np.sum(np.abs(self.residuals(z))**2))

    def product(self, z: ComplexArray) -> ComplexArray:
        """Return Q z, half the gradient of f, for z of shape (n, r)."""
        # the residuals are orthogonal to the columns of C_t
        by_i, by_j = self._by[:, :, :, 1:]
        return self._nodes.gathered((by_i, by_j), self.residuals(z))[:, 0]
