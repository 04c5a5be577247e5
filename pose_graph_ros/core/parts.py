# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the engine is made of, and the way from there to a saved graph and back.

The graph is saved with the odometry samples next to the hidden nodes and those of the last minute.
If odometry continues without interruption, later estimates are therefore the same as without
saving. Measurements that wait for odometry or for the alignment are not saved; they can be sent
again.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.alignment.monitor import AlignmentMonitor
from pose_graph_ros.core.exceptions import FileFormatError, NothingToSaveError
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors, full, upper
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.io.saved_graph import SavedGraph
from pose_graph_ros.core.judgement.judge import Judge
from pose_graph_ros.core.judgement.texts import is_notable, sentence
from pose_graph_ros.core.judgement.verdicts import Judged
from pose_graph_ros.core.measurements import LoopClosure, Range
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.saved_columns import as_matrix, MISMATCHES
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.pipeline import MeasurementPipeline
from pose_graph_ros.core.sources.source_constraints import (
    Queue,
    QueuedEdge,
    SavedEdges,
    SavedSource,
)

_NONE: IntArray = np.empty(0, dtype=np.int64)
# Of each source, the number of believed closures whose verdicts are saved as sentences.
MOST_BELIEVED = 2000
_NO_CONSTRAINTS = SavedSource(_NONE, _NONE, _NONE.reshape(0, 2), 0, _NONE, None)


class Parts(NamedTuple):
    """Parts of the engine."""

    graph: Graph
    nodes: HiddenNodes
    factors: FactorBuilder
    reweighting: Reweighting
    alignment: AlignmentMonitor
    pipeline: MeasurementPipeline
    quarantine: Queue
    """Constraints that were set aside after a failed update."""
    judge: Judge
    smoother: IncrementalSmoother


def capture(
    parts: Parts, newest_covariance: FloatArray, chi2: float, datum: MapOrigin | None,
) -> SavedGraph:
    """
    Return the state of an engine as a value; NothingToSaveError if there is no hidden node.

    Measurements that wait are left out and do not count as seen. Edges in the queue for the next
    update are saved. The covariance is that of the newest hidden node, in map axes.
    """
    if len(parts.nodes) == 0:
        raise NothingToSaveError('there is no hidden node yet, and so no graph to save')
    attached = parts.pipeline.queue.observed + parts.quarantine.observed
    left_out = (parts.pipeline.waiting.measurements + parts.pipeline.beacons.measurements
                + [(each.source, each.measurement) for each in attached])
    seen, added = parts.pipeline.seen.saved(left_out), parts.factors.saved()
    sources = dict(added)
    for name, (stamps, references) in seen.items():
        sources[name] = replace(
            added.get(name, _NO_CONSTRAINTS), seen_ns=stamps, seen_references=references)
    return SavedGraph(
        rows=parts.graph.rows(), nodes=parts.nodes.saved(), sources=sources,
        losses=parts.reweighting.saved(), alignment=parts.alignment.saved(),
        waiting=_saved_edges(parts.pipeline.queue),
        set_aside=_saved_edges(parts.quarantine), judgement=parts.judge.saved(),
        verdicts={each.id: sentence(each) for each in parts.judge.verdicts(MOST_BELIEVED)
                  if each.kind is Judged.LOOP_CLOSURE or is_notable(each)},
        newest_covariance=as_matrix(newest_covariance), chi2=chi2, n_left_out=len(left_out),
        datum=datum, gyros=parts.pipeline.gyros.saved(
            parts.pipeline.queue.turns + parts.quarantine.turns),
        gyro_biases={
            name: bias.saved() for name, bias in parts.factors.gyros.items()},
        beacons=dict(parts.pipeline.beacons.ids))


def restore(parts: Parts, saved: SavedGraph) -> None:
    """
    Fill the parts of a new engine from a saved graph.

    Poses and weights equal the saved ones bit for bit. Whether odometry continues where it was
    saved is decided at its first sample; see `odometry.stream`. Raises FileFormatError where the
    parts of the saved graph contradict each other.
    """
    try:
        _restore(parts, saved)
    except MISMATCHES as error:
        raise FileFormatError(f'the parts of the saved graph do not fit: {error}') from error


def _restore(parts: Parts, saved: SavedGraph) -> None:
    parts.graph.fill(saved.rows)
    parts.nodes.restore(saved.nodes)
    for name, source in saved.sources.items():
        parts.pipeline.seen.restore(name, source.seen_ns, source.seen_references)
        parts.factors.restore(name, source)
    for name, gyro in saved.gyros.items():
        parts.pipeline.gyros.restore(name, gyro)
        parts.pipeline.queue.turns += gyro.waiting
    for name, bias in saved.gyro_biases.items():
        parts.factors.gyro_bias(name).restore(bias)
    parts.pipeline.beacons.ids |= saved.beacons
    parts.reweighting.restore(saved.losses)
    parts.alignment.load(saved.alignment)
    parts.judge.restore(saved.judgement, int(parts.nodes.stamps_ns[-1]))
    for queue, edges in (
            (parts.pipeline.queue, saved.waiting), (parts.quarantine, saved.set_aside)):
        table = Factors(edges.i, edges.j, edges.mean, full(edges.information), edges.kind,
                        constants=edges.constants if len(edges.constants) > 0 else None)
        queue.edges += [
            QueuedEdge(name, table.rows(slice(k, k + 1)), stamp_ns, reference_ns, kind=(
                Range if table.kind[k] == FactorKind.RANGE else LoopClosure))
            for k, (name, (stamp_ns, reference_ns)) in enumerate(zip(
                edges.sources, edges.stamps_ns.tolist(), strict=True))]


def _saved_edges(queue: Queue) -> SavedEdges:
    table = Factors.joined([queued.edge for queued in queue.edges])
    stamps = np.array([(queued.stamp_ns, queued.reference_ns) for queued in queue.edges],
                      dtype=np.int64).reshape(-1, 2)
    return SavedEdges(tuple(queued.source for queued in queue.edges), table.i, table.j,
                      table.mean, upper(table.information), table.kind.astype(np.int64), stamps,
                      table.constants)
