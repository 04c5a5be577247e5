# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The objective of `formulation` as a quadratic form in the headings, positions eliminated.

With whitened residuals `C_t t + C_z z` the best positions for given headings solve a real linear
system, `L t = -C_t^T C_z z`, L a weighted Laplacian. What remains is f = z^H Q z, with
`Q = C_z^H (C_z + C_t (positions per z))`, which is dense, but never formed: a product with it
takes one sparse solve. `matrix` is the sparse form M in (t, z) whose Schur complement Q is.

Headings may also be rows of r complex numbers each (`riemannian`): then t has r columns as well.
"""

from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from pose_graph_ros.core.certificate.formulation import Formulation
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry.se2 import ComplexArray, FloatArray


class QuadraticForm:
    """The objective as a function of headings; t of the map is 0."""

    def __init__(self, form: Formulation) -> None:
        m, n = len(form.i), form.n_unknowns
        rows, ones = np.arange(m), np.ones(m)
        s, k = np.sqrt(form.tau), np.sqrt(form.kappa)
        difference = scipy.sparse.coo_array(
            (np.concatenate((s, -s)), (np.concatenate((rows, rows)),
                                       np.concatenate((form.j, form.i)))), shape=(m, n)).tocsr()
        self._place = difference[:, 1:].tocsr()
        self._turn = scipy.sparse.coo_array(
            (np.concatenate((s * form.arm_j, -s * form.arm_i, k * ones, -k * form.rotation)),
             (np.concatenate((rows, rows, m + rows, m + rows)),
              np.concatenate((form.j, form.i, form.j, form.i)))), shape=(2 * m, n)).tocsr()
        self._adjoint = self._turn.conj().T.tocsr()
        self._upper, self._place_t = self._turn[:m], self._place.T.tocsr()
        laplacian = (self._place_t @ self._place).tocsc()
        self._laplacian = factorized(laplacian)
        both = scipy.sparse.vstack((self._place, scipy.sparse.csr_array((m, n - 1))))
        rows_of_all = scipy.sparse.hstack((both, self._turn)).tocsr()
        self.matrix: Any = (rows_of_all.conj().T @ rows_of_all).tocsc()
        """M, of (t of all but the map, z), shape (2 n - 1, 2 n - 1)."""
        self.n = n
        """Number of headings."""

    def positions(self, z: ComplexArray) -> ComplexArray:
        """Return the best positions, shape (n, r), for headings of this shape; 0 of the map."""
        right = np.ascontiguousarray(self._place_t @ (self._upper @ z))
        # a complex column as two real ones
        solved = self._laplacian.solve(-right.view(np.float64))
        t = np.zeros(z.shape, dtype=np.complex128)
        t[1:] = np.ascontiguousarray(solved).view(np.complex128)
        return t

    def residuals(self, z: ComplexArray) -> ComplexArray:
        """Return the whitened residuals, shape (2 M, r), for headings z of shape (n, r)."""
        residuals = np.asarray(self._turn @ z)
        residuals[:self._place.shape[0]] += np.asarray(self._place @ self.positions(z)[1:])
        return residuals

    def cost(self, z: ComplexArray) -> float:
        """Return f for headings z of shape (n, r)."""
        return float(np.sum(np.abs(self.residuals(z))**2))

    def product(self, z: ComplexArray) -> ComplexArray:
        """Return Q z, half the gradient of f, for z of shape (n, r)."""
        # the residuals are orthogonal to the columns of C_t
        return np.asarray(self._adjoint @ self.residuals(z))

    def shifted(self, shift: FloatArray) -> Any:
        """Return M with `shift`, shape (n,), added to the diagonal at the headings."""
        return (self.matrix + scipy.sparse.diags_array(
            np.concatenate((np.zeros(self.n - 1), shift)))).tocsc()


def factorized(matrix: Any) -> Any:
    """
    Return SuperLU factors of a sparse Hermitian matrix, without pivoting if it is definite.

    Raises LinearSolveError if it is singular.
    """
    try:
        return scipy.sparse.linalg.splu(
            matrix, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
            options={'SymmetricMode': True})
    except RuntimeError as error:
        raise LinearSolveError(f'certificate: {error}') from error


def is_positive(factors: Any) -> bool:
    """
    Tell whether the factors show that their matrix is positive definite.

    Without a permutation that differs between rows and columns, `U = D L^H`, and by Sylvester's
    law of inertia D has as many positive numbers as the matrix has positive eigenvalues.
    """
    return bool(np.array_equal(factors.perm_r, factors.perm_c)
                and np.all(factors.U.diagonal().real > 0.0))
