# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A trajectory as users have it: poses by stamp, by id or in order, maybe with covariances."""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory


class Key(Enum):
    """What poses of a sequence are found by."""

    STAMP = 'stamp'
    ID = 'id'
    INDEX = 'index'


@dataclass(frozen=True, slots=True)
class PoseSequence:
    """
    Poses at increasing keys; raises ValueError if the shapes do not match.

    A heading that is not known is NaN, a covariance that is not known is anything invalid.
    """

    path: Trajectory
    """Keys (stamps [ns], ids, or indices) and poses `T_map_base`, shape (N, 3) [m, m, rad]."""
    key: Key = Key.STAMP
    covariances: FloatArray | None = None
    """Of the poses, order x, y, theta, in map axes, shape (N, 3, 3); None if there are none."""
    dropped: int = 0
    """Number of poses that were left out, as their key had come before."""

    def __post_init__(self) -> None:
        if self.covariances is not None and self.covariances.shape != (len(self.path), 3, 3):
            raise ValueError(f'expected {len(self.path)} covariances (N, 3, 3), got '
                             f'{self.covariances.shape}')

    def __len__(self) -> int:
        return len(self.path)

    @property
    def keys(self) -> IntArray:
        """Stamps [ns], ids, or indices, shape (N,)."""
        return self.path.stamps_ns

    @property
    def poses(self) -> FloatArray:
        """Poses, shape (N, 3) [m, m, rad]."""
        return self.path.poses


def in_order(
    keys: IntArray, poses: FloatArray, key: Key, covariances: FloatArray | None = None,
) -> PoseSequence:
    """
    Return a sequence of poses in any order; of several with the same key it has the first.

    Parameters
    ----------
    keys : ndarray, shape (N,), stamps [ns], ids, or indices
    poses : ndarray, shape (N, 3) [m, m, rad]
    covariances : ndarray, shape (N, 3, 3), optional

    """
    unique, first = np.unique(keys, return_index=True)
    return PoseSequence(
        Trajectory(unique, poses[first]), key,
        None if covariances is None else covariances[first], len(keys) - len(unique))
