# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The whole state of an engine as a value, for files.

`core.parts` makes it from the parts of the engine and restores them from it; `graph_files` writes
and reads it. Settings are not part of it: a loaded graph has those of the engine that loads it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pose_graph_ros.core.alignment import AlignmentState, SavedAlignment
from pose_graph_ros.core.geometry.geodesy import distances, MapOrigin, TangentPlane
from pose_graph_ros.core.geometry.se2 import FloatArray, wrap
from pose_graph_ros.core.graph.graph import GraphRows
from pose_graph_ros.core.graph.reweighting import SavedLosses
from pose_graph_ros.core.judgement.judge import SavedJudgement
from pose_graph_ros.core.odometry.gyro import SavedGyro
from pose_graph_ros.core.odometry.node_table import SavedNodes
from pose_graph_ros.core.saved_columns import Rows3
from pose_graph_ros.core.sources.factor_builder import SourceState
from pose_graph_ros.core.sources.pipeline import SavedStamps
from pose_graph_ros.core.sources.queued import SavedQueue

# Tolerances within which a datum equals that of the saved graph [m], [rad].
SAME_PLACE = 0.01
SAME_YAW = 1e-6
# Maximum distance of a fix from the nearest node of a saved graph of the same site [m].
SAME_SITE = 10_000.0


@dataclass(frozen=True, slots=True)
class SavedGraph:
    """The state of an engine; a copy that does not change with it."""

    rows: GraphRows
    nodes: SavedNodes
    sources: Mapping[str, SourceState]
    seen: Mapping[str, SavedStamps]
    losses: SavedLosses
    alignment: SavedAlignment
    waiting: SavedQueue  # constraints for the next update
    set_aside: SavedQueue  # after a failed solve, for the next full optimisation
    judgement: SavedJudgement  # what is believed, and who has decided so
    # the same for people, of all closures and all that is not believed: a sentence by id
    verdicts: Mapping[str, str]
    newest_covariance: Rows3  # of the newest hidden node, in map axes
    chi2: float
    n_left_out: int  # received measurements that are neither in the graph nor saved
    datum: MapOrigin | None  # of the map, if it has one
    gyros: Mapping[str, SavedGyro] = field(default_factory=dict)
    beacons: Mapping[str, int] = field(default_factory=dict)  # ids of their landmarks, by name

    @property
    def path(self) -> FloatArray:
        """Poses of all nodes that are no biases, those that have left included, shape (H, 3)."""
        return self.nodes.poses(self.rows.node_ids, self.rows.poses)


def site_refusal(
    saved: SavedGraph, datum: MapOrigin | None = None, fix: MapOrigin | None = None,
) -> str | None:
    """
    Return why a saved graph cannot belong to the site of the robot; None if it can.

    A datum that the user has set must equal that of the saved graph, except for the altitude. A
    fix, the one that the current datum comes from or any other, must be near the saved graph.
    """
    if saved.datum is None:
        return None
    if datum is not None and (refusal := datum_refusal(saved.datum, datum)) is not None:
        return refusal
    if fix is not None:
        # of the datum or the nearest node, whichever is nearer
        metres = float(distances(fix, saved.datum.latitude, saved.datum.longitude)[0])
        if saved.alignment.state == AlignmentState.ALIGNED.value:   # the nodes are in the map
            points = TangentPlane(*saved.datum).to_geodetic(saved.path[:, :2])
            metres = min(metres, float(np.min(distances(fix, points[:, 0], points[:, 1]))))
        if not metres <= SAME_SITE:
            return (f'the saved graph is of another site: its datum is {saved.datum}, the present '
                    f'one {fix}, which is {metres / 1000.0:.1f} km from the nearest node')
    return None


def datum_refusal(saved: MapOrigin, datum: MapOrigin) -> str | None:
    """Return why the datum of a saved graph is not the one that was set; None if it is."""
    metres = float(distances(saved, datum.latitude, datum.longitude)[0])
    turned = abs(wrap(datum.yaw - saved.yaw))
    if metres <= SAME_PLACE and turned <= SAME_YAW:
        return None
    return (f'the saved graph is of another site: its datum is {saved}, the present one {datum}; '
            f'they are {metres:.2f} m and {turned:.6f} rad apart')
