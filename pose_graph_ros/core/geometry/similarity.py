# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Align trajectories by a rigid motion or a similarity of the plane, in the least-squares sense.

The solution is that of S. Umeyama, "Least-squares estimation of transformation parameters between
two point patterns", IEEE PAMI 13(4), 1991, which in the plane needs no decomposition: the sums of
the dot and the cross products of the centred points are cosine and sine of the angle times one
number. In space, as evo solves it, planar points may also be turned over, which is a reflection
in the plane; where that fits better, the results differ.
"""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray


class Similarity(NamedTuple):
    """A motion of the plane and a scale, applied as `pose * (scale * p)`."""

    pose: FloatArray
    """`T_target_source`, shape (3,) [m, m, rad]."""
    scale: float

    def apply(self, poses: FloatArray) -> FloatArray:
        """Return poses in the target frame, shape (N, 3)."""
        return se2.compose(self.pose, poses * (self.scale, self.scale, 1.0))

    def apply_to_covariances(self, covariances: FloatArray) -> FloatArray:
        """Return covariances, shape (N, 3, 3), in the axes of the target frame."""
        matrix = np.eye(3)
        matrix[:2, :2] = self.scale * se2.rotation(self.pose[2])
        return np.asarray(matrix @ covariances @ matrix.T)


IDENTITY = Similarity(np.zeros(3), 1.0)


def fit_similarity(
    source: FloatArray, target: FloatArray, *, with_scale: bool = False,
) -> Similarity:
    """
    Return the rigid motion, or similarity, that aligns points with others by least squares.

    All points have the same weight. If they do not determine the angle, it is 0; if they do not
    determine the scale, that is 1.

    Parameters
    ----------
    source, target : ndarray, shape (N, 2)
        Corresponding points [m].
    with_scale : bool, whether the scale may differ from 1; it is 1 otherwise

    Raises
    ------
    ValueError
        If there is no point or the shapes differ.

    """
    if source.shape != target.shape or source.ndim != 2 or len(source) == 0:
        raise ValueError(
            f'expected equally many points (N, 2), N > 0, got {source.shape} and {target.shape}')
    source_mean, target_mean = np.mean(source, axis=0), np.mean(target, axis=0)
    p, q = source - source_mean, target - target_mean
    cross = np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    dot, spread = np.sum(p * q), np.sum(p * p)
    theta = np.arctan2(cross, dot)
    scale = float(np.hypot(cross, dot) / spread) if with_scale and spread > 0.0 else 1.0
    if scale == 0.0:
        scale = 1.0
    shift = target_mean - scale * se2.rotation(theta) @ source_mean
    return Similarity(se2.wrapped(np.append(shift, theta)), scale)
