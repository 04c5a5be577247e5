# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What measurements in the map have shown of the errors of odometry, and edges that know of it.

The noise of an edge has a part that no error of a heading makes, that of the way: the covariance
of its position where the turn is known. It and all the rest, which errors of headings make, have a
factor each. An error of the yaw rate and of the scale that stay the same are taken out of the
motion itself. Both can be done to edges with any errors in use, and undone, without loss.
"""

import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray


class OdometryErrors(NamedTuple):
    """Errors of the primary odometry, in units of what it claims and as constants."""

    way: float = 1.0
    """Factor on the part of the variances that no error of a heading makes."""
    turn: float = 1.0
    """Factor on the rest."""
    rate: float = 0.0
    """What the yaw rate is larger than odometry says [rad/s]."""
    scale: float = 0.0
    """By which part the way is longer than odometry says."""

    @classmethod
    def scaled(cls, sigmas: float) -> 'OdometryErrors':
        """Return errors with all sigmas times a factor."""
        return cls(sigmas**2, sigmas**2)

    def motions(self, means: FloatArray, seconds: FloatArray) -> FloatArray:
        """
        Return motions without their constant errors.

        Parameters
        ----------
        means : ndarray, shape (M, 3) [m, m, rad], as odometry says
        seconds : ndarray, shape (M,), their durations [s]

        """
        # at a constant rate the chord turns by half of what the end turns by
        c, s = np.cos(0.5 * self.rate * seconds), np.sin(0.5 * self.rate * seconds)
        x, y, length = means[:, 0], means[:, 1], 1.0 + self.scale
        return np.column_stack((length * (c * x - s * y), length * (s * x + c * y),
                                means[:, 2] + self.rate * seconds))

    def as_odometry_says(self, means: FloatArray, seconds: FloatArray) -> FloatArray:
        """Undo `motions`."""
        c, s = np.cos(0.5 * self.rate * seconds), np.sin(0.5 * self.rate * seconds)
        x, y, length = means[:, 0], means[:, 1], 1.0 / (1.0 + self.scale)
        return np.column_stack((length * (c * x + s * y), length * (c * y - s * x),
                                means[:, 2] - self.rate * seconds))

    def covariances(self, claimed: FloatArray) -> FloatArray:
        """Return covariances of motions, shape (M, 3, 3), from those that odometry claims."""
        heading = np.where(claimed[:, 2:, 2:] > 0.0, claimed[:, 2:, 2:], np.inf)
        by_turn = claimed[:, :, 2:] @ claimed[:, 2:, :] / heading
        return np.asarray(self.turn * by_turn + self.way * (claimed - by_turn))

    def informations(self, claimed: FloatArray) -> FloatArray:
        """Return the inverses of `covariances` from those of what is claimed, as accurately."""
        result = claimed / self.way
        position = claimed[:, :2, :2]
        turn = claimed[:, 2, 2] - np.einsum(
            'mi,mi->m', claimed[:, 2, :2], np.linalg.solve(
                position, claimed[:, :2, 2:])[..., 0])
        result[:, 2, 2] += turn * (1.0 / self.turn - 1.0 / self.way)
        return np.asarray(result)

    @property
    def inverse_noise(self) -> 'OdometryErrors':
        """What undoes the factors of the noise, without constant errors."""
        return OdometryErrors(1.0 / self.way, 1.0 / self.turn)

    @property
    def mean_sigma(self) -> float:
        """Factor on the sigmas of an edge, in the geometric mean."""
        return float((self.way**2 * self.turn)**(1.0 / 6.0))

    def is_close(self, other: 'OdometryErrors') -> bool:
        """Tell whether the numbers are those of others, but for rounding."""
        return all(math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12)
                   for a, b in zip(self, other, strict=True))


AS_CLAIMED = OdometryErrors()


def changed(
    means: FloatArray, informations: FloatArray, seconds: FloatArray, before: OdometryErrors,
    after: OdometryErrors,
) -> tuple[FloatArray, FloatArray]:
    """
    Return means and informations of edges with other errors than those that they have.

    Parameters
    ----------
    means, informations : ndarray, shapes (M, 3) and (M, 3, 3)
    seconds : ndarray, shape (M,), from the node before to the node after [s]
    before, after : OdometryErrors

    """
    claimed = before.inverse_noise.informations(informations)
    return (after.motions(before.as_odometry_says(means, seconds), seconds),
            after.informations(claimed))
