# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Losses: the cost of a constraint, and its weight in H and b, as functions of its energy.

With E = e^T information e the energy, k the threshold of the loss [sigma] and z = E / k^2, the
cost of a constraint is k^2 rho(z) instead of E, and its weight is w(z) = rho'(z):

    none     rho = z                            w = 1
    Huber    rho = z up to 1, 2 sqrt(z) - 1     w = 1, then 1 / sqrt(z)
    Cauchy   rho = log(1 + z)                   w = 1 / (1 + z)

A new loss is a member of `config.Loss` and a case of `_normalized`.
"""

from typing import assert_never

import numpy as np

from pose_graph_ros.core.config import Loss
from pose_graph_ros.core.geometry.se2 import FloatArray


def costs_and_weights(
    loss: Loss, energy: FloatArray, threshold: float,
) -> tuple[FloatArray, FloatArray]:
    """
    Return costs [sigma^2] and weights of constraints, shape (M,) each.

    Parameters
    ----------
    loss : Loss
    energy : ndarray, shape (M,), unweighted energies [sigma^2]; negative ones count as 0
    threshold : float, k [sigma]

    """
    square = threshold**2
    rho, weight = _normalized(loss, np.maximum(energy, 0.0) / square)
    return square * rho, weight


def _normalized(loss: Loss, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rho and its derivative, for z >= 0."""
    match loss:
        case Loss.NONE:
            return z, np.ones_like(z)
        case Loss.HUBER:
            root = np.sqrt(np.maximum(z, 1.0))
            return np.where(z > 1.0, 2.0 * root - 1.0, z), 1.0 / root
        case Loss.CAUCHY:
            return np.log1p(z), 1.0 / (1.0 + z)
        case _:
            assert_never(loss)
