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

from pose_graph_ros.core.compiled.jit import kernel, ROWS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, Poses
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.factors import by_state, model, NO_THIRD, prepare
from pose_graph_ros.core.graph.tables import FACTOR, RECORDS


def errors(poses: Poses, factors: Factors) -> FloatArray:
    """
    Return the errors (3.48), (3.52) of factors, shape (M, 3) [m, m, rad], theta in [-pi, pi).

    They are in the frames of the measured poses, those of edges to a bias in map axes.
    """
    error = np.empty((len(factors), 3))
    _write_errors(*map(_writable, (poses, factors.records)), error)
    observed = factors.j < 0    # of which (3.52) has the other sign
    if np.any(observed):
        error[observed] *= -1.0
        error[observed, 2] = se2.wrap(error[observed, 2])
    return error


def _writable(column: Any) -> npt.NDArray[Any]:
    """Return an array as kernels take it."""
    return np.require(column, requirements=('C', 'W'))


@kernel
def write_data(f, new):  # type: ignore[no-untyped-def]
    """Write what the error of a factor depends on, from a record of `Factors`."""
    for m in range(3):
        f.mean[m] = new.mean[m]
    for m in range(4):
        f.constants[m] = new.constants[m]
    prepare(f, new.kind)


@kernel(signature=(ROWS, RECORDS, ROWS), allocates=True)
def _write_errors(poses, records, error):  # type: ignore[no-untyped-def]
    record = np.empty(1, FACTOR)
    for e in range(len(records)):
        f = record[0]   # in here, as Numba frees the array after its last use
        new = records[e]
        write_data(f, new)
        third, _ = NO_THIRD
        if new.k >= 0:
            third = by_state(f, poses[new.k, 0], poses[new.k, 1])
        error[e, 0], error[e, 1], error[e, 2], _, _, _, _ = model(
            f, new.kind, poses[new.i], poses[new.j if new.j >= 0 else new.i], third)


def energies(error: FloatArray, information: FloatArray) -> FloatArray:
    """Return the energies [sigma^2] for information in the frames of the errors."""
    return np.einsum('mi,mij,mj->m', error, information, error)
