# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Decision when to align the graph with the map, and when to correct that."""

from dataclasses import dataclass
from enum import Enum
import math

import numpy as np

from pose_graph_ros.core.alignment import estimator
from pose_graph_ros.core.alignment.consensus import Given, TUNED
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.sources.queued import Queued, SavedQueue


class AlignmentState(Enum):
    """Whether the pose of the odometry frame in the map is known."""

    LOCAL = 'local'  # no positions in the map yet: the map is the odometry frame of the start
    # there are positions, but the angle between odometry and map is not known yet
    UNALIGNED = 'unaligned'
    ALIGNED = 'aligned'  # the graph lies in the map


@dataclass(frozen=True, slots=True)
class SavedAlignment:
    """Saved state of the alignment, and the M measurements for the next check."""

    state: str
    sigma: float | None  # standard deviation of the angle [rad]; None for infinite
    next_verdict: int  # number of measurements at which the angle is checked next
    evidence: SavedQueue


class AlignmentMonitor:
    """
    Aligns the graph with the map as soon as measurements determine the angle of odometry in it.

    Whenever the number of measurements has doubled, the angle is checked with all of them, as the
    first few may be wrong.
    """

    def __init__(self, config: BackendConfig) -> None:
        self._config = config
        self.state = AlignmentState.LOCAL
        self.sigma = np.inf  # standard deviation of the angle when it was found [rad]
        self._evidence: list[Queued] = []
        self._next_recheck = TUNED.first_recheck

    def configure(self, config: BackendConfig) -> None:
        """Set the settings for checks from now on, which use all measurements so far."""
        self._config = config

    def find(self, graph: Graph, waiting: list[Queued], nodes: HiddenNodes) -> FloatArray | None:
        """
        Return the motion of the graph into the map if it is found, and update the state.

        It has the shape (3,), and is None if the graph is aligned already, or the angle is not
        known well enough.
        """
        waiting = [each for each in waiting if each.is_in_map]
        if self.state is AlignmentState.ALIGNED or not any(each.is_placed for each in waiting):
            return None
        found = estimator.find_alignment(nodes.recent_poses(graph), self._given(nodes, waiting))
        self.state = (AlignmentState.UNALIGNED if found.T_map_graph is None
                      else AlignmentState.ALIGNED)
        self.sigma = found.sigma
        return found.T_map_graph

    def add(self, added: list[Queued]) -> None:
        """Store the measurements that were added to the graph for the next check."""
        if self._next_recheck <= TUNED.last_recheck:
            self._evidence += [each for each in added if each.is_placed]

    def stop_rechecking(self) -> None:
        """Stop checking the angle, because the path is not that of odometry any more."""
        self._evidence.clear()
        self._next_recheck = TUNED.last_recheck + 1

    def forget(self, node: int) -> None:
        """Drop the stored measurements on hidden nodes before one, by its id."""
        self._evidence = [each for each in self._evidence if each.factor.i[0] >= node]

    def recheck(self, graph: Graph, nodes: HiddenNodes) -> FloatArray | None:
        """
        Return new poses of all rows of the graph if the angle in use is wrong.

        The check is only made when the number of measurements has doubled since the last one. The
        poses are those of odometry, moved into the map, shape (N, 3), with biases of 0; None if
        the angle is not checked or not wrong.
        """
        if self.state is not AlignmentState.ALIGNED or len(self._evidence) < self._next_recheck:
            return None
        self._next_recheck = 2 * len(self._evidence)
        rows = graph.node_rows(nodes.ids[nodes.n_frozen:])
        found = estimator.recheck(nodes.recent_poses(graph), nodes.odometry,
                                  self._given(nodes, self._evidence), self.sigma)
        if self._next_recheck > TUNED.last_recheck:
            self._evidence.clear()
        if found is None or found.T_map_graph is None:
            return None
        self.sigma = found.sigma
        moved = se2.compose(found.T_map_graph, nodes.odometry)
        # what is no hidden node of the path any more keeps its place beside the oldest one
        kept = rows >= 0
        moved, rows = moved[kept], rows[kept]
        poses = se2.compose(moved[0], se2.between(graph.poses[rows[0]], graph.poses))
        poses[graph.is_bias] = 0.0
        poses[rows] = moved
        return poses

    def _given(self, nodes: HiddenNodes, evidence: list[Queued]) -> Given:
        """Return measurements by rows of `HiddenNodes.recent_poses`, and what is assumed."""
        ids = nodes.ids[nodes.n_frozen:]    # which has no biases
        observed = Factors.joined([each.factor for each in evidence]).renumbered(
            lambda some: np.searchsorted(ids, some))
        # the noise that odometry has at least, constant errors included
        scale = math.sqrt(max(nodes.errors.way, nodes.errors.turn, 1.0))
        noise = nodes.streams[nodes.primary].usual_noise().scaled(scale)
        # a time that is not known yet counts as white noise
        times = {name: max(source.correlation_time, 0.0)
                 for name, source in self._config.measurements.items()}
        return Given(
            observed, np.array([each.stamp_ns for each in evidence]) * 1e-9,
            np.array([times.get(each.source, 0.0) for each in evidence]),
            self._config.alignment, noise)

    @property
    def is_aligned(self) -> bool:
        """Whether the graph lies in the map."""
        return self.state is AlignmentState.ALIGNED

    def saved(self) -> SavedAlignment:
        """Return the state and the stored measurements."""
        return SavedAlignment(
            self.state.value, float(self.sigma) if np.isfinite(self.sigma) else None,
            self._next_recheck, SavedQueue.of(self._evidence))

    def load(self, saved: SavedAlignment) -> None:
        """Set state and measurements to saved ones."""
        self.state = AlignmentState(saved.state)
        self.sigma = np.inf if saved.sigma is None else saved.sigma
        self._next_recheck = saved.next_verdict
        self._evidence = saved.evidence.queue()
