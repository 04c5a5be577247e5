# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Proof of a lower bound of the objective, from the certificate matrix S = Q - L.

For any headings y of length 1, `f(y) = y^H S y + trace(L)`. So if S + diag(s) is positive
definite, f is nowhere below trace(L) - sum(s). Definiteness is that of the sparse matrix
M - diag(0, L - s), of which S + diag(s) is the Schur complement, and is read from its LU factors
without pivoting: to rounding, a proof. At a stationary point trace(L) is f, and if S has no
negative eigenvalue the point is the global minimum, also of the relaxation to rows of r numbers
(L. Carlone, G. Calafiore, C. Tommolillo, F. Dellaert, "Planar pose graph optimization: duality,
optimal solutions, and verification", T-RO 2016; N. Boumal, V. Voroninski, A. Bandeira, 2016).
"""

from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry.se2 import ComplexArray, FloatArray
from pose_graph_ros.core.sparse.block_matrix import BlockFactors
from pose_graph_ros.offline.certificate.quadratic_form import QuadraticForm
from pose_graph_ros.offline.certificate.riemannian import multipliers

# Fraction of f that the shifts s of all headings lower the bound by.
SHIFT = 5e-7
# The same for graphs without errors, as a fraction of the sum of f and this [chi2].
LEAST_COST = 1.0
# Shift of each heading as a fraction of its entry of M, against rounding in the factors.
ROUNDING = 1e-15
# Relative accuracy of eigenvalues.
ACCURACY = 1e-4


@dataclass(frozen=True, slots=True)
class Spectrum:
    """What is known of the certificate matrix of some headings."""

    positive: bool
    """Whether S plus the shift was shown to be positive definite."""
    bound: float
    """Lower bound of f for all headings; holds to rounding."""
    smallest: float | None
    """
    Smallest eigenvalue, but for those of the columns of Y, which are zero at a stationary point.

    None if it was not asked for, or the iteration for it did not converge.
    """
    direction: ComplexArray | None
    """Its eigenvector, shape (n,)."""


def examined(form: QuadraticForm, y: ComplexArray, *, eigenvalue: bool = True) -> Spectrum:
    """
    Return what the certificate matrix of headings says.

    Raises LinearSolveError if rounding leaves no matrix positive definite that has to be.

    Parameters
    ----------
    form : QuadraticForm
    y : ndarray, shape (n, r), rows of length 1 at a stationary point of f
    eigenvalue : bool, whether to compute the smallest eigenvalue if there is a proof without it

    """
    diagonal = multipliers(y, form.product(y))
    total = float(np.sum(diagonal))
    shift = ROUNDING * form.diagonal + SHIFT * (abs(total) + LEAST_COST) / form.n
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
        sigma = -smallest * (1.0 + 100.0 * ACCURACY)
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


def _smallest(
    form: QuadraticForm, factors: BlockFactors, sigma: float, known: ComplexArray | None,
) -> tuple[float | None, ComplexArray | None]:
    """Return the smallest eigenvalue of S, orthogonal to the known vectors, and its vector."""
    n = form.n
    if n < 3 + (0 if known is None else known.shape[1]):
        return None, None
    basis = np.zeros((n, 0), dtype=np.complex128) if known is None else np.linalg.qr(known)[0]

    def inverse(v: ComplexArray) -> ComplexArray:
        right = _without(basis, v.ravel())[:, None]
        return _without(basis, form.inverse(factors, right)[:, 0])

    # takes 0.1 s to load
    import scipy.sparse.linalg  # noqa: PLC0415

    operator = scipy.sparse.linalg.LinearOperator((n, n), matvec=inverse, dtype=np.complex128)
    rng = np.random.default_rng(0)
    try:
        values, vectors = scipy.sparse.linalg.eigsh(
            operator, k=1, which='LM', tol=ACCURACY,
            v0=_without(basis, rng.normal(size=n) + 1j * rng.normal(size=n)))
    except scipy.sparse.linalg.ArpackError:
        return None, None
    if not abs(values[0]) > 0.0:
        return None, None
    return float(1.0 / values[0] + sigma), np.asarray(vectors[:, 0])


def _without(basis: ComplexArray, v: ComplexArray) -> ComplexArray:
    """Return a vector without its components along orthonormal columns."""
    return np.asarray(v - basis @ (basis.conj().T @ v))
