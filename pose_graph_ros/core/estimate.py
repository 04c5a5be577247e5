# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the engine hands out: snapshots that do not change later."""

from dataclasses import dataclass, replace
from enum import Enum

from pose_graph_ros.core.batch import Status
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.sources import OdometryNoise
from pose_graph_ros.core.trajectory import Trajectory


class AlignmentState(Enum):
    """What is known of the odometry frame in the map."""

    LOCAL = 'local'
    """Nothing was measured in the map: the map is the odometry frame of the start."""
    UNALIGNED = 'unaligned'
    """Positions are known, the angle between odometry and map is not yet."""
    ALIGNED = 'aligned'


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """What an update did."""

    status: Status
    reason: str
    """Why it failed, else empty."""
    new_constraints: int
    """Loop closures and observed nodes that joined the graph."""
    iterations: int
    chi2: float
    relinearized: int = 0
    """Constraints that the smoother linearized again."""
    eliminated: int = 0
    """Hidden nodes that it eliminated again."""
    visited: int = 0
    """Cliques of hidden nodes that it solved for again."""

    def after(self, solved: 'UpdateReport') -> 'UpdateReport':
        """Return the report of this update and of the optimisation of the whole after it."""
        failed = next((part for part in (self, solved) if part.status is Status.FAILED), solved)
        return replace(
            self, status=failed.status, reason=failed.reason,
            iterations=self.iterations + solved.iterations, chi2=solved.chi2)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A snapshot for publishing; nothing in it changes later."""

    stamp_ns: int
    """Of the newest odometry [ns]."""
    T_odom_base: FloatArray
    """Newest odometry, shape (3,)."""
    T_map_base: FloatArray
    """Estimate at the newest odometry, shape (3,)."""
    T_map_odom: FloatArray
    """Pose of the odometry frame in the map, shape (3,): corrects any later odometry."""
    covariance: FloatArray
    """Of `T_map_base`, in map axes, shape (3, 3)."""
    alignment: AlignmentState
    alignment_sigma: float
    """Of the heading between odometry and map [rad], infinite before anything is known of it."""
    chi2: float
    n_hidden: int
    n_edges: int
    """Edges between hidden nodes."""
    n_observed: int
    """Observed nodes, those with an error that lives on included."""
    n_biases: int
    """States of such errors."""
    lead: str
    """Source of the odometry in `T_odom_base`."""
    noise: OdometryNoise
    """Of that odometry."""
    trajectory: Trajectory | None = None
    """What `path` returns."""

    @property
    def path(self) -> Trajectory:
        """
        `T_map_base` at the hidden nodes, and last at the newest odometry.

        Raises
        ------
        ValueError
            If the estimate was made without it.

        """
        if self.trajectory is None:
            raise ValueError('the estimate was made without its path')
        return self.trajectory

    def __post_init__(self) -> None:
        for array in (self.T_odom_base, self.T_map_base, self.T_map_odom, self.covariance):
            array.flags.writeable = False
