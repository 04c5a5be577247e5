# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Robust losses, as functions of the energy of a constraint and a threshold k [sigma].

With s the square root of the energy e^T information e, the cost of a constraint is rho(s) instead
of s^2, and its weight in H and b is w(s) = rho'(s) / (2 s):

    none     rho = s^2                          w = 1
    Huber    rho = s^2 up to k, 2 k s - k^2     w = 1, then k / s
    Cauchy   rho = k^2 log(1 + s^2 / k^2)       w = 1 / (1 + s^2 / k^2)

The weights depend on the estimate and the estimate on the weights, so both are computed in turn
(iteratively reweighted least squares).
"""

import numpy as np

from pose_graph_ros.core.config import Loss
from pose_graph_ros.core.geometry.se2 import FloatArray


def weights(loss: Loss, energy: FloatArray, threshold: float) -> FloatArray:
    """
    Return the weights of constraints, shape (M,), in (0, 1].

    Parameters
    ----------
    loss : Loss
    energy : ndarray, shape (M,)
        Unweighted energies [sigma^2].
    threshold : float
        Threshold k of the loss, positive [sigma].

    """
    ratio = np.maximum(energy, 0.0) / threshold**2
    if loss is Loss.HUBER:
        return np.asarray(1.0 / np.sqrt(np.maximum(ratio, 1.0)))
    if loss is Loss.CAUCHY:
        return np.asarray(1.0 / (1.0 + ratio))
    return np.ones_like(ratio)


def costs(loss: Loss, energy: FloatArray, threshold: float) -> FloatArray:
    """
    Return the costs rho of constraints, shape (M,) [sigma^2].

    Parameters
    ----------
    loss, energy, threshold
        As in `weights`.

    """
    square = threshold**2
    ratio = np.maximum(energy, 0.0) / square
    if loss is Loss.HUBER:
        return np.where(ratio > 1.0, square * (2.0 * np.sqrt(ratio) - 1.0), square * ratio)
    if loss is Loss.CAUCHY:
        return np.asarray(square * np.log1p(ratio))
    return np.asarray(energy)
