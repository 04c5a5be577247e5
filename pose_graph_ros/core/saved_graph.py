# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A whole pose graph with all that the engine knows about it, as a value: what files keep.

Each part of the engine gives and takes its own state, a value beside it; `saving` puts them
together, and `io.graph_files` makes text of them. Settings are no part of it: a graph that is
loaded goes on with those of its new owner.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pose_graph_ros.core.aligning import SavedAlignment
from pose_graph_ros.core.constraints import check as check_table, EdgeKind
from pose_graph_ros.core.estimate import AlignmentState
from pose_graph_ros.core.graph import GraphRows
from pose_graph_ros.core.hidden_nodes import SavedNodes
from pose_graph_ros.core.joining import SavedEdges, SavedSource
from pose_graph_ros.core.reweighing import SavedLosses
from pose_graph_ros.core.saved_columns import Matrix
from pose_graph_ros.core.se2 import IntArray
from pose_graph_ros.core.sources import Loss
from pose_graph_ros.core.tangent_plane import distances, MapOrigin, TangentPlane

# A datum that was set is that of the saved graph within these [m, rad].
SAME_PLACE = 0.01
SAME_YAW = 1e-6
# A first fix within this of any node of the saved graph is one of the same site [m].
SAME_SITE = 10_000.0
STATES = tuple(state.value for state in AlignmentState)


@dataclass(frozen=True, slots=True)
class SavedGraph:
    """Everything that has joined a graph; nothing in it changes later."""

    rows: GraphRows
    nodes: SavedNodes
    sources: Mapping[str, SavedSource]
    edge_losses: SavedLosses
    observed_losses: SavedLosses
    alignment: SavedAlignment
    waiting: SavedEdges
    """Those that join at the next update."""
    set_aside: SavedEdges
    """Those that wait for the next full optimisation, as a solve with them has failed."""
    newest_covariance: Matrix
    """Of the newest hidden node, in map axes."""
    chi2: float
    n_left_out: int
    """Measurements that had come but had not joined the graph: they are not saved."""
    datum: MapOrigin | None
    """Of the map; None if there is none."""

    def check(self) -> None:
        """
        Raise ValueError, saying where, unless all sizes, indices and stamps fit each other.

        Raises
        ------
        ValueError
            And its subclass GraphUpdateError, for rows of the graph.

        """
        rows, nodes = self.rows, self.nodes
        for table in (rows.edges, rows.observed):
            if len(table) > 0:
                check_table(table, rows.is_bias)
        sizes = {'nodes': len(rows.poses), 'edges': len(rows.edges),
                 'observed': len(rows.observed)}
        _require(len(nodes.rows) > 0, 'nodes: expected at least one')
        _same_length('nodes', nodes, 'stamps_ns', 'rows', 'odometry')
        _increasing('nodes.stamps_ns', nodes.stamps_ns)
        _increasing('nodes.rows', nodes.rows)
        _inside('nodes.rows', nodes.rows, sizes['nodes'])
        _require(bool(np.all(np.flatnonzero(~rows.is_bias) == nodes.rows))
                 if len(nodes.rows) == np.sum(~rows.is_bias) else False,
                 'nodes.rows: expected all hidden nodes of the graph that are no biases')
        self._check_odometry()
        if self.datum is not None:
            TangentPlane(*self.datum)   # which refuses what is no point on the Earth
        for name, source in self.sources.items():
            self._check_source(f'sources.{name}', source, sizes)
        for name, losses in (('edges', self.edge_losses), ('observed', self.observed_losses)):
            where = f'{name} losses'
            _same_length(where, losses, 'rows', 'losses', 'thresholds', 'shares')
            _inside(where, losses.rows, sizes[name])
            _increasing(where, losses.rows)
            _inside(where, losses.losses, len(Loss))
            _require(bool(np.all(losses.thresholds > 0.0)) and losses.cursor >= 0,
                     f'{where}: expected positive thresholds and a cursor')
        told = self.alignment
        _same_length('alignment', told, 'source', 'stamps_ns', 'node', 'offset', 'mean',
                     'information', 'kind')
        _inside('alignment.source', told.source, len(told.sources))
        _inside('alignment.kind', told.kind, 3)
        _require(bool(np.all(np.isin(told.node, nodes.rows))),
                 'alignment.node: expected hidden nodes')
        _require(told.state in STATES, f'alignment.state: expected one of {STATES}')
        _require(told.next_verdict > 0, 'alignment.next_verdict: expected a positive number')
        for name, edges in (('waiting', self.waiting), ('set_aside', self.set_aside)):
            _same_length(name, edges, 'sources', 'i', 'j', 'mean', 'information', 'kind')
            _inside(name, edges.kind, EdgeKind.BIAS)
            _require(bool(np.all(np.isin(edges.i, nodes.rows) & np.isin(edges.j, nodes.rows))),
                     f'{name}: expected edges between hidden nodes')

    def _check_odometry(self) -> None:
        nodes = self.nodes
        _same_length('nodes', nodes, 'leads', 'leads_after_ns')
        _require(len(nodes.leads) > 0 and nodes.leads_after_ns[0] < nodes.stamps_ns[0],
                 'nodes.leads: expected at least one source, from before the first node on')
        for name in nodes.leads:
            _require(name in nodes.streams and nodes.streams[name].last is not None,
                     f'nodes.leads: there is no odometry of {name!r}')
        for name, stream in nodes.streams.items():
            where = f'nodes.streams.{name}'
            _same_length(where, stream, 'stamps_ns', 'samples', 'dense')
            _same_length(where, stream, 'waiting_ns', 'waiting')
            _increasing(where, np.append(stream.stamps_ns, stream.waiting_ns))
            _require(all(-1 <= k <= len(nodes.rows) for k in (stream.tied, stream.next_to_tie))
                     and stream.tied < len(nodes.rows) and stream.next_to_tie >= 0,
                     f'{where}: expected nodes that it ties')
            _require((stream.last is not None) == (len(stream.stamps_ns) > 0),
                     f'{where}: expected the state at the newest sample, if there is one')
            _require(stream.tied < 0 or bool(
                len(stream.stamps_ns) > 0
                and stream.stamps_ns[0] <= nodes.stamps_ns[stream.tied]),
                f'{where}: expected samples before the node that it ties')
        covered = nodes.streams[nodes.leads[-1]].stamps_ns
        _require(bool(covered[0] <= nodes.base_ns <= covered[-1]),
                 'nodes.base_ns: expected an instant that the leading odometry covers')

    def _check_source(
        self, where: str, source: SavedSource, sizes: Mapping[str, int],
    ) -> None:
        _same_length(where, source, 'seen_ns', 'seen_references')
        _require(bool(np.all(np.diff(source.seen_ns) >= 0)), f'{where}.seen_ns: must not decrease')
        _require(source.n_otherwise >= 0, f'{where}.n_otherwise: expected a count')
        _inside(f'{where}.ties', source.ties, sizes['edges'])
        own = source.rows[:, 1]
        _inside(f'{where}.rows', own, sizes['observed' if source.bins is None else 'edges'])
        if source.bins is None:
            return
        bins, rows = source.bins, self.rows
        _require(bool(np.all(rows.edges.kind[own] == EdgeKind.BIAS)),
                 f'{where}.rows: expected edges to biases')
        _same_length(f'{where}.bins', bins, 'numbers', 'rows', 'ties')
        _increasing(f'{where}.bins.numbers', bins.numbers)
        _inside(f'{where}.bins.rows', bins.rows, sizes['nodes'])
        _inside(f'{where}.bins.ties', bins.ties[:1], sizes['observed'])
        _inside(f'{where}.bins.ties', bins.ties[1:], sizes['edges'])
        _require(bins.width_ns > 0 and bool(np.all(rows.is_bias[bins.rows])),
                 f'{where}.bins: expected biases, and a width')


