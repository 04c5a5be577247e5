# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The saved state of one source of odometry."""

from dataclasses import dataclass, field

import numpy as np

from pose_graph_ros.core.geometry.scalar_se2 import Pose
from pose_graph_ros.core.saved_columns import Flags, Integers, Rows3, Rows7, Rows8

NO_TWIST: Pose = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class SavedInstant:
    """Saved state of a source at its newest settled sample, see `Row` and `SpeedWindow`."""

    raw: Pose
    """Pose as received [m, m, rad]."""
    offset: Pose | None
    """Pose of the odometry frame in the frame without jumps; None before the first jump."""
    counted: Pose
    counted_ns: int
    held: Pose
    rate: tuple[float, float, float, float, float, float, float] | None
    """Velocity, recent and greatest speeds; None before they are known."""
    since_ns: int
    since: Pose
    way: tuple[float, float]
    """Path length [m] and sum of absolute turns [rad] since then."""
    jumped: bool
    """Whether odometry jumped to this sample."""
    twist: Pose = NO_TWIST
    """As `_Sample.twist`."""


@dataclass(frozen=True, slots=True)
class SavedStream:
    """Saved odometry source: its samples next to the hidden nodes, and its newest ones."""

    stamps_ns: Integers
    """Stamps of settled samples, shape (T,) [ns]."""
    samples: Rows8
    """Their rows, as returned by `OdometryTimeline.thinned`, shape (T, 8)."""
    dense: Flags
    """As `OdometryTimeline.dense`, shape (T,)."""
    resting: bool
    """As `OdometryTimeline.resting`."""
    last: SavedInstant | None
    waiting_ns: Integers
    """Stamps of samples that are not settled, shape (W,) [ns]."""
    waiting: Rows7
    """As received: pose, speed, variances of the twist (zero where unknown), shape (W, 7)."""
    restarted_ns: int
    """As `OdometryStream.restarted_ns`."""
    tied: int
    """Newest node that the samples cover, where the next secondary edge begins; -1 for none."""
    next_to_tie: int
    """Next node to check for a secondary edge."""
    waiting_twists: Rows3 = field(default_factory=lambda: np.empty((0, 3)))
    """Twists of samples that are not settled, shape (W, 3); empty if they are not integrated."""
