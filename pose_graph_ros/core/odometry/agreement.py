# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How well the rotations of a gyroscope agree with those of odometry, and why they might not.

A rotation by the gyroscope minus that by odometry is, over the time t between two hidden nodes,

    d = b t + tau (w_1 - w_0) + k a

with b the bias, tau how much its stamps are early, w the rates at both nodes, a the rotation and
k the error of the scale. These three are fitted to the newest rotations by least squares, with the
noise that both claim. They are told to people, and have no part in the estimate.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray

# Number of rotations over which the fit forgets, and the least one for a verdict.
MEMORY, LEAST = 1000.0, 30
# The robot must have turned this far for a verdict [rad].
LEAST_TURNED = 2.0 * math.pi
# Errors of the stamps and of the scale that are worth a word [s, 1].
LEAST_EARLY, LEAST_SCALE = 0.05, 0.05
# How many sigmas they must differ from 0 by.
SIGNIFICANT = 5.0
# Rotations of independent sensors differ by more than the first of these; by more than the second
# they contradict each other [sigma].
INDEPENDENT, CONTRADICTORY = 0.1, 1.5
# A gyroscope that turns by less than this share of the rotation by odometry has another axis.
LEAST_SHARE = 0.3
# Differences beyond do not count, as those of wheels that slip [sigma].
MOST = 5.0


class Difference(NamedTuple):
    """How much rotations differ from those of odometry."""

    sigmas: float
    """Root mean square of what the bias does not explain, in units of its sigma."""
    reason: str
    """What is probably wrong, as a sentence without capital and full stop; '' for nothing."""


class Agreement:
    """The sums over the newest rotations of one gyroscope."""

    def __init__(self) -> None:
        self._normal, self._right = np.zeros((3, 3)), np.zeros(3)
        self._squares = self._n = self._turned = 0.0
        self._shares = np.zeros((2, 2))
        """Products of time and rotation by odometry with that rotation and the gyroscope's."""

    def add(
        self, difference: float, seconds: float, change: float, angle: float, variance: float,
    ) -> None:
        """
        Add a rotation.

        Parameters
        ----------
        difference : float, rotation by the gyroscope minus that by odometry [rad]
        seconds : float, its time [s]
        change : float, rate at its end minus that at its begin [rad/s]
        angle : float, rotation by the gyroscope [rad]
        variance : float, of the difference [rad^2]

        """
        row, fade = np.array((seconds, change, angle)), 1.0 - 1.0 / MEMORY
        left = difference
        if self._n >= LEAST:
            left -= float(row @ self._fit()[0])
        weight = min(MOST**2 / (left * left + 1e-300), 1.0 / variance)
        self._normal = fade * self._normal + weight * np.outer(row, row)
        self._right = fade * self._right + weight * difference * row
        self._squares = fade * self._squares + weight * difference * difference
        self._n = fade * self._n + 1.0
        by_odometry = angle - difference
        self._shares = fade * self._shares + weight * np.outer(
            (seconds, by_odometry), (by_odometry, angle))
        self._turned = fade * self._turned + max(abs(angle), abs(by_odometry))

    def _fit(self) -> tuple[FloatArray, FloatArray]:
        """Return bias, time and scale, and their covariance."""
        # weak priors: 0.1 rad/s, 10 s, 10
        covariance = np.linalg.inv(self._normal + np.diag((1e2, 1e-2, 1e-2)))
        return np.asarray(covariance @ self._right), np.asarray(covariance, dtype=np.float64)

    def _share(self) -> float:
        """Return how much the gyroscope turns per rotation by odometry, but for its bias."""
        (time_by, time_angle), (by_by, by_angle) = self._shares.tolist()
        per_time = time_by / float(self._normal[0, 0])
        return (by_angle - per_time * time_angle) / max(by_by - per_time * time_by, 1e-300)

    def difference(self) -> Difference | None:
        """Return the difference by now; None as long as too little is known."""
        if self._n < LEAST or self._turned < LEAST_TURNED:
            return None
        explained = self._right[0]**2 / self._normal[0, 0]
        sigmas = math.sqrt(max(self._squares - explained, 0.0) / self._n)
        found, covariance = self._fit()
        rest = max((self._squares - float(found @ self._right)) / self._n, 1.0)
        shown = np.abs(found) > SIGNIFICANT * np.sqrt(rest * np.diagonal(covariance))
        _, early, scale = found.tolist()
        reason = ''
        if sigmas < INDEPENDENT:
            reason = 'odometry seems to contain it already, so that it counts twice'
        elif sigmas < CONTRADICTORY:
            pass
        elif self._share() < LEAST_SHARE and not (shown[2] and scale > 1.0):
            reason = ('it does not turn with odometry: its z axis is not up (see mounting and '
                      '/tf_static), or it is dead')
        elif shown[2] and scale > 1.0:
            reason = 'it turns the other way: check its mounting'
        elif shown[1] and abs(early) > LEAST_EARLY:
            reason = (f'its stamps seem to be {abs(early):.2f} s '
                      f'{"early" if early > 0.0 else "late"}: see time_offset')
        elif shown[2] and abs(scale) > LEAST_SCALE and scale < 1.0:
            reason = f'odometry turns {1.0 - scale:.2f} times as much'
        return Difference(sigmas, reason)
