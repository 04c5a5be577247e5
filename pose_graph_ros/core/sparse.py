# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Sparse symmetric systems of equations with a block for each node, without compiled kernels.

For tools that run once: NumPy and the SuperLU of SciPy are loaded in a fraction of the time that
Numba and the kernels take. The pattern and an order of the nodes with little fill are found once
(`BlockPattern`, `order_of`); matrices with other numbers, and with blocks of another size, only
need sums.
"""

from collections.abc import Iterable
import functools
import importlib
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader, FileFinder
from importlib.util import find_spec, module_from_spec
from pathlib import Path
import sys
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry.se2 import IntArray

Blocks = npt.NDArray[Any]

NAME = 'scipy.sparse.linalg._dsolve._superlu'
# No pivoting, as symmetric matrices that are definite do not need it. Without relaxed supernodes
# and with narrow panels a factorisation takes 0.6 of the time (city10000, 3 unknowns a node).
OPTIONS = {'DiagPivotThresh': 0.0, 'SymmetricMode': True, 'Equil': False,
           'Relax': 1, 'PanelSize': 8}


@functools.cache
def _extension() -> Any:
    """
    Return SuperLU as SciPy has it, without the rest of SciPy.

    `scipy.sparse.linalg` imports 200 modules, which takes 0.13 s; the extension among them takes
    5 ms alone. It is loaded by its file name, under its own name, so that SciPy uses the same one
    later. Where it is not found, SciPy is imported as usual.
    """
    scipy = find_spec('scipy')
    if NAME not in sys.modules and scipy is not None:
        for folder in scipy.submodule_search_locations or ():
            finder = FileFinder(str(Path(folder, *NAME.split('.')[1:-1])),
                                (ExtensionFileLoader, EXTENSION_SUFFIXES))
            spec = finder.find_spec(NAME)
            if spec is not None and spec.loader is not None:
                module = module_from_spec(spec)
                spec.loader.exec_module(module)
                sys.modules[NAME] = module
                return module
    return importlib.import_module(NAME)


def _factors(values: npt.NDArray[Any], rows: npt.NDArray[np.int32], starts: npt.NDArray[np.int32],
             *, ordered: bool) -> Any:
    """
    Return SuperLU's factors of a sparse symmetric or Hermitian matrix in compressed columns.

    Raises LinearSolveError if it is singular. Both triangles are given, the rows ascending in each
    column; an order with little fill is found unless they are ordered already.
    """
    specification = 'NATURAL' if ordered else 'MMD_AT_PLUS_A'
    try:
        # what `scipy.sparse.linalg.splu` calls (SciPy 1.11 to 1.17), not a public interface
        return _extension().gstrf(
            len(starts) - 1, len(values), values, rows, starts,
            csc_construct_func=lambda parts, shape: parts, ilu=False,
            options={**OPTIONS, 'ColPerm': specification})
    except (RuntimeError, MemoryError) as error:
        raise LinearSolveError(f'sparse factorisation: {error}') from error


class BlockPattern:
    """
    Where sums of K blocks, given by rows and columns, are in a matrix of n ordered nodes.

    Each pattern is symmetric, and has all diagonals; `order_of` returns the nodes' places.
    """

    def __init__(self, rows: IntArray, columns: IntArray, places: IntArray) -> None:
        self._places, n = places, len(places)
        keys = places[columns] * n + places[rows]
        self._order = np.argsort(keys, kind='stable')
        keys = keys[self._order]
        self._begins = np.flatnonzero(np.diff(keys, prepend=-1))
        self._columns, self._rows = np.divmod(keys[self._begins], n)
        self._starts = np.searchsorted(self._columns, np.arange(n + 1))
        self._layouts: dict[int, tuple[npt.NDArray[Any], ...]] = {}

    def _layout(self, size: int) -> tuple[npt.NDArray[Any], ...]:
        """Return the place of each number of each block, rows and starts of the columns."""
        if size not in self._layouts:
            n_blocks, height = len(self._rows), np.diff(self._starts)
            first = self._starts[self._columns]
            # number (r, m) of block k: column m of its node, below the blocks above it
            at = (size * size * first + size * (np.arange(n_blocks) - first))[:, None, None] + (
                np.arange(size)[:, None] + size * np.arange(size) * height[
                    self._columns][:, None, None])
            rows = np.empty(size * size * n_blocks, dtype=np.int32)
            rows[at] = (size * self._rows)[:, None, None] + np.arange(size)[:, None]
            starts = np.concatenate(([0], np.cumsum(np.repeat(size * height, size))))
            self._layouts[size] = at, rows, starts.astype(np.int32)
        return self._layouts[size]

    def factors(self, blocks: Iterable[Blocks]) -> 'BlockFactors':
        """
        Return the factors of a matrix; raise LinearSolveError if it is singular.

        The blocks, (K, b, b) together, are in the order of rows and columns.
        """
        summed = np.add.reduceat(np.concatenate([*blocks])[self._order], self._begins, axis=0)
        size = summed.shape[-1]
        at, rows, starts = self._layout(size)
        values = np.empty(len(rows), dtype=summed.dtype)
        values[at] = summed
        return BlockFactors(_factors(values, rows, starts, ordered=True), self._places, size)


class BlockFactors:
    """Factors of a matrix of blocks, solved for right-hand sides in the order of the nodes."""

    def __init__(self, factors: Any, places: IntArray, size: int) -> None:
        self._factors = factors
        self._numbers = (size * places[:, None] + np.arange(size)).ravel()

    @property
    def is_positive(self) -> bool:
        """
        Whether the factors show that the matrix is positive definite.

        Without a permutation that differs between rows and columns, `U = D L^H`. By Sylvester's
        law of inertia D has as many positive numbers as there are positive eigenvalues.
        """
        if not np.array_equal(self._factors.perm_r, self._factors.perm_c):
            return False
        values, rows, starts = self._factors.U
        last = starts[1:] - 1   # the diagonal is the end of each column
        return np.array_equal(rows[last], np.arange(len(last))) and bool(
            np.all(values[last].real > 0.0))

    def solve(self, right: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the solution for right-hand sides of the matrix's type, (n b,) or (n b, k)."""
        ordered = np.empty_like(right)
        ordered[self._numbers] = right
        return np.asarray(self._factors.solve(ordered)[self._numbers])


