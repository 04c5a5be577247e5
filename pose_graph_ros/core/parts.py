# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the engine is made of, and the way from there to a saved graph and back.

The graph is saved with the odometry samples next to the hidden nodes and those of the last minute.
If odometry continues without interruption, later estimates are therefore the same as without
saving. Measurements that wait for odometry are not saved; they can be sent again.
"""

from typing import NamedTuple

from pose_graph_ros.core.alignment import Alignment
from pose_graph_ros.core.exceptions import FileFormatError, NothingToSaveError
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.io.saved_graph import SavedGraph
from pose_graph_ros.core.judgement.judge import Judge
from pose_graph_ros.core.judgement.texts import is_notable, sentence
from pose_graph_ros.core.judgement.verdicts import Judged
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.saved_columns import MISMATCHES
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.pipeline import MeasurementPipeline
from pose_graph_ros.core.sources.queued import Queued, SavedQueue

# Of each source, the number of believed closures whose verdicts are saved as sentences.
MOST_BELIEVED = 2000


class Parts(NamedTuple):
    """Parts of the engine."""

    graph: Graph
    nodes: HiddenNodes
    factors: FactorBuilder
    reweighting: Reweighting
    alignment: Alignment
    pipeline: MeasurementPipeline
    quarantine: list[Queued]
    """Constraints that were set aside after a failed update."""
    judge: Judge
    smoother: IncrementalSmoother


def capture(
    parts: Parts, newest_covariance: FloatArray, chi2: float, datum: MapOrigin | None,
) -> SavedGraph:
    """
    Return the state of an engine as a value; NothingToSaveError if there is no hidden node.

    Measurements that wait for odometry are left out and do not count as seen. The covariance is
    that of the newest hidden node, in map axes.
    """
    if len(parts.nodes) == 0:
        raise NothingToSaveError('there is no hidden node yet, and so no graph to save')
    left_out = [*(each[1:] for each in parts.pipeline.waiting),
                *parts.pipeline.beacons.measurements]
    return SavedGraph(
        rows=parts.graph.rows(), nodes=parts.nodes.saved(), sources=parts.factors.saved(),
        seen=parts.pipeline.seen.saved(left_out),
        losses=parts.reweighting.saved(), alignment=parts.alignment.saved(),
        waiting=SavedQueue.of(parts.pipeline.queue),
        set_aside=SavedQueue.of(parts.quarantine), judgement=parts.judge.saved(),
        verdicts={each.id: sentence(each) for each in parts.judge.verdicts(MOST_BELIEVED)
                  if each.kind is Judged.LOOP_CLOSURE or is_notable(each)},
        newest_covariance=newest_covariance.copy(), chi2=chi2, n_left_out=len(left_out),
        datum=datum, gyros=parts.pipeline.gyros.saved(),
        beacons=dict(parts.pipeline.beacons.ids))


def restore(parts: Parts, saved: SavedGraph) -> None:
    """
    Fill the parts of a new engine from a saved graph.

    Poses and weights equal the saved ones bit for bit. Whether odometry continues where it was
    saved is decided at its first sample; see `odometry.stream`. Raises FileFormatError where the
    parts of the saved graph contradict each other.
    """
    try:
        parts.graph.fill(saved.rows)
        parts.nodes.restore(saved.nodes)
        parts.pipeline.seen.restore(saved.seen)
        parts.factors.restore(saved.sources)
        for name, gyro in saved.gyros.items():
            parts.pipeline.gyros.stream(name).restore(gyro)
        parts.pipeline.beacons.ids |= saved.beacons
        parts.reweighting.restore(saved.losses)
        parts.alignment.load(saved.alignment)
        parts.judge.restore(saved.judgement, int(parts.nodes.stamps_ns[-1]))
        parts.pipeline.queue += saved.waiting.queue()
        parts.quarantine.extend(saved.set_aside.queue())
    except MISMATCHES as error:
        raise FileFormatError(f'the parts of the saved graph do not fit: {error}') from error
