# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The factor on the sigmas of a source of closures that their residuals show.

The residual of a constraint in the graph has the covariance `s^2 R - C`, with R the claimed one,
s the factor and `C = J P J^T` its part that the estimate has followed. So `e^T R^-1 e` is expected
to be `3 s^2 - tr(R^-1 C)`. Its median over many closures, each divided by the share of `3 s^2`
that is left, gives s whatever a few wrong ones do.
"""

import math

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray

# Median of chi2 with three degrees of freedom.
MEDIAN = 2.366
# Closures with a smaller share of their residual left say little.
LEAST_SHARE = 0.2
# A factor of 1 is believed as much as this number of closures.
PRIOR = 10.0
# Most closures that are looked at.
MOST = 100
# Largest factor, and the ratio of successive ones: few values, so that closures are rarely weighed
# anew, and the factor does not depend on rounding.
LARGEST, RATIO = 10.0, 1.2


def residual_scale(
    errors: FloatArray, covariances: FloatArray, information: FloatArray, scale: float,
) -> float:
    """
    Return the factor on the sigmas of a source, at least 1.

    Parameters
    ----------
    errors : ndarray, shape (M, 3), residuals of believed closures
    covariances : ndarray, shape (M, 3, 3), C, with the closures in the graph
    information : ndarray, shape (M, 3, 3), claimed
    scale : float, the present factor

    """
    trace = np.einsum('mij,mji->m', information, covariances)
    share = 1.0 - trace / (3.0 * scale**2)
    said = share > LEAST_SHARE
    n = int(np.count_nonzero(said))
    if n == 0:
        return scale
    energy = np.einsum('mi,mij,mj->m', errors, information, errors)[said] / share[said]
    learnt = math.log(max(float(np.median(energy)) / MEDIAN, 1e-6)) / 2.0
    steps = round(learnt * n / (n + PRIOR) / math.log(RATIO))
    return min(RATIO ** max(steps, 0), LARGEST)
