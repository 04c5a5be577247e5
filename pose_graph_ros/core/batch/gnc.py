# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Graduated non-convexity: a set of believed constraints, without a start that is nearly right.

After H. Yang, P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial
perception: from non-minimal solvers to global outlier rejection", RA-L 2020. The truncated cost is
the minimum over weights w in [0, 1] of

    w r^2 + P(w),        P(w) = c^2 (1 - w).

It is replaced by a cost with a control mu that is convex at first and tends to it, in which
weights between 0 and 1 cost less. With s = r^2 / c^2,

    truncated:      P / c^2 = mu (1 - w) / (mu + w),   so w = sqrt(mu (mu + 1) / s) - mu in [0, 1]
    Geman-McClure:  P / c^2 = mu (1 - sqrt(w))^2,      so w = (mu / (mu + s))^2

each w where the derivative by w is zero. mu grows from near 0 to infinity for the truncated
surrogate (where its curvature, -2 mu between the bounds, does not outweigh the rest), and falls
from twice the largest s to 1 for that of Geman-McClure.
"""

from enum import Enum

import numpy as np

from pose_graph_ros.core.batch.truncated import Choice, TruncatedProblem
from pose_graph_ros.core.geometry.se2 import FloatArray

# Factor on mu from step to step, and their maximum number.
FACTOR = 1.4
STEPS = 100
# A weight that is closer than this to 0 or 1 is final.
FINAL = 1e-3
# Entries of the factorisation with all constraints, above which it is not tried.
MOST_NUMBERS = 500_000
# Smallest and largest mu to begin with.
_LEAST, _MOST = 1e-6, 1e12


class Surrogate(Enum):
    """Cost that tends to the truncated one."""

    TRUNCATED = 'truncated'
    GEMAN_MCCLURE = 'geman_mcclure'

    def weights(self, share: FloatArray, mu: float) -> FloatArray:
        """
        Return the weights of constraints.

        Parameters
        ----------
        share : ndarray, shape (M,), r^2 / c^2
        mu : float

        """
        if self is Surrogate.GEMAN_MCCLURE:
            return (mu / (mu + share)) ** 2
        root = np.sqrt(mu * (mu + 1.0) / np.maximum(share, 1e-12))
        return np.clip(root - mu, 0.0, 1.0)

    def first(self, largest: float) -> float:
        """Return mu to begin with, given the largest r^2 / c^2, which is above 1."""
        if self is Surrogate.GEMAN_MCCLURE:
            return min(2.0 * largest, _MOST)
        return max(1.0 / (2.0 * largest - 1.0), _LEAST)


def select(
    problem: TruncatedProblem, surrogate: Surrogate, *, patient: bool = False,
) -> Choice | None:
    """
    Return the set that graduated non-convexity ends with.

    None if no step could be solved, or if each would take long: with many random edges the
    factorisation is nearly dense.

    Parameters
    ----------
    problem : TruncatedProblem
    surrogate : Surrogate
    patient : bool, whether to try it however long it takes

    """
    if not patient and (
            problem.factorisation(problem.allowed.astype(np.float64)) > MOST_NUMBERS):
        return None
    if not problem.solve(np.zeros(len(problem))):
        return None
    share = problem.shares()
    largest = float(np.max(share, initial=0.0, where=np.isfinite(share)))
    if largest > 1.0:
        mu = surrogate.first(largest)
        for _ in range(STEPS):
            weights = surrogate.weights(share, mu)
            if not problem.solve(weights):
                break
            share = problem.shares()
            undecided = np.minimum(weights, 1.0 - weights)
            if surrogate is Surrogate.GEMAN_MCCLURE:
                if mu == 1.0:
                    break
                mu = max(mu / FACTOR, 1.0)
            else:
                if np.max(undecided, initial=0.0) < FINAL:
                    break
                mu *= FACTOR
    return problem.choice(share <= 1.0)
