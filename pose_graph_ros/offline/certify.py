# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Whether a minimum is the global one, and if not, a lower one.

1. The headings of the given poses are moved to the near minimum of the objective of
   `chordal_objective`, positions eliminated.
2. The certificate matrix of this minimum proves a lower bound (`examined`). If it is f, but for
   the gap that rounding needs, the minimum is global.
3. Else headings become rows of one number more (the Riemannian staircase: N. Boumal,
   V. Voroninski, A. Bandeira, "The non-convex Burer-Monteiro approach works on smooth
   semidefinite programs", 2016; SE-Sync, section 4). The eigenvector of the negative eigenvalue
   leads downhill from there. The minimum over rows is a lower bound as soon as its own matrix is
   positive; rounded to one number for each heading, it is a start for step 1.

The proof: S = Q - L is the certificate matrix of headings. For any headings y of length 1,
`f(y) = y^H S y + trace(L)`. So if S + diag(s) is positive definite, f is nowhere below
trace(L) - sum(s). Definiteness is that of the sparse matrix M - diag(0, L - s), of which
S + diag(s) is the Schur complement, and is read from its LU factors without pivoting: to rounding,
a proof. At a stationary point trace(L) is f, and if S has no negative eigenvalue the point is the
global minimum, also of the relaxation to rows of r numbers (L. Carlone, G. Calafiore,
C. Tommolillo, F. Dellaert, "Planar pose graph optimization: duality, optimal solutions, and
verification", T-RO 2016; N. Boumal, V. Voroninski, A. Bandeira, 2016).

What is proved holds for this objective, and for chi2 with the error (3.48) as far as the objective
is nowhere above chi2: `Formulation.below_chi2`, docs/solver.md.

Minima are found by a Riemannian trust region (`minimized`). A heading is a row of r complex
numbers with length 1. With r = 1 it is an angle; with more there is room to leave a local minimum.
Steps are those of a truncated Newton method (P.-A. Absil, C. Baker, K. Gallivan, "Trust-region
methods on Riemannian manifolds", 2007): conjugate gradients in the tangent space, preconditioned
by the form without the constraint of length 1.

With g = Q Y - L Y, L the real diagonal of `Re <Y_i, (Q Y)_i>`, half the gradient, half the Hessian
is the projection of Q - L. All rows may be turned by one unitary matrix, so row 0 stays.
"""

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry.se2 import ComplexArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.sparse import BlockFactors
from pose_graph_ros.offline.chordal_objective import Formulation, QuadraticForm

Preconditioner = Callable[[ComplexArray, ComplexArray], ComplexArray]
"""From headings, and derivatives by them, to a change that is nearly a step of Newton."""


class Tuning(NamedTuple):
    """Numbers of the certificate; fractions of f are those of at least 1."""

    max_rank: int = 6  # numbers for each heading at most
    gap: float = 1e-5  # fraction of f up to which a minimum is called global
    lower: float = 1e-9  # fraction of f by which another minimum counts as lower
    shift: float = 5e-7  # fraction of f that the shifts s of all headings lower the bound by
    accuracy: float = 1e-4  # relative, of eigenvalues


TUNING = Tuning()


class Verdict(Enum):
    """What a certificate says."""

    CERTIFIED = 'certified'
    NOT_CERTIFIED = 'not certified'
    NOT_ATTEMPTED = 'not attempted'


class Certificate(NamedTuple):
    """What was found of the minimum near given poses, and of the best one."""

    verdict: Verdict  # of the best minimum that was found
    chi2: float  # f at the best minimum
    near: float  # f at the minimum near the given poses
    gap: float  # how far below `chi2` the global minimum may be at most
    # smallest eigenvalue of the certificate matrix of the best minimum, but for the zero; None if
    # it is not known, or not needed as f is 0
    smallest: float | None
    rank: int  # numbers for each heading with which the bound was found; 1 without the staircase
    poses: Poses  # of all hidden nodes at the best minimum

    @property
    def bound(self) -> float:
        """The objective is nowhere lower than this."""
        return self.chi2 - self.gap

    @property
    def relative_gap(self) -> float:
        """The gap as a fraction of chi2, at least of 1."""
        return self.gap / max(self.chi2, 1.0)

    @property
    def is_lower(self) -> bool:
        """Whether another minimum is lower than that near the given poses."""
        return self.chi2 < self.near - TUNING.lower * max(self.near, 1.0)


class Spectrum(NamedTuple):
    """What is known of the certificate matrix of some headings."""

    positive: bool  # whether S plus the shift was shown to be positive definite
    bound: float  # lower bound of f for all headings; holds to rounding
    # smallest eigenvalue, but for those of the columns of Y, which are zero at a stationary point;
    # None if it was not asked for, or the iteration for it did not converge
    smallest: float | None
    direction: ComplexArray | None  # its eigenvector, shape (n,)


class NearHessian(NamedTuple):
    """What an optimiser that has moved the poses to a minimum of chi2 knows of it."""

    # of the F hidden nodes that are not fixed, in its order of elimination, if it tells
    places: IntArray | None
    # from derivatives of chi2 by the headings of these, (F,), to their part of a Gauss-Newton step
    solve: Callable[[FloatArray], FloatArray]

    def precondition(self, y: ComplexArray, v: ComplexArray) -> ComplexArray:
        """Return a change of headings that are angles, given the derivatives by them."""
        change = np.zeros_like(v)
        change[1:, 0] = self.solve((y.conj() * v).imag[1:, 0])
        return 1j * y * change  # it turns a heading at a right angle


def certify(formulation: Formulation, poses: Poses, *, eigenvalue: bool = True,
            hessian: NearHessian | None = None) -> Certificate:
    """
    Return a certificate for the minimum of the objective near some poses, or for a lower one.

    Raises LinearSolveError if the objective does not determine the positions or headings.
    """
    # the map is the last that is eliminated
    places = None if hessian is None else hessian.places
    form = QuadraticForm(formulation, None if places is None else np.concatenate(
        ([len(places)], places)))
    if form.n == 1:
        cost = form.cost(np.ones((1, 1), dtype=np.complex128))
        return Certificate(Verdict.CERTIFIED, cost, cost, 0.0, None, 1, poses.copy())
    z = minimized(form, formulation.headings(poses)[:, None],
                  None if hessian is None else hessian.precondition)
    cost = near = form.cost(z)
    if cost <= TUNING.gap * 1.0:
        # a sum of squares is nowhere below 0, whatever rounding leaves of the matrix
        return Certificate(Verdict.CERTIFIED, cost, near, cost, None, 1,
                           formulation.poses(form.positions(z)[:, 0], z[:, 0]))
    spectrum = examined(form, z, eigenvalue=eigenvalue)
    bound, y = spectrum.bound, z
    if not spectrum.positive:
        above = spectrum    # a minimum over rows of more numbers
        while (not above.positive and y.shape[1] < TUNING.max_rank
               and above.direction is not None):
            y = minimized(form, _escaped(form, y, above.direction))
            above = examined(form, y)
            bound = max(bound, above.bound)
        other = minimized(form, rounded(y))
        if form.cost(other) < near - TUNING.lower * max(near, 1.0):
            z, cost = other, form.cost(other)
            spectrum = examined(form, z, eigenvalue=eigenvalue)
            bound = max(bound, spectrum.bound)
    gap = max(cost - bound, 0.0)
    certified = gap <= TUNING.gap * max(cost, 1.0)
    return Certificate(Verdict.CERTIFIED if certified else Verdict.NOT_CERTIFIED,
                       cost, near, gap, spectrum.smallest, y.shape[1],
                       formulation.poses(form.positions(z)[:, 0], z[:, 0]))


def _escaped(form: QuadraticForm, y: ComplexArray, direction: ComplexArray) -> ComplexArray:
    """Return rows of one number more, at a lower cost along a direction of negative curvature."""
    cost = form.cost(y)
    direction = direction / np.max(np.abs(direction))
    for k in range(30):
        longer = unit_rows(np.column_stack((y, 0.5**k * direction)))
        if form.cost(longer) < cost:
            return longer
    return np.column_stack((y, np.zeros(len(y))))


def rounded(y: ComplexArray) -> ComplexArray:
    """Return the headings, shape (n, 1), nearest to rows, shape (n, r), in one direction."""
    _, _, adjoint = np.linalg.svd(y, full_matrices=False)
    return unit_rows(y @ adjoint[:1].conj().T)


def examined(form: QuadraticForm, y: ComplexArray, *, eigenvalue: bool = True) -> Spectrum:
    """
    Return what the certificate matrix of rows of length 1 at a stationary point of f says.

    `eigenvalue` asks for the smallest one also if there is a proof without it. Raises
    LinearSolveError if rounding leaves no matrix positive definite that has to be.
    """
    diagonal, total = multipliers(y, form.product(y)), form.cost(y)
    # the trace is f but for rounding, which that of the best positions acts on in first order, on
    # f in second; any diagonal proves a bound
    diagonal += (total - np.sum(diagonal)) / form.n
    # the first against rounding in the factors
    shift = 1e-15 * form.diagonal + TUNING.shift * (abs(total) + 1.0) / form.n
    factors = _definite(form, shift - diagonal)
    if factors is not None:
        smallest, vector = (_smallest(form, factors, -float(np.mean(shift)), y) if eigenvalue
                            else (None, None))
        return Spectrum(True, total - float(np.sum(shift)), smallest, vector)
    # a shift at which it is definite lies below the smallest eigenvalue
    sigma = float(np.max(shift))
    # Q has no negative eigenvalue, so above the largest entry of L rounding is to blame
    most = 100.0 * (sigma + float(np.max(np.abs(diagonal))))
    while factors is None:
        sigma *= 10.0
        if not sigma <= most:
            raise LinearSolveError('certificate: the numbers are too different in size')
        factors = _definite(form, sigma - diagonal)
    smallest, vector = _smallest(form, factors, -sigma, None)
    proved = total - form.n * sigma
    if smallest is not None:
        # the eigenvalue is an estimate from above; what is a little lower is proved
        sigma = -smallest * (1.0 + 100.0 * TUNING.accuracy)
        if _definite(form, sigma - diagonal) is not None:
            proved = max(proved, total - form.n * sigma)
    return Spectrum(False, proved, smallest, vector)


def _definite(form: QuadraticForm, shift: FloatArray) -> BlockFactors | None:
    """Return the factors of M with a shift of the headings if it is definite, else None."""
    try:
        factors = form.factors(shift)
    except LinearSolveError:
        return None
    return factors if factors.is_positive else None


def _smallest(form: QuadraticForm, factors: BlockFactors, sigma: float,
              known: ComplexArray | None) -> tuple[float | None, ComplexArray | None]:
    """Return the smallest eigenvalue of S, orthogonal to the known vectors, and its vector."""
    n = form.n
    if n < 3 + (0 if known is None else known.shape[1]):
        return None, None
    basis = np.zeros((n, 0), dtype=np.complex128) if known is None else np.linalg.qr(known)[0]

    def inverse(v: ComplexArray) -> ComplexArray:
        return _without(basis, form.inverse(factors, _without(basis, v.ravel())[:, None])[:, 0])

    # takes 0.1 s to load
    import scipy.sparse.linalg  # noqa: PLC0415

    operator = scipy.sparse.linalg.LinearOperator((n, n), matvec=inverse, dtype=np.complex128)
    rng = np.random.default_rng(0)
    try:
        values, vectors = scipy.sparse.linalg.eigsh(
            operator, k=1, which='LM', tol=TUNING.accuracy,
            v0=_without(basis, rng.normal(size=n) + 1j * rng.normal(size=n)))
    except scipy.sparse.linalg.ArpackError:
        return None, None
    if not abs(values[0]) > 0.0:
        return None, None
    return float(1.0 / values[0] + sigma), np.asarray(vectors[:, 0])


def _without(basis: ComplexArray, v: ComplexArray) -> ComplexArray:
    """Return a vector without its components along orthonormal columns."""
    return np.asarray(v - basis @ (basis.conj().T @ v))


def inner(a: ComplexArray, b: ComplexArray) -> float:
    """Return the real inner product of two arrays."""
    return float(np.vdot(a, b).real)


def unit_rows(y: ComplexArray) -> ComplexArray:
    """Return rows, shape (n, r), scaled to length 1; a row of zeros becomes (1, 0, ...)."""
    length = np.linalg.norm(y, axis=1)
    y = y / np.where(length > 0.0, length, 1.0)[:, None]
    y[length == 0.0, 0] = 1.0
    return y


def multipliers(y: ComplexArray, product: ComplexArray) -> FloatArray:
    """Return the diagonal L, shape (n,), given Y and Q Y, shape (n, r)."""
    return np.asarray(np.sum(y.real * product.real + y.imag * product.imag, axis=1))


def minimized(form: QuadraticForm, y: ComplexArray,
              precondition: Preconditioner | None = None) -> ComplexArray:
    """
    Return headings at a minimum of f near the given ones, or where steps no longer lower it.
    """
    cost, radius = form.cost(y), np.inf
    product = form.product(y)
    if precondition is None:
        # v -> (Q - L)^-1 v with row 0 held, or with Q alone if that is not definite
        damping = 1e-12 * form.diagonal   # makes it definite
        factors = form.factors(damping - multipliers(y, product), turned=False)
        if not factors.is_positive:
            factors = form.factors(damping, turned=False)

        def precondition(_: ComplexArray, v: ComplexArray) -> ComplexArray:
            out = form.inverse(factors, v)
            out[0] = 0.0
            return out
    for _ in range(300):
        diagonal = multipliers(y, product)[:, None]
        tangent = _projection(y)
        gradient = tangent(product - diagonal * y)
        decrease = inner(gradient, tangent(precondition(y, gradient)))
        if not decrease > 1e-11 * cost:
            break
        radius = min(radius, 100.0 * np.sqrt(decrease))
        step, predicted, at_limit = _step(form, precondition, (y, diagonal), gradient, radius)
        candidate = unit_rows(y + step)
        after = form.cost(candidate)
        slack = 1e-14 * cost   # may be rounding
        ratio = (cost - after + slack) / (predicted + slack)
        if ratio < 0.25:
            radius = min(radius, np.sqrt(decrease)) * 0.25
        elif ratio > 0.75 and at_limit:
            radius *= 4.0
        if ratio > 0.05:
            y, cost = candidate, after
            product = form.product(y)
        if predicted < slack:
            break
    return y


def _projection(y: ComplexArray) -> Callable[[ComplexArray], ComplexArray]:
    """Return the projection to the tangent space at Y, with row 0 at rest."""
    def tangent(v: ComplexArray) -> ComplexArray:
        v = v - multipliers(y, v)[:, None] * y
        v[0] = 0.0
        return v
    return tangent


def _step(form: QuadraticForm, precondition: Preconditioner, at: tuple[ComplexArray, FloatArray],
          gradient: ComplexArray, radius: float) -> tuple[ComplexArray, float, bool]:
    """
    Return a step, the decrease of f that it should bring, and whether the radius limits it.

    Conjugate gradients of Steihaug and Toint, with lengths as the preconditioner measures them, at
    Y with the diagonal L.
    """
    y, diagonal = at
    tangent = _projection(y)
    step, residual = np.zeros_like(gradient), gradient.copy()
    applied = np.zeros_like(gradient)  # the Hessian times the step
    scaled = tangent(precondition(y, residual))
    square = first = inner(residual, scaled)
    direction = -scaled
    length, cross, own = 0.0, 0.0, square
    at_limit = False
    for _ in range(300):
        image = tangent(form.product(direction) - diagonal * direction)
        curvature = inner(direction, image)
        alpha = square / curvature if curvature > 0.0 else np.inf
        if not length + 2.0 * alpha * cross + alpha**2 * own < radius**2:
            alpha = (np.sqrt(cross**2 + own * (radius**2 - length)) - cross) / own
            at_limit = True
        step += alpha * direction
        applied += alpha * image
        if at_limit:
            break
        residual += alpha * image
        length += 2.0 * alpha * cross + alpha**2 * own
        scaled = tangent(precondition(y, residual))
        before, square = square, inner(residual, scaled)
        if square <= 1e-6 * first:
            break
        beta = square / before
        cross = beta * (cross + alpha * own)
        own = square + beta**2 * own
        direction = beta * direction - scaled
    return step, -2.0 * inner(gradient, step) - inner(step, applied), at_limit
