# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether a minimum is the global one, and if not, a lower one.

1. The headings of the given poses are moved to the near minimum of the objective of
   `formulation`, positions eliminated.
2. The certificate matrix of this minimum proves a lower bound (`spectrum`). If it is f, but for
   the gap that rounding needs, the minimum is global.
3. Else headings become rows of one number more (the Riemannian staircase: N. Boumal,
   V. Voroninski, A. Bandeira, "The non-convex Burer-Monteiro approach works on smooth
   semidefinite programs", 2016; SE-Sync, section 4). The eigenvector of the negative eigenvalue
   leads downhill from there. The minimum over rows is a lower bound as soon as its own matrix is
   positive; rounded to one number for each heading, it is a start for step 1.

What is proved holds for this objective, and for chi2 with the error (3.48) as far as the objective
is nowhere above chi2: `Formulation.below_chi2`, docs/solver.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import ComplexArray, FloatArray, IntArray
from pose_graph_ros.offline.certificate.formulation import Formulation
from pose_graph_ros.offline.certificate.quadratic_form import QuadraticForm
from pose_graph_ros.offline.certificate.riemannian import Inverse, minimized, unit_rows
from pose_graph_ros.offline.certificate.spectrum import examined, LEAST_COST, Spectrum

MAX_RANK = 6
# Gap up to which a minimum is called global, as a fraction of its cost (at least LEAST_COST).
GAP = 1e-5
# Relative decrease of f by which another minimum counts as lower.
LOWER = 1e-9
HALVINGS = 30


class Verdict(Enum):
    """What a certificate says."""

    CERTIFIED = 'certified'
    NOT_CERTIFIED = 'not certified'
    NOT_ATTEMPTED = 'not attempted'


@dataclass(frozen=True, slots=True)
class Certificate:
    """What was found of the minimum near given poses, and of the best one."""

    verdict: Verdict
    """Of the best minimum that was found."""
    chi2: float
    """Objective of `formulation` at the best minimum."""
    near: float
    """The same at the minimum near the given poses."""
    gap: float
    """How far below `chi2` the global minimum may be at most."""
    smallest: float | None
    """
    Smallest eigenvalue of the certificate matrix of the best minimum, but for the zero.

    None if it is not known, or not needed as the objective is 0.
    """
    rank: int
    """Numbers for each heading with which the bound was found; 1 without the staircase."""
    poses: FloatArray
    """Of all hidden nodes at the best minimum, shape (N, 3) [m, m, rad]."""

    @property
    def bound(self) -> float:
        """The objective is nowhere lower than this."""
        return self.chi2 - self.gap

    @property
    def relative_gap(self) -> float:
        """The gap as a fraction of chi2, at least of 1."""
        return self.gap / max(self.chi2, LEAST_COST)

    @property
    def is_lower(self) -> bool:
        """Whether another minimum is lower than that near the given poses."""
        return self.chi2 < self.near - LOWER * max(self.near, LEAST_COST)


class NearHessian(NamedTuple):
    """What an optimiser that has moved the poses to a minimum of chi2 knows of it."""

    places: IntArray
    """Place of each hidden node that is not fixed in its order of elimination, shape (F,)."""
    solve: Callable[[FloatArray], FloatArray]
    """
    From derivatives of chi2 by the headings of these, shape (F,), to a step of Gauss-Newton.

    The steps for them are those with which the positions change as well.
    """

    def order(self, formulation: Formulation) -> IntArray:
        """Return the place of each unknown of the objective, the map last."""
        places = np.full(formulation.n_unknowns, len(self.places))
        places[1:] = self.places
        return places

    def inverse(self, formulation: Formulation) -> Inverse:
        """Return the preconditioner for `minimized`."""
        def inverse(derivative: FloatArray) -> FloatArray:
            change = np.zeros(formulation.n_unknowns)
            change[1:] = self.solve(derivative[1:])
            return change
        return inverse


def certify(
    formulation: Formulation, poses: FloatArray, *, eigenvalue: bool = True,
    hessian: NearHessian | None = None,
) -> Certificate:
    """
    Return a certificate for the minimum of the objective near some poses, or for a lower one.

    Raises LinearSolveError if the objective does not determine the positions or headings.

    Parameters
    ----------
    formulation : Formulation
    poses : ndarray, shape (N, 3), of all hidden nodes [m, m, rad]
    eigenvalue : bool, whether to compute `smallest` if there is a proof without it
    hessian : NearHessian, optional, spares work

    """
    form = QuadraticForm(formulation, None if hessian is None else hessian.order(formulation))
    if form.n == 1:
        cost = form.cost(np.ones((1, 1), dtype=np.complex128))
        return Certificate(Verdict.CERTIFIED, cost, cost, 0.0, None, 1, poses.copy())
    z = minimized(form, formulation.headings(poses)[:, None],
                  None if hessian is None else hessian.inverse(formulation))
    cost = near = form.cost(z)
    if cost <= GAP * LEAST_COST:
        # a sum of squares is nowhere below 0, whatever rounding leaves of the matrix
        return Certificate(Verdict.CERTIFIED, cost, near, cost, None, 1,
                           formulation.poses(form.positions(z)[:, 0], z[:, 0]))
    spectrum = examined(form, z, eigenvalue=eigenvalue)
    bound, rank = spectrum.bound, 1
    if not spectrum.positive:
        y, rank, above = _staircase(form, z, spectrum)
        other = minimized(form, rounded(y))
        bound = max(bound, above)
        if form.cost(other) < near - LOWER * max(near, LEAST_COST):
            z, cost = other, form.cost(other)
            spectrum = examined(form, z, eigenvalue=eigenvalue)
            bound = max(bound, spectrum.bound)
    gap = max(cost - bound, 0.0)
    certified = gap <= GAP * max(cost, LEAST_COST)
    return Certificate(
        Verdict.CERTIFIED if certified else Verdict.NOT_CERTIFIED, cost, near, gap,
        spectrum.smallest, rank,
        formulation.poses(form.positions(z)[:, 0], z[:, 0]))


def _staircase(
    form: QuadraticForm, y: ComplexArray, spectrum: Spectrum,
) -> tuple[ComplexArray, int, float]:
    """Return rows at a minimum over rows of more numbers, how many, and the best bound."""
    bound = spectrum.bound
    while not spectrum.positive and y.shape[1] < MAX_RANK and spectrum.direction is not None:
        y = minimized(form, _escaped(form, y, spectrum.direction))
        spectrum = examined(form, y)
        bound = max(bound, spectrum.bound)
    return y, y.shape[1], bound


def _escaped(form: QuadraticForm, y: ComplexArray, direction: ComplexArray) -> ComplexArray:
    """Return rows of one number more, at a lower cost along a direction of negative curvature."""
    cost = form.cost(y)
    direction = direction / np.max(np.abs(direction))
    for k in range(HALVINGS):
        longer = unit_rows(np.column_stack((y, 0.5**k * direction)))
        if form.cost(longer) < cost:
            return longer
    return np.column_stack((y, np.zeros(len(y))))


def rounded(y: ComplexArray) -> ComplexArray:
    """Return the headings, shape (n, 1), nearest to rows, shape (n, r), in one direction."""
    _, _, adjoint = np.linalg.svd(y, full_matrices=False)
    return unit_rows(y @ adjoint[:1].conj().T)
