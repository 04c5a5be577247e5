# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Outputs of the engine, as immutable values."""

from dataclasses import dataclass, replace

from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import OdometrySource
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.odometry.odometry_errors import AS_CLAIMED, OdometryErrors


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """Result of an update or of an optimisation."""

    status: Status
    reason: str
    """Why it failed; empty if it did not."""
    new_constraints: int
    """Number of constraints that were added to the graph."""
    iterations: int
    chi2: float
    relinearized: int = 0
    """Number of constraints that the smoother linearised again."""
    eliminated: int = 0
    """Number of hidden nodes that it eliminated again."""
    visited: int = 0
    """Number of cliques of hidden nodes that it solved for again."""

    def before(self, again: 'UpdateReport') -> 'UpdateReport':
        """Return one report of this update and the one after it; only the last may have failed."""
        return replace(again, new_constraints=self.new_constraints + again.new_constraints)

    def after(self, solved: 'UpdateReport') -> 'UpdateReport':
        """Return one report of this update and the optimisation of the whole graph after it."""
        failed = next((part for part in (self, solved) if part.status is Status.FAILED), solved)
        return replace(
            self, status=failed.status, reason=failed.reason,
            iterations=self.iterations + solved.iterations, chi2=solved.chi2)


@dataclass(frozen=True, slots=True)
class Estimate:
    """An estimate for publishing; its arrays are read-only."""

    stamp_ns: int
    """Stamp of the newest odometry [ns]."""
    T_odom_base: FloatArray
    """Newest odometry, shape (3,) [m, m, rad]."""
    T_map_base: FloatArray
    """Estimate at the newest odometry, shape (3,) [m, m, rad]."""
    T_map_odom: FloatArray
    """Pose of the odometry frame in the map, shape (3,) [m, m, rad]."""
    covariance: FloatArray
    """Of `T_map_base`, in map axes, shape (3, 3)."""
    alignment: AlignmentState
    alignment_sigma: float
    """Of the angle between odometry and map [rad]; infinite if it is unknown."""
    chi2: float
    n_hidden: int
    """Hidden nodes of the path."""
    n_edges: int
    """Edges between hidden nodes."""
    n_observed: int
    """Observed nodes, including measurements with a bias."""
    n_biases: int
    """Hidden nodes that are biases: states of time-correlated errors."""
    primary: str
    """Source of the odometry in `T_odom_base`."""
    odometry: OdometrySource
    """Settings of that source."""
    odometry_errors: OdometryErrors = AS_CLAIMED
    """Errors of the primary odometry that the graph knows of."""
    n_frozen: int = 0
    """How many of the hidden nodes have left the graph; their poses do not change any more."""
    n_thinned: int = 0
    """How many of the others have left it; their poses move with those of nodes that stay."""
    n_priors: int = 0
    """Priors that stand for frozen nodes in the graph."""
    trajectory: Trajectory | None = None
    """The value of `path`; None if the estimate was made without it."""

    @property
    def path(self) -> Trajectory:
        """`T_map_base` at all hidden nodes, last at the newest odometry; ValueError without it."""
        if self.trajectory is None:
            raise ValueError('the estimate was made without its path')
        return self.trajectory

    def __post_init__(self) -> None:
        for array in (self.T_odom_base, self.T_map_base, self.T_map_odom, self.covariance):
            array.flags.writeable = False
