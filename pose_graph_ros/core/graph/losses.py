# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Losses: the cost of a constraint, and its weight in H and b, as functions of its energy.

With E = e^T information e the energy, k the threshold of the loss [sigma] and z = E / k^2, the
cost of a constraint is k^2 rho(z) instead of E, and its weight is w(z) = rho'(z):

    none                     rho = z                               w = 1
    Huber                    rho = z up to 1, 2 sqrt(z) - 1        w = 1, then 1 / sqrt(z)
    Cauchy                   rho = log(1 + z)                      w = 1 / (1 + z)
    Geman-McClure            rho = z / (1 + z)                     w = 1 / (1 + z)^2
    DCS                      rho = z up to 1, (3 z - 1) / (1 + z)  w = 1, then 4 / (1 + z)^2
    Tukey                    rho = (1 - (1 - z)^3) / 3, 1 / 3      w = (1 - z)^2, then 0
    truncated least squares  rho = z up to 1, 1                    w = 1, then 0

All are concave in z, so each reweighted solution lowers the cost. The last four are bounded: a
wrong constraint has the same cost however wrong it is, but the result depends on the start.

DCS (dynamic covariance scaling, P. Agarwal et al., ICRA 2013) multiplies the information by s^2,
s = min(1, 2 k^2 / (k^2 + E)). Its cost is the integral of that weight; the cost of switchable
constraints, s^2 E + k^2 (1 - s)^2, is constant beyond k for this s.

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
        case Loss.GEMAN_MCCLURE:
            share = 1.0 / (1.0 + z)
            return z * share, share**2
        case Loss.DCS:
            switch = 2.0 / (1.0 + np.maximum(z, 1.0))
            return np.where(z > 1.0, 3.0 - 2.0 * switch, z), switch**2
        case Loss.TUKEY:
            left = 1.0 - np.minimum(z, 1.0)
            return (1.0 - left**3) / 3.0, left**2
        case Loss.TRUNCATED:
            return np.minimum(z, 1.0), np.where(z > 1.0, 0.0, 1.0)
        case _:
            assert_never(loss)
