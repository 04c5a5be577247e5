# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
SuperLU as SciPy has it, without the rest of SciPy.

`scipy.sparse.linalg` imports 200 modules, which takes 0.13 s; the factorisation is in one
extension module among them, which takes 5 ms alone. It is loaded by its file name, under its own
name, so that SciPy uses the same one if it is imported later. Where it is not found, SciPy is
imported as usual. `gstrf` is what `scipy.sparse.linalg.splu` calls (SciPy 1.11 to 1.17); its
arguments are not part of SciPy's public interface.
"""

import functools
import importlib
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
import sys
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.geometry.se2 import IntArray

NAME = 'scipy.sparse.linalg._dsolve._superlu'
# No pivoting, as symmetric matrices that are definite do not need it. Without relaxed supernodes
# and with narrow panels a factorisation takes 0.6 of the time (city10000, 3 unknowns a node).
OPTIONS = {'DiagPivotThresh': 0.0, 'SymmetricMode': True, 'Equil': False,
           'Relax': 1, 'PanelSize': 8}


@functools.cache
def _extension() -> Any:
    """Return the extension module."""
    scipy = find_spec('scipy')
    if NAME not in sys.modules and scipy is not None:
        for folder in scipy.submodule_search_locations or ():
            path = Path(folder, *NAME.split('.')[1:])
            for suffix in EXTENSION_SUFFIXES:
                spec = spec_from_file_location(NAME, f'{path}{suffix}')
                if spec is not None and spec.loader is not None and Path(
                        f'{path}{suffix}').is_file():
                    module = module_from_spec(spec)
                    spec.loader.exec_module(module)
                    sys.modules[NAME] = module
                    return module
    return importlib.import_module(NAME)


class Factors:
    """
    Factors of a sparse symmetric or Hermitian matrix in compressed columns.

    Raises LinearSolveError if it is singular.

    Parameters
    ----------
    values : ndarray of float or complex, shape (K,), with both triangles
    rows : ndarray of int32, shape (K,), ascending in each column
    starts : ndarray of int32, shape (n + 1,), where each column begins
    ordered : bool
        Whether the order of rows and columns is one with little fill already; else one is found.

    """

    def __init__(
        self, values: npt.NDArray[Any], rows: npt.NDArray[np.int32],
        starts: npt.NDArray[np.int32], *, ordered: bool,
    ) -> None:
        specification = 'NATURAL' if ordered else 'MMD_AT_PLUS_A'
        try:
            self._factors = _extension().gstrf(
                len(starts) - 1, len(values), values, rows, starts,
                csc_construct_func=lambda parts, shape: parts, ilu=False,
                options={**OPTIONS, 'ColPerm': specification})
        except (RuntimeError, MemoryError) as error:
            raise LinearSolveError(f'sparse factorisation: {error}') from error

    @property
    def places(self) -> IntArray:
        """Place of each row in the order of elimination, shape (n,)."""
        return np.asarray(self._factors.perm_c, dtype=np.int64)

    def solve(self, right: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """
        Return the solutions for right-hand sides.

        Parameters
        ----------
        right : ndarray of the type of the matrix, shape (n,) or (n, k)

        """
        return np.asarray(self._factors.solve(right))

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
        columns = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        # the arrays may have space behind the last column
        pivots = values[:starts[-1]][rows[:starts[-1]] == columns]
        return len(pivots) == len(starts) - 1 and bool(np.all(pivots.real > 0.0))
