# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From the parts of the engine to a saved graph, and back.

What has joined the graph is saved, with the odometry samples next to the hidden nodes and those of
the last seconds: odometry that goes on where it was goes on as if nothing had happened. What
waits for odometry or for the alignment is left out, and can be sent again.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.aligning import Aligning
from pose_graph_ros.core.arrivals import Arrivals
from pose_graph_ros.core.constraints import Edges, full, upper
from pose_graph_ros.core.exceptions import NothingToSaveError
from pose_graph_ros.core.graph import Graph
from pose_graph_ros.core.hidden_nodes import HiddenNodes
from pose_graph_ros.core.joining import Joining, Queue, SavedEdges, SavedSource
from pose_graph_ros.core.reweighing import Reweighing
from pose_graph_ros.core.saved_columns import as_matrix
from pose_graph_ros.core.saved_graph import SavedGraph
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.tangent_plane import MapOrigin

_NONE: IntArray = np.empty(0, dtype=np.int64)
_NOT_JOINED = SavedSource(_NONE, _NONE, _NONE.reshape(0, 2), 0, _NONE, None)


class Parts(NamedTuple):
    """Of the engine: those that hold what is saved, and what is left out."""

    graph: Graph
    nodes: HiddenNodes
    joins: Joining
    reweighing: Reweighing
    aligning: Aligning
    arrivals: Arrivals
    quarantine: Queue


def capture(
    parts: Parts, newest_covariance: FloatArray, chi2: float, datum: MapOrigin | None,
) -> SavedGraph:
    """
    Return all that has joined the graph, and change nothing.

    Measurements that wait are left out; they do not count as seen. Edges that are bound but have
    not joined yet are saved.

    Raises
    ------
    NothingToSaveError
        If there is no hidden node.

    """
    if len(parts.nodes) == 0:
        raise NothingToSaveError('there is no hidden node yet, and so no graph to save')
    bound = parts.arrivals.queue.observed + parts.quarantine.observed
    left_out = parts.arrivals.pending.measurements + [
        (each.source, each.measurement) for each in bound]
    seen, joined = parts.arrivals.seen.saved(left_out), parts.joins.saved()
    sources = dict(joined)
    for name, (stamps, references) in seen.items():
        sources[name] = replace(
            joined.get(name, _NOT_JOINED), seen_ns=stamps, seen_references=references)
    edge_losses, observed_losses = parts.reweighing.saved()
    return SavedGraph(
        rows=parts.graph.rows(), nodes=parts.nodes.saved(), sources=sources,
        edge_losses=edge_losses, observed_losses=observed_losses,
        alignment=parts.aligning.saved(), waiting=_saved_edges(parts.arrivals.queue),
        set_aside=_saved_edges(parts.quarantine), newest_covariance=as_matrix(newest_covariance),
        chi2=chi2, n_left_out=len(left_out), datum=datum)


def restore(parts: Parts, saved: SavedGraph) -> None:
    """
    Fill the parts of an engine that has heard nothing yet.

    Poses and weights are those that were saved, to the bit. Where odometry goes on is found out
    when it comes: see `odometry_stream`.

    Raises
    ------
    GraphUpdateError
        If the rows of the graph are not sound.

    """
    parts.graph.fill(saved.rows)
    parts.nodes.restore(saved.nodes)
    for name, source in saved.sources.items():
        parts.arrivals.seen.restore(name, source.seen_ns, source.seen_references)
        parts.joins.restore(name, source)
    parts.joins.count_bias_edges(parts.graph)
    parts.reweighing.restore(saved.edge_losses, saved.observed_losses)
    parts.aligning.load(saved.alignment)
    for queue, edges in (
            (parts.arrivals.queue, saved.waiting), (parts.quarantine, saved.set_aside)):
        table = Edges(edges.i, edges.j, edges.mean, full(edges.information), edges.kind)
        queue.edges += [(name, table.rows(slice(k, k + 1)))
                        for k, name in enumerate(edges.sources)]


def _saved_edges(queue: Queue) -> SavedEdges:
    table = Edges.joined([edge for _, edge in queue.edges])
    return SavedEdges(tuple(name for name, _ in queue.edges), table.i, table.j, table.mean,
                      upper(table.information), table.kind.astype(np.int64))
