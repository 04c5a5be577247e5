# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How much more room a source needs than its stated covariances give.

While measurements are judged, the covariances of each source are multiplied by a factor that
follows the median of the squared distances of those that are believed. Its memory is about a
hundred measurements, so that a fault of a minute hardly changes it.
"""

import math

# Change of the logarithm of a factor by one measurement, and the largest factor.
STEP, MOST = 0.03, 4.0
# Median of chi2 with 2 and 3 degrees of freedom.
MEDIAN = {2: 1.386, 3: 2.366}


class StatedNoise:
    """Factors on the covariances of sources, at least 1."""

    def __init__(self) -> None:
        self._factors: dict[str, float] = {}

    def factor(self, source: str) -> float:
        """Return the factor of a source."""
        return self._factors.get(source, 1.0)

    def note(self, source: str, d2: float, size: int) -> None:
        """
        Note the squared distance of a measurement that is believed.

        Parameters
        ----------
        d2 : float, by the covariance with the factor
        size : int, 2 of a position, 3 of a pose

        """
        factor = self.factor(source) * math.exp(STEP if d2 > MEDIAN[size] else -STEP)
        self._factors[source] = min(max(factor, 1.0), MOST)

    def copy(self) -> 'StatedNoise':
        """Return a copy that does not change with this one."""
        other = StatedNoise()
        other._factors = self._factors.copy()
        return other
