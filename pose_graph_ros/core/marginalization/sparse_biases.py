# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a dense prior knows of a bias, as a measurement of it by one pose.

Given the displacements h of the pose, those b of the bias have the best linear prediction C h. So
`b - C h` is measured, with the covariance that it has by the prior: by the pose with which that is
smallest. `sparsification` makes it conservative together with all other measurements.
"""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.priors import Prior

# A measurement sees an undetermined direction if it is above this part of its size.
SEEN = 1e-6


class OfBias(NamedTuple):
    """The measurement of a bias that is most certain: its difference from what a pose tells."""

    pose: int
    """Row of the pose."""
    gain: FloatArray
    """What displacements of the pose tell of the bias, shape (3, 3)."""
    rows: FloatArray
    """As of candidates, shape (3, r)."""
    root: FloatArray
    """Shape (3, 3)."""


def of_bias(basis: FloatArray, free: FloatArray, n_poses: int, row: int) -> OfBias:
    """
    Return the measurement `b - gain h` of a bias with the least `log det` of all poses.

    Its gain is such that it sees nothing undetermined.

    Parameters
    ----------
    basis, free : ndarray, shapes (3 k, r) and (3 k, n), as returned by `_basis`
    n_poses : int, number of the first nodes, which are poses
    row : int, of the bias

    """
    at = slice(3 * row, 3 * row + 3)
    used = np.any(basis[at] != 0.0, axis=1)
    own, undetermined = basis[at] * used[:, None], free[at] * used[:, None]
    best, least = None, np.inf
    for pose in range(n_poses):
        rows, of_pose = (each[3 * pose:3 * pose + 3] for each in (basis, free))
        left, values, right = np.linalg.svd(of_pose, full_matrices=True)
        n_seen = np.count_nonzero(values > SEEN * np.max(np.abs(rows), initial=0.0))
        gain = undetermined @ right[:n_seen].T / values[:n_seen] @ left[:, :n_seen].T
        if np.max(np.abs(undetermined - gain @ of_pose), initial=0.0) > SEEN * np.max(
                np.abs(own), initial=0.0):
            continue
        known = left[:, n_seen:].T @ rows
        rest = (own - gain @ rows) @ known.T
        gain = gain + np.linalg.solve(known @ known.T, rest.T).T @ left[:, n_seen:].T
        rows = (own - gain @ rows) * used[:, None]
        covariance = rows @ rows.T + np.diag(~used)
        weight = np.linalg.slogdet(covariance)[1]
        if weight < least:
            least, best = weight, (pose, gain, rows, covariance)
    if best is None:
        raise np.linalg.LinAlgError('a bias is not determined by any pose')
    pose, gain, rows, covariance = best
    inverse = np.linalg.inv(np.linalg.cholesky(covariance))
    return OfBias(pose, gain * used[:, None], inverse @ rows, inverse.T * used[:, None])


def on_bias(
    nodes: IntArray, displaced: tuple[FloatArray, FloatArray], rows: tuple[int, int],
    gain: FloatArray, information: FloatArray,
) -> Prior:
    """
    Return the prior that a measurement of a bias is.

    Parameters
    ----------
    nodes : ndarray of int, shape (k,)
    displaced : tuple of ndarray, reference poses and displacements of the minimum, shapes (k, 3)
    rows : tuple of int, of the pose and the bias
    gain : ndarray, shape (3, 3)
    information : ndarray, shape (3, 3), of `b - gain h`

    """
    poses, delta = displaced
    jacobian, at = np.hstack((-gain, np.eye(3))), np.array(rows)
    whole = jacobian.T @ information @ jacobian
    whole = 0.5 * (whole + whole.T)
    return Prior(nodes[at], poses[at].copy(), whole, whole @ delta[at].ravel(), 0.0, True)
