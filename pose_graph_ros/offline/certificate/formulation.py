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
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.geometry.se2 import BoolArray, ComplexArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges, ObservedNodes
from pose_graph_ros.core.graph.kinds import NodeKind
from pose_graph_ros.core.sparse.components import components

# Largest distance whose squares are certain not to overflow [m].
LARGEST = 1e100
# Relative difference up to which information counts as isotropic.
ISOTROPIC = 1e-9


class Constrained(Protocol):
    """What is needed of a graph, a `Graph` or a `PlainGraph`."""

    @property
    def node_kind(self) -> npt.NDArray[Any]:
        """`NodeKind` of hidden nodes, shape (N,)."""

    @property
    def n_priors(self) -> int:
        """Number of dense priors."""

    @property
    def poses(self) -> FloatArray:
        """Of all hidden nodes, shape (N, 3) [m, m, rad]."""

    @property
    def fixed(self) -> BoolArray:
        """Whether hidden nodes keep their pose, shape (N,)."""

    @property
    def edges_by_row(self) -> Edges:
        """All edges, with rows for ends."""

    @property
    def observed_by_row(self) -> ObservedNodes:
        """All observed nodes, with rows for their nodes."""


class NotCoveredError(PoseGraphError):
    """The objective does not cover a graph; the message is the reason."""


@dataclass(frozen=True, slots=True)
class Formulation:
    """Terms of the objective, M of them; unknown 0 is the map."""

    i: IntArray
    j: IntArray
    rotation: ComplexArray
    """Unit numbers r, shape (M,)."""
    arm_i: ComplexArray
    """a, shape (M,) [m]."""
    arm_j: ComplexArray
    """b, shape (M,) [m]."""
    kappa: FloatArray
    """Shape (M,) [1/rad^2]."""
    tau: FloatArray
    """Shape (M,) [1/m^2]."""
    number: IntArray
    """Unknown of each hidden node, shape (N,), 0 for fixed ones."""
    fixed: FloatArray
    """Poses of all hidden nodes [m, m, rad], shape (N, 3), of which those fixed are used."""
    below_chi2: bool
    """
    Whether f is nowhere above chi2: no information depends on the direction or is correlated.

    A lower bound of f is one of chi2 then.
    """
    origin: complex
    """Where the positions begin in the map [m]."""

    @property
    def n_unknowns(self) -> int:
        """Number of unknown headings, with that of the map."""
        return int(np.max(self.number, initial=0)) + 1

    def headings(self, poses: FloatArray) -> ComplexArray:
        """Return z, shape (n_unknowns,), of poses of all hidden nodes, shape (N, 3)."""
        z = np.ones(self.n_unknowns, dtype=np.complex128)
        free = self.number > 0
        z[self.number[free]] = np.exp(1j * poses[free, 2])
        return z

    def poses(self, positions: ComplexArray, headings: ComplexArray) -> FloatArray:
        """
        Return poses of all hidden nodes in the map [m, m, rad], shape (N, 3).

        Parameters
        ----------
        positions, headings : ndarray, shape (n_unknowns,), t and z

        """
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
    edges, observed = graph.edges_by_row, graph.observed_by_row
    edges = edges.rows(edges.weight > 0.0)
    observed = observed.rows(observed.weight > 0.0)
    poses, fixed = graph.poses, graph.fixed
    number = np.where(fixed, 0, np.cumsum(~fixed))
    places = np.concatenate((_complex(poses[fixed]), _complex(
        observed.mean[_kappa_tau(observed.information)[1] > 0.0])))
    origin = complex(np.mean(places)) if len(places) > 0 else 0j
    own = np.where(fixed, np.exp(1j * poses[:, 2]), 1.0)
    at = np.where(fixed, _complex(poses) - origin, 0.0)

    n = len(observed)
    # both kinds of constraints: from i, or from the map, to j
    start = np.concatenate((number[edges.i], np.zeros(n, np.int64)))
    end = np.concatenate((edges.j, observed.node))
    turn = np.exp(1j * np.concatenate((
        edges.mean[:, 2], observed.mean[:, 2] - observed.offset[:, 2])))
    own_i = np.concatenate((own[edges.i], np.ones(n)))
    arm_i = np.concatenate((
        at[edges.i] + own[edges.i] * _complex(edges.mean), _complex(observed.mean) - origin))
    offset = np.concatenate((np.zeros(len(edges)), _complex(observed.offset)))
    information = np.concatenate((edges.weighted_information, observed.weighted_information))
    with np.errstate(over='ignore', invalid='ignore'):
        kappa, tau = _kappa_tau(information)
    if not (np.all(np.isfinite(tau)) and np.all(np.abs(arm_i) < LARGEST)):
        raise NotCoveredError('the numbers are too large')
    form = Formulation(
        start, number[end], own_i * turn * own[end].conj(), arm_i, at[end] + own[end] * offset,
        kappa, tau, number, poses.copy(), _is_below(information, kappa, tau), origin)
    _check_held(form)
    return form


def _complex(poses: FloatArray) -> ComplexArray:
    return np.asarray(poses[:, 0] + 1j * poses[:, 1])


def _kappa_tau(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the weights of heading and position, shape (M,) each; see the top of the module."""
    xx, yy, xy = information[:, 0, 0], information[:, 1, 1], information[:, 0, 1]
    trace = xx + yy
    tau = 2.0 * (xx * yy - xy * xy) / np.where(trace > 0.0, trace, 1.0)
    return np.maximum(information[:, 2, 2], 0.0), np.maximum(tau, 0.0)


def _is_below(information: FloatArray, kappa: FloatArray, tau: FloatArray) -> bool:
    """Tell whether `diag(tau, tau, kappa)` is nowhere above the information."""
    rest = information.copy()
    rest[:, (0, 1, 2), (0, 1, 2)] -= np.stack((tau, tau, kappa), axis=1)
    # as far as the six numbers of a file tell
    least = np.sqrt(np.maximum(np.einsum('mii->mi', information), np.finfo(float).tiny))
    scaled = rest / least[:, :, None] / least[:, None, :]
    return bool(np.min(np.linalg.eigvalsh(scaled), initial=0.0) > -ISOTROPIC)


def _check_held(form: Formulation) -> None:
    """Raise NotCoveredError unless constraints on positions join all unknowns to the map."""
    joining = form.tau > 0.0
    part = components(form.i[joining], form.j[joining], form.n_unknowns)
    if np.any(part != 0):
        raise NotCoveredError(
            f'constraints on positions join {int(np.sum(part != 0))} nodes to nothing fixed '
            f'and nothing observed')