def site_refusal(
    saved: SavedGraph, datum: MapOrigin | None = None, fix: MapOrigin | None = None,
) -> str | None:
    """
    Say why a saved graph cannot belong to the site where the robot is; None if it can.

    Parameters
    ----------
    saved : SavedGraph
    datum : Origin, optional
        The present one, if somebody has set it: it must be that of the saved graph (altitudes do
        not count).
    fix : Origin, optional
        Where the present datum came from a fix, that one: it must lie near the saved graph. Also
        any other fix.

    """
    if saved.datum is None:
        return None
    if datum is not None:
        metres = float(distances(saved.datum, datum.latitude, datum.longitude)[0])
        turned = abs((datum.yaw - saved.datum.yaw + np.pi) % (2.0 * np.pi) - np.pi)
        if metres > SAME_PLACE or turned > SAME_YAW:
            return (f'the saved graph is of another site: its datum is {saved.datum}, the present '
                    f'one {datum}; they are {metres:.2f} m and {turned:.6f} rad apart')
    if fix is not None:
        metres = _way_to(saved, fix)
        if not metres <= SAME_SITE:
            return (f'the saved graph is of another site: its datum is {saved.datum}, the present '
                    f'one {fix}, which is {metres / 1000.0:.1f} km from the nearest node')
    return None


def _way_to(saved: SavedGraph, fix: MapOrigin) -> float:
    """Return how far a fix is from the datum or from any hidden node, whichever is nearer [m]."""
    assert saved.datum is not None
    least = float(distances(fix, saved.datum.latitude, saved.datum.longitude)[0])
    if saved.alignment.state != AlignmentState.ALIGNED.value:
        return least  # the nodes are not in the map
    points = TangentPlane(*saved.datum).to_geodetic(saved.rows.poses[saved.nodes.rows, :2])
    return min(least, float(np.min(distances(fix, points[:, 0], points[:, 1]))))


def _require(sound: bool, reason: str) -> None:
    if not sound:
        raise ValueError(reason)


def _same_length(where: str, value: Any, *names: str) -> None:
    lengths = {name: len(getattr(value, name)) for name in names}
    _require(len(set(lengths.values())) == 1, f'{where}: expected equal lengths, got {lengths}')


def _increasing(where: str, numbers: IntArray) -> None:
    _require(bool(np.all(numbers[1:] > numbers[:-1])), f'{where}: expected increasing numbers')


def _inside(where: str, numbers: IntArray, size: int) -> None:
    _require(bool(np.all((numbers >= 0) & (numbers < size))),
             f'{where}: expected indices in 0..{size - 1}')
