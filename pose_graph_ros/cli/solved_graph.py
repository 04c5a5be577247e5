# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A graph from a file before and after its optimisation, for pictures and reports."""

from typing import NamedTuple

from pose_graph_ros.core.batch.levenberg_marquardt import BatchResult
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.constraints import Factors


class SolvedGraph(NamedTuple):
    """N hidden nodes and M constraints, whose ends are rows of the nodes."""

    ids: IntArray  # in the file, increasing
    is_pose: BoolArray  # else a landmark
    is_fixed: BoolArray
    before: Poses
    after: Poses
    factors: Factors
    off: FloatArray  # how far each constraint is off, without its weight if that is 0 [sigma]
    is_odometry: BoolArray  # edges with no id of a pose between their two
    is_doubted: BoolArray
    chi2_before: float
    result: BatchResult

    @property
    def is_closure(self) -> BoolArray:
        """Which constraints are loop closures, or sightings of landmarks."""
        return (self.factors.j >= 0) & ~self.is_odometry
