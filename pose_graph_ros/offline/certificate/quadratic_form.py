# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The objective of `formulation` as a quadratic form in the headings, positions eliminated.

With whitened residuals `C_t t + C_z z` the best positions for given headings solve a real linear
system, `L t = -C_t^T C_z z`, L a weighted Laplacian. What remains is f = z^H Q z, with
`Q = C_z^H (C_z + C_t (positions per z))`, which is dense, but never formed: a product with it
takes one sparse solve. M is the sparse form in (t, z) whose Schur complement Q is, with a block
for each node.

Headings may also be rows of r complex numbers each (`riemannian`): then t has r columns as well.
"""

from collections.abc import Sequence

import numpy as np

from pose_graph_ros.core.geometry.se2 import ComplexArray, FloatArray, IntArray
from pose_graph_ros.core.sparse.block_matrix import BlockFactors, BlockPattern, Blocks, order_of
from pose_graph_ros.offline.certificate.formulation import Formulation


class QuadraticForm:
    """
    The objective as a function of headings; t of the map is 0.

    Parameters
    ----------
    form : Formulation
    places : ndarray of int, shape (n,), optional
        Place of each unknown in an order of elimination with little fill; else one is found.

    """

    def __init__(self, form: Formulation, places: IntArray | None = None) -> None:
        self.n = form.n_unknowns
        """Number of headings."""
        self._i, self._j = form.i, form.j
        self._root_tau, root_kappa = np.sqrt(form.tau), np.sqrt(form.kappa)
        # what the residuals are of z_i and z_j
        self._upper = -self._root_tau * form.arm_i, self._root_tau * form.arm_j
        self._lower = -root_kappa * form.rotation, root_kappa + 0j
        # of the blocks (i, i), (i, j), (j, i) and (j, j) of each term
        self._rows = form.i, form.i, form.j, form.j
        self._columns = form.i, form.j, form.i, form.j
        nodes = np.arange(self.n)
        self._pattern = BlockPattern(
            np.concatenate((*self._rows, nodes)), np.concatenate((*self._columns, nodes)),
            order_of(form.i, form.j, self.n) if places is None else places)
        self._blocks = self._matrix_blocks()
        laplacian = [block[:, :1, :1].real for block in self._blocks]
        self._laplacian = self._pattern.factors((
            *self._without_map(laplacian, 0), _unit(self.n, 1, 0).real))
        self.diagonal: FloatArray = np.zeros(self.n)
        """Entries of M at the headings, shape (n,)."""
        for row, column, block in zip(self._rows, self._columns, self._blocks, strict=True):
            self.diagonal += _scattered(row, block[:, 1, 1] * (row == column), self.n).real

    def _matrix_blocks(self) -> list[ComplexArray]:
        """Return the parts of M in (t, z) of the ends: (i, i), (i, j), (j, i) and (j, j)."""
        rows = []
        for sign, upper, lower in zip((-1.0, 1.0), self._upper, self._lower, strict=True):
            row = np.zeros((len(self._i), 2, 2), dtype=np.complex128)
            row[:, 0, 0], row[:, 0, 1], row[:, 1, 1] = sign * self._root_tau, upper, lower
            rows.append(row)
        return [a.conj().swapaxes(1, 2) @ b for a in rows for b in rows]

    def _without_map(self, blocks: Sequence[Blocks], component: int) -> list[Blocks]:
        """Return the blocks of the terms with zeros in the map's row and column of a component."""
        left = []
        for row, column, block in zip(self._rows, self._columns, blocks, strict=True):
            kept = block.copy()
            kept[row == 0, component, :] = 0.0
            kept[column == 0, :, component] = 0.0
            left.append(kept)
        return left

    def factors(self, shift: FloatArray, *, turned: bool = True) -> BlockFactors:
        """
        Return the factors of M with numbers added to the diagonal at the headings.

        The position of the map is held. Raises LinearSolveError if the matrix is singular.

        Parameters
        ----------
        shift : ndarray, shape (n,)
        turned : bool, whether the heading of the map is unknown; else it is held as well

        """
        blocks, single = self._without_map(self._blocks, 0), _unit(self.n, 2, 0)
        single[:, 1, 1] = shift
        if not turned:
            blocks = self._without_map(blocks, 1)
            single[0, 1, 1] = 1.0
        return self._pattern.factors((*blocks, single))

    def inverse(self, factors: BlockFactors, v: ComplexArray) -> ComplexArray:
        """
        Return the headings, shape (n, r), of the solution for a right-hand side.

        Parameters
        ----------
        factors : BlockFactors
        v : ndarray, shape (n, r), right-hand side at the headings; it is zero at the positions

        """
        right = np.zeros((2 * self.n, v.shape[1]), dtype=np.complex128)
        right[1::2] = v
        return factors.solve(right)[1::2]

    def positions(self, z: ComplexArray) -> ComplexArray:
        """Return the best positions, shape (n, r), for headings of this shape; 0 of the map."""
        upper = self._root_tau[:, None] * self._of(self._upper, z)
        right = _scattered(self._j, upper, self.n) - _scattered(self._i, upper, self.n)
        right[0] = 0.0
        # a complex column as two real ones
        solved = self._laplacian.solve(-right.view(np.float64))
        return np.ascontiguousarray(solved).view(np.complex128)

    def _of(self, factors: tuple[ComplexArray, ComplexArray], z: ComplexArray) -> ComplexArray:
        return factors[0][:, None] * z[self._i] + factors[1][:, None] * z[self._j]

    def residuals(self, z: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the whitened residuals of positions and headings, shape (M, r) each."""
        t = self.positions(z)
        return (self._of(self._upper, z) + self._root_tau[:, None] * (t[self._j] - t[self._i]),
                self._of(self._lower, z))

    def cost(self, z: ComplexArray) -> float:
        """Return f for headings z of shape (n, r)."""
        return float(sum(np.sum(np.abs(part)**2) for part in self.residuals(z)))

    def product(self, z: ComplexArray) -> ComplexArray:
        """Return Q z, half the gradient of f, for z of shape (n, r)."""
        # the residuals are orthogonal to the columns of C_t
        upper, lower = self.residuals(z)
        return sum((_scattered(end, self._upper[k].conj()[:, None] * upper
                               + self._lower[k].conj()[:, None] * lower, self.n)
                    for k, end in enumerate((self._i, self._j))), np.zeros_like(z))


def _scattered(nodes: IntArray, values: ComplexArray, n: int) -> ComplexArray:
    """Return the sums of complex values at each of n nodes, shape (n,) or (n, r)."""
    sums = np.empty((n, *values.shape[1:]), dtype=np.complex128)
    # bincount takes one column of real numbers
    for source, target in ((values, sums),) if values.ndim == 1 else zip(
            values.T, sums.T, strict=True):
        target.real = np.bincount(nodes, source.real, n)
        target.imag = np.bincount(nodes, source.imag, n)
    return sums


def _unit(n: int, size: int, component: int) -> ComplexArray:
    """Return blocks of single nodes, shape (n, size, size), 1 for a component of the map."""
    blocks = np.zeros((n, size, size), dtype=np.complex128)
    blocks[0, component, component] = 1.0
    return blocks