def order_of(i: IntArray, j: IntArray, n: int) -> IntArray:
    """
    Return the place of each node in an order of elimination with little fill, shape (n,).

    It is that of minimum degree for edges between the nodes.
    """
    nodes = np.arange(n)
    # without an index NumPy loads its masked arrays, which takes 7 ms
    keys, _ = np.unique(np.concatenate((i * n + j, j * n + i, nodes * n + nodes)),
                        return_index=True)
    columns, rows = np.divmod(keys, n)
    starts = np.searchsorted(columns, np.arange(n + 1)).astype(np.int32)
    # diagonally dominant
    values = np.where(rows == columns, np.diff(starts)[columns].astype(np.float64), -0.5)
    factors = _factors(values, rows.astype(np.int32), starts, ordered=False)
    return np.asarray(factors.perm_c, dtype=np.int64)


def components(i: IntArray, j: IntArray, n: int) -> IntArray:
    """
    Return the smallest node that each node is connected to by edges, shape (n,).

    Labels spread along the edges and, as each label is a node too, along the labels, so that the
    number of rounds grows with the logarithm of the longest path.
    """
    label = np.arange(n)
    while True:
        low = np.minimum(label[i], label[j])
        new = label.copy()
        # the labels of both ends, not only the ends, move
        for end in (i, j, label[i], label[j]):
            np.minimum.at(new, end, low)
        while not np.array_equal(new[new], new):
            new = new[new]
        if np.array_equal(new, label):
            return label
        label = new
