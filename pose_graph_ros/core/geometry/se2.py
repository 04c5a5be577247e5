# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Planar poses as arrays.

A pose is `(x, y, theta)` [m, m, rad] along the last axis; every function takes any leading shape
and broadcasts like NumPy. `T_a_b` is the pose of frame b in frame a, so that
`compose(T_a_b, T_b_c) == T_a_c`. All functions return angles in [-pi, pi).

Identities: `compose(a, inverse(a)) == 0`; `between(a, compose(a, d)) == d`; `compose` is
associative; `transform(a, p)` is the translation of `compose(a, (p, 0))`.
"""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
ComplexArray = npt.NDArray[np.complex128]

TWO_PI = 2.0 * np.pi


def wrap(angle: npt.ArrayLike) -> FloatArray:
    """
    Wrap angles to the half-open interval [-pi, pi).

    Angles inside the interval are returned unchanged, bit for bit.
    """
    angle = np.asarray(angle, dtype=np.float64)
    wrapped = np.mod(angle + np.pi, TWO_PI) - np.pi
    # mod may round up to 2 pi for a tiny negative argument
    wrapped = np.where(wrapped >= np.pi, -np.pi, wrapped)
    return np.where((angle >= -np.pi) & (angle < np.pi), angle, wrapped)


def wrapped(pose: FloatArray) -> FloatArray:
    """Return a copy of the poses, shape (..., 3), with theta in [-pi, pi)."""
    pose = np.array(pose, dtype=np.float64)
    pose[..., 2] = wrap(pose[..., 2])
    return pose


def rotation(theta: npt.ArrayLike) -> FloatArray:
    """Return rotation matrices, shape (..., 2, 2), Merfels eq. (3.47)."""
    theta = np.asarray(theta, dtype=np.float64)
    matrix = np.empty((*theta.shape, 2, 2))
    matrix[..., 0, 0] = matrix[..., 1, 1] = np.cos(theta)
    matrix[..., 1, 0] = np.sin(theta)
    matrix[..., 0, 1] = -matrix[..., 1, 0]
    return matrix


def transform(pose: FloatArray, point: FloatArray) -> FloatArray:
    """
    Return points in the frame w, shape (..., 2) [m].

    Parameters
    ----------
    pose : ndarray, shape (..., 3), `T_w_a`
    point : ndarray, shape (..., 2), in frame a [m]

    """
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y = point[..., 0], point[..., 1]
    return np.stack((pose[..., 0] + c * x - s * y, pose[..., 1] + s * x + c * y), axis=-1)


def compose(a: FloatArray, b: FloatArray) -> FloatArray:
    """
    Return `T_a_c`, shape (..., 3).

    Parameters
    ----------
    a, b : ndarray, shape (..., 3), `T_a_b` and `T_b_c`

    """
    position = transform(a, b[..., :2])
    theta = wrap(a[..., 2] + b[..., 2])
    return np.concatenate((position, theta[..., None]), axis=-1)


def inverse(a: FloatArray) -> FloatArray:
    """Return `T_b_a` from `T_a_b`, shape (..., 3)."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x, y = a[..., 0], a[..., 1]
    return np.stack((-c * x - s * y, s * x - c * y, wrap(-a[..., 2])), axis=-1)


def between(a: FloatArray, b: FloatArray) -> FloatArray:
    """
    Return `T_a_b`, shape (..., 3): the pose of b relative to a.

    Parameters
    ----------
    a, b : ndarray, shape (..., 3), `T_w_a` and `T_w_b`, in the same frame w

    """
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack((c * dx + s * dy, c * dy - s * dx, wrap(b[..., 2] - a[..., 2])), axis=-1)


def interpolate(a: FloatArray, b: FloatArray, fraction: npt.ArrayLike) -> FloatArray:
    """
    Return poses between a and b, with linear positions and headings along the shorter arc.

    Parameters
    ----------
    a, b : ndarray, shape (..., 3)
    fraction : array_like, shape (...), 0 gives a; 1 gives b, except for rounding errors

    """
    f = np.asarray(fraction, dtype=np.float64)[..., None]
    difference = b - a
    difference[..., 2] = wrap(difference[..., 2])
    return wrapped(a + f * difference)


def adjoint(a: FloatArray) -> FloatArray:
    """
    Return the adjoint matrices Ad of poses, shape (..., 3, 3).

    They satisfy `a * exp(xi) * a^-1 = exp(Ad_a xi)`. `Ad C Ad^T` is the covariance C of a small
    motion, converted from the frame at the end of `a` to the frame at its beginning.
    """
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    matrix = np.zeros((*a.shape[:-1], 3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = c
    matrix[..., 0, 1], matrix[..., 1, 0] = -s, s
    matrix[..., 0, 2], matrix[..., 1, 2] = a[..., 1], -a[..., 0]
    matrix[..., 2, 2] = 1.0
    return matrix
