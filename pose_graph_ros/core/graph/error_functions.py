# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Errors of constraints at given poses: `factors` for tables that need not be in a graph.

The energy of a constraint is `e^T information e`, without a factor 1/2; chi2 is the sum of all
energies.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.compiled.jit import BYTES, INTEGERS, kernel, ROWS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, Poses
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.factors import model, prepare
from pose_graph_ros.core.graph.tables import FACTOR


def errors(poses: Poses, factors: Factors) -> FloatArray:
    """
    Return the errors (3.48), (3.52) of factors, shape (M, 3) [m, m, rad], theta in [-pi, pi).

    They are in the frames of the measured poses, those of edges to a bias in map axes.
    """
    error = np.empty((len(factors), 3))
    _write_errors(*map(_writable, (poses, *(getattr(factors, name) for name in (
        'i', 'j', 'k', 'mean', 'kind', 'constants')))), error)
    observed = factors.j < 0    # of which (3.52) has the other sign
    if np.any(observed):
        error[observed] *= -1.0
        error[observed, 2] = se2.wrap(error[observed, 2])
    return error


def _writable(column: Any) -> npt.NDArray[Any]:
    """Return an array as kernels take it."""
    return np.require(column, requirements=('C', 'W'))


@kernel
def write_data(f, kind, mean, constants):  # type: ignore[no-untyped-def]
    """Write what the error of a factor depends on into its record."""
    f.mean[0], f.mean[1], f.mean[2] = mean[0], mean[1], mean[2]
    for m in range(4):
        f.constants[m] = constants[m]
    prepare(f, kind)


@kernel(signature=(ROWS, INTEGERS, INTEGERS, INTEGERS, ROWS, BYTES, ROWS, ROWS), allocates=True)
def _write_errors(poses, i, j, k, mean, kind, constants, error):  # type: ignore[no-untyped-def]
    record = np.empty(1, FACTOR)
    for e in range(len(i)):
        f = record[0]   # in here, as Numba frees the array after its last use
        write_data(f, kind[e], mean[e], constants[e])
        third = constants[e, 3] * poses[k[e], 0] if k[e] >= 0 else 0.0
        error[e, 0], error[e, 1], error[e, 2], _, _, _, _ = model(
            f, kind[e], poses[i[e]], poses[j[e] if j[e] >= 0 else i[e]], third)


def energies(error: FloatArray, information: FloatArray) -> FloatArray:
    """Return the energies [sigma^2] for information in the frames of the errors."""
    return np.einsum('mi,mij,mj->m', error, information, error)
