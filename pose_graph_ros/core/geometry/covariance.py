# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Covariances of planar poses: check, rotate, invert, propagate.

A covariance of a pose has the order (x, y, theta); docs/conventions.md defines its axes.
"""

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray

# Variance of a heading that is uniform on the circle [rad^2]; a heading with a larger variance
# contains no information.
UNKNOWN_HEADING_VARIANCE = np.pi**2 / 3.0
# Largest variance of a position that contains information [m^2]: beyond the size of the Earth.
LARGEST_VARIANCE = 1e15


def defect(covariance: FloatArray) -> str | None:
    """
    Return why a matrix, shape (d, d), is not a valid covariance; None if it is one.

    The reasons are `not_finite`, `not_positive`, `too_large`, `not_symmetric` and
    `not_positive_definite`.
    """
    if not np.all(np.isfinite(covariance)):
        return 'not_finite'
    diagonal = np.diagonal(covariance)
    if np.any(diagonal <= 0.0):
        return 'not_positive'
    if np.any(diagonal > LARGEST_VARIANCE):
        return 'too_large'
    correlation = scaled(covariance)
    if np.any(np.abs(correlation - correlation.T) > 1e-6):
        return 'not_symmetric'
    if np.min(np.linalg.eigvalsh(correlation)) < 1e-9:
        return 'not_positive_definite'
    return None


def scaled(matrix: FloatArray) -> FloatArray:
    """Return matrices, shape (..., d, d), with 1 in place of each positive diagonal number."""
    diagonal = np.diagonal(matrix, axis1=-2, axis2=-1)
    root = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    with np.errstate(over='ignore'):
        divided = matrix / root[..., :, None] / root[..., None, :]
    # correlations beyond 1 are invalid however large they are, and might overflow
    return np.clip(divided, -2.0, 2.0)


def floored(covariance: FloatArray, floors: FloatArray) -> FloatArray:
    """
    Return a symmetric covariance whose variances are raised to the floors.

    Only the diagonal is changed, and only upwards, so the matrix stays positive definite.
    """
    covariance = 0.5 * (covariance + covariance.T)
    missing = np.maximum(floors - np.diagonal(covariance), 0.0)
    return covariance + np.diag(missing)


def turned(covariance: FloatArray, theta: npt.ArrayLike) -> FloatArray:
    """
    Return covariances, shape (..., 2, 2) or (..., 3, 3), in axes that are rotated by theta (...).

    With the heading of a measured pose as theta, it converts from the axes of the parent frame, as
    in ROS messages, to the frame of the measured pose, as in the errors (3.48) and (3.52) of
    Merfels. Footnote 4 there is the inverse conversion.
    """
    axes = np.zeros(covariance.shape)
    axes[..., -1, -1], axes[..., :2, :2] = 1.0, se2.rotation(theta)
    return np.asarray(np.swapaxes(axes, -1, -2) @ covariance @ axes)


def information(covariance: FloatArray) -> FloatArray:
    """Return the symmetric inverse of a covariance that is valid by `defect`."""
    inverse = np.linalg.inv(covariance)
    return 0.5 * (inverse + inverse.T)


def propagated(pose: FloatArray, covariance: FloatArray, increment: FloatArray,
               noise: FloatArray) -> FloatArray:
    """
    Return the covariance of `compose(pose, increment)` in map axes.

    That of the pose is in map axes, the noise of the increment in the frame at its end.
    """
    end = se2.compose(pose, increment)
    jacobian = np.eye(3)
    jacobian[0, 2] = -(end[1] - pose[1])
    jacobian[1, 2] = end[0] - pose[0]
    result = jacobian @ covariance @ jacobian.T + turned(noise, -float(end[2]))
    return 0.5 * (result + result.T)
