# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The whole state of an engine as a value, for files.

`capture` makes it from the parts of the engine and restores them from it; `graph_files` writes and
reads it. Settings are not part of it: a loaded graph has those of the engine that loads it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.alignment.monitor import AlignmentState, SavedAlignment
from pose_graph_ros.core.config import Loss
from pose_graph_ros.core.geometry.geodesy import distances, MapOrigin, TangentPlane
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, wrap
from pose_graph_ros.core.graph.constraints import check as check_table, EdgeKind, KindArray
from pose_graph_ros.core.graph.graph import GraphRows
from pose_graph_ros.core.graph.ids import Ids
from pose_graph_ros.core.graph.priors import check_priors
from pose_graph_ros.core.graph.reweighting import SavedLosses
from pose_graph_ros.core.judgement.closure_states import SavedClosures
from pose_graph_ros.core.judgement.fix_states import SavedFixes
from pose_graph_ros.core.judgement.judge import SavedJudgement
from pose_graph_ros.core.judgement.odometry_states import SavedOdometry
from pose_graph_ros.core.judgement.verdicts import Decision, State
from pose_graph_ros.core.odometry.saved_nodes import SavedNodes
from pose_graph_ros.core.odometry.turns import SavedGyro
from pose_graph_ros.core.saved_columns import Matrix
from pose_graph_ros.core.sources.constraint_queue import SavedEdges
from pose_graph_ros.core.sources.gauss_markov import NO_TRANSITION
from pose_graph_ros.core.sources.gyro_bias import SavedGyroBias
from pose_graph_ros.core.sources.source_constraints import SavedSource

# Tolerances within which a datum equals that of the saved graph [m], [rad].
SAME_PLACE = 0.01
SAME_YAW = 1e-6
# Maximum distance of a fix from the nearest node of a saved graph of the same site [m].
SAME_SITE = 10_000.0
STATES = tuple(state.value for state in AlignmentState)


@dataclass(frozen=True, slots=True)
class SavedGraph:
    """The state of an engine; a copy that does not change with it."""

    rows: GraphRows
    nodes: SavedNodes
    sources: Mapping[str, SavedSource]
    edge_losses: SavedLosses
    observed_losses: SavedLosses
    alignment: SavedAlignment
    waiting: SavedEdges
    """Edges for the next update."""
    set_aside: SavedEdges
    """Edges set aside after a failed solve, for the next full optimisation."""
    judgement: SavedJudgement
    """What is believed, and who has decided so."""
    verdicts: Mapping[str, str]
    """The same for people, of all closures and all that is not believed: a sentence by id."""
    newest_covariance: Matrix
    """Covariance of the newest hidden node, in map axes."""
    chi2: float
    n_left_out: int
    """Number of received measurements that are neither in the graph nor saved."""
    datum: MapOrigin | None
    """Datum of the map, if it has one."""
    gyros: Mapping[str, SavedGyro] = field(default_factory=dict)
    """Gyroscopes by name."""
    gyro_biases: Mapping[str, SavedGyroBias] = field(default_factory=dict)
    """The states of their biases in the graph."""

    @property
    def path(self) -> FloatArray:
        """Poses of all nodes that are no biases, those that have left included, shape (H, 3)."""
        return self.nodes.poses(self.rows.node_ids, self.rows.poses)

    def check(self) -> None:
        """
        Raise ValueError unless all sizes, indices and stamps are consistent; it names the place.

        For rows of the graph it is the subclass GraphUpdateError.
        """
        rows, nodes = self.rows, self.nodes
        for table in (rows.edges, rows.observed):
            if len(table) > 0:
                check_table(table, rows.node_kind, rows.dimension,
                            Ids.of(rows.next_ids.node, rows.node_ids))
        ids = {'nodes': rows.node_ids, 'edges': rows.edge_ids, 'observed': rows.observed_ids}
        for (name, present), end in zip(ids.items(), rows.next_ids, strict=True):
            _increasing(f'graph.{name}', np.concatenate(([-1], present, [end])))
        check_priors(rows.priors, ())
        for prior in rows.priors:
            _in_graph('graph.priors', prior.nodes, rows.node_ids)
        self._check_nodes()
        self._check_odometry()
        self._check_gyros()
        if self.datum is not None:
            TangentPlane(*self.datum)   # raises if it is no point on the Earth
        for name, source in self.sources.items():
            self._check_source(f'sources.{name}', source, ids)
        for name, losses in (('edges', self.edge_losses), ('observed', self.observed_losses)):
            where = f'{name} losses'
            _same_length(where, losses, 'rows', 'losses', 'thresholds', 'shares')
            _in_graph(where, losses.rows, ids[name])
            _increasing(where, losses.rows)
            _inside(where, losses.losses, len(Loss))
            _require(np.all(losses.thresholds > 0.0) and losses.cursor >= 0,
                     f'{where}: expected positive thresholds and a cursor')
        alignment = self.alignment
        _same_length('alignment', alignment, 'source', 'stamps_ns', 'node', 'offset', 'mean',
                     'information', 'kind')
        _inside('alignment.source', alignment.source, len(alignment.sources))
        _inside('alignment.kind', alignment.kind, 3)
        _require(np.isin(alignment.node, nodes.ids), 'alignment.node: expected hidden nodes')
        _require(alignment.state in STATES, f'alignment.state: expected one of {STATES}')
        _require(alignment.next_verdict > 0, 'alignment.next_verdict: expected a positive number')
        self._check_judgement(self.judgement.closures)
        self._check_fixes(self.judgement.fixes, ids)
        self._check_doubts(self.judgement.odometry)
        for name, edges in (('waiting', self.waiting), ('set_aside', self.set_aside)):
            _same_length(name, edges, 'sources', 'i', 'j', 'mean', 'information', 'kind',
                         'stamps_ns')
            _inside(name, edges.kind, EdgeKind.BIAS)
            _require(np.isin((edges.i, edges.j), nodes.ids),
                     f'{name}: expected edges between hidden nodes')

    def _check_nodes(self) -> None:
        rows, nodes, thinned = self.rows, self.nodes, self.nodes.thinned
        n, n_frozen = len(nodes.ids), len(nodes.frozen)
        _require(n > 0, 'nodes: expected at least one')
        _same_length('nodes', nodes, 'stamps_ns', 'ids')
        _require(n_frozen + len(nodes.odometry) == n and n_frozen < n,
                 'nodes: expected a frozen pose or an odometry pose of each, got '
                 f'{n_frozen} and {len(nodes.odometry)} for {n} nodes')
        _require(_are_odometry_errors(nodes.errors),
                 'nodes.errors: expected two positive numbers and two others')
        _require(np.all((nodes.relocated > 0) & (nodes.relocated < n)),
                 f'nodes.relocated: expected numbers in 1..{n - 1}')
        _increasing('nodes.stamps_ns', nodes.stamps_ns)
        _increasing('nodes.ids', nodes.ids)
        _same_length('nodes.thinned', thinned, 'numbers', 'anchors', 'relative', 'noise')
        _increasing('nodes.thinned.numbers', thinned.numbers)
        kept = np.setdiff1d(np.arange(n_frozen, n), thinned.numbers)
        _require(np.isin(thinned.anchors, kept) & (thinned.numbers >= n_frozen)
                 & (thinned.numbers < n),
                 'nodes.thinned: expected nodes that are not frozen, and others beside them')
        poses = rows.node_ids[rows.is_pose]
        # a fixed node is frozen with those around it, but stays
        _require(np.isin(poses, nodes.ids[np.append(np.arange(n_frozen), kept)]),
                 'nodes.ids: expected all hidden nodes of the graph that are no biases')
        _in_graph('nodes.ids', nodes.ids[kept], poses)

    def _check_odometry(self) -> None:
        nodes = self.nodes
        _same_length('nodes', nodes, 'leads', 'leads_after_ns')
        _require(len(nodes.leads) > 0 and nodes.leads_after_ns[0] < nodes.stamps_ns[0],
                 'nodes.leads: expected at least one source, since before the first node')
        for name in nodes.leads:
            _require(name in nodes.streams and nodes.streams[name].last is not None,
                     f'nodes.leads: there is no odometry of {name!r}')
        for name, stream in nodes.streams.items():
            where = f'nodes.streams.{name}'
            _same_length(where, stream, 'stamps_ns', 'samples', 'dense')
            _same_length(where, stream, 'waiting_ns', 'waiting', *(
                ('waiting_twists',) if len(stream.waiting_twists) > 0 else ()))
            _increasing(where, np.append(stream.stamps_ns, stream.waiting_ns))
            _require(all(-1 <= k <= len(nodes.ids) for k in (stream.tied, stream.next_to_tie))
                     and stream.tied < len(nodes.ids) and stream.next_to_tie >= 0,
                     f'{where}: expected nodes for its edges')
            _require((stream.last is not None) == (len(stream.stamps_ns) > 0),
                     f'{where}: expected the state at the newest sample, if there is one')
            _require(stream.tied < 0 or (
                len(stream.stamps_ns) > 0
                and stream.stamps_ns[0] <= nodes.stamps_ns[stream.tied]),
                f'{where}: expected samples before the node of its next edge')
        covered = nodes.streams[nodes.leads[-1]].stamps_ns
        _require(covered[0] <= nodes.base_ns <= covered[-1],
                 'nodes.base_ns: expected an instant that the primary odometry covers')

    def _check_gyros(self) -> None:
        rows = self.rows
        biases = rows.node_ids[rows.is_bias]
        for name, gyro in self.gyros.items():
            where = f'gyros.{name}'
            _same_length(f'{where}.rates', gyro.rates, 'stamps_ns', 'rates')
            _increasing(f'{where}.rates.stamps_ns', gyro.rates.stamps_ns)
            _require(0 < gyro.next_node <= len(self.nodes.ids),
                     f'{where}.next_node: expected a hidden node')
            _same_length(where, gyro, 'waiting_ns', 'waiting_ends', 'waiting')
            _require(gyro.waiting[:, 1] > 0.0, f'{where}.waiting: expected positive variances')
            _require(gyro.waiting[:, (2, 4)] >= 0.0,
                     f'{where}.waiting: expected times and variances')
            _require(np.isin(gyro.waiting_ends, self.nodes.ids),
                     f'{where}.waiting_ends: expected hidden nodes')
        for name, bias in self.gyro_biases.items():
            where = f'gyro_biases.{name}'
            _same_length(where, bias, 'numbers', 'ids')
            _increasing(f'{where}.numbers', bias.numbers)
            _increasing(f'{where}.ids', bias.ids)
            _in_graph(f'{where}.ids', bias.ids, biases)
            edges, states = bias.edges.T
            _in_graph(f'{where}.edges', edges, rows.edge_ids)
            _in_graph(f'{where}.edges', states, biases)
            _increasing(f'{where}.edges', edges)
            _require(self._kinds(edges) == EdgeKind.TURN,
                     f'{where}.edges: expected edges of rotations')
            _require(bias.width_ns > 0, f'{where}.width_ns: expected a positive number')

    def _check_judgement(self, closures: SavedClosures) -> None:
        where = 'judgement.closures'
        _same_length(where, closures, 'rows', 'source', 'stamps_ns', 'state', 'since_ns',
                     'decision', 'distance')
        _same_length(where, closures, 'sources', 'scales')
        _in_graph(where, closures.rows, self.rows.edge_ids)
        _inside(where, closures.source, len(closures.sources))
        _inside(where, closures.state, len(State))
        _inside(where, closures.decision, len(Decision))
        _require(self._kinds(closures.rows) == EdgeKind.LOOP_CLOSURE,
                 f'{where}: expected rows of loop closures')
        _require(closures.scales > 0.0, f'{where}: expected positive scales')

    def _check_fixes(self, fixes: SavedFixes, ids: Mapping[str, IntArray]) -> None:
        where = 'judgement.fixes'
        _same_length(where, fixes, 'rows', 'edges', 'source', 'stamps_ns', 'believed', 'since_ns',
                     'decision', 'observed', 'distance')
        _in_graph(where, fixes.observed[fixes.observed != -1], ids['observed'])
        _same_length(where, fixes, 'loosened', 'weights')
        _inside(where, fixes.edges, 2)
        _inside(where, fixes.believed, 2)
        for kind, table in enumerate(('observed', 'edges')):
            _in_graph(where, fixes.rows[fixes.edges == kind], ids[table])
        _inside(where, fixes.source, len(fixes.sources))
        _inside(where, fixes.decision, len(Decision))
        _in_graph(where, fixes.loosened, ids['edges'])
        _require(fixes.weights > 0.0, f'{where}: expected positive weights')

    def _check_doubts(self, odometry: SavedOdometry) -> None:
        where = 'judgement.odometry'
        _same_length(where, odometry, 'left_sources', 'left')

    def _check_source(
        self, where: str, source: SavedSource, ids: Mapping[str, IntArray],
    ) -> None:
        _same_length(where, source, 'seen_ns', 'seen_references')
        _require(np.diff(source.seen_ns) >= 0, f'{where}.seen_ns: must not decrease')
        _require(source.n_otherwise >= 0, f'{where}.n_otherwise: expected a count')
        _in_graph(f'{where}.ties', source.ties, ids['edges'])
        constraints = source.rows[:, 1]
        as_edges = source.bins is not None and source.errors is None
        _in_graph(f'{where}.rows', constraints, ids['edges' if as_edges else 'observed'])
        self._check_errors(where, source)
        if source.bins is None:
            return
        bins, rows = source.bins, self.rows
        held = constraints if as_edges else source.edges
        _in_graph(f'{where}.edges', held, ids['edges'])
        _require(self._kinds(held) == EdgeKind.BIAS,
                 f'{where}: expected edges to biases')
        _same_length(f'{where}.bins', bins, 'numbers', 'rows', 'ties')
        _increasing(f'{where}.bins.numbers', bins.numbers)
        _in_graph(f'{where}.bins.rows', bins.rows, ids['nodes'])
        has_prior = bins.ties == NO_TRANSITION
        _require(np.count_nonzero(has_prior) <= 1,
                 f'{where}.bins.ties: expected at most one {NO_TRANSITION}')
        if not np.any(has_prior):
            _in_graph(f'{where}.bins.ties', bins.ties[:1], ids['observed'])
            has_prior[:1] = True
        _in_graph(f'{where}.bins.ties', bins.ties[~has_prior], ids['edges'])
        _require(bins.width_ns > 0 and np.all(
            rows.is_bias[rows.rows_of(bins.rows)]),
                 f'{where}.bins: expected biases, and a width')

    def _kinds(self, edges: IntArray) -> KindArray:
        """Return the kinds of edges that are in the graph, by id."""
        return self.rows.edges.kind[np.searchsorted(self.rows.edge_ids, edges)]

    def _check_errors(self, where: str, source: SavedSource) -> None:
        """Check what was estimated of the errors of a source."""
        n = len(source.rows)
        _require(len(source.noise) in (0, n) and np.all(source.noise >= 0.0),
                 f'{where}.noise: expected no rows, or {n} that are not negative')
        _require(len(source.edges) in (0, n) and np.all(source.edges >= -1),
                 f'{where}.edges: expected no rows, or {n}')
        _require(source.next_estimate > 0, f'{where}.next_estimate: expected a positive number')
        _require(source.odometry_scale > 0.0,
                 f'{where}.odometry_scale: expected a positive number')
        _require(_are_odometry_errors(source.odometry),
                 f'{where}.odometry: expected two positive numbers and two others')
        _require(source.errors is None or min(source.errors) > 0.0,
                 f'{where}.errors: expected positive numbers')


def _are_odometry_errors(numbers: FloatArray) -> bool:
    return len(numbers) == 0 or (
        len(numbers) == 4 and bool(np.all(np.isfinite(numbers))) and min(numbers[:2]) > 0.0
        and numbers[3] > -1.0)


def site_refusal(
    saved: SavedGraph, datum: MapOrigin | None = None, fix: MapOrigin | None = None,
) -> str | None:
    """
    Return why a saved graph cannot belong to the site of the robot; None if it can.

    Parameters
    ----------
    datum : MapOrigin, optional
        The current datum, if the user has set it. It must equal that of the saved graph, except
        for the altitude.
    fix : MapOrigin, optional
        The fix that the current datum comes from, or any other. It must be near the saved graph.

    """
    if saved.datum is None:
        return None
    if datum is not None and (refusal := datum_refusal(saved.datum, datum)) is not None:
        return refusal
    if fix is not None:
        metres = _distance_to(saved, fix)
        if not metres <= SAME_SITE:
            return (f'the saved graph is of another site: its datum is {saved.datum}, the present '
                    f'one {fix}, which is {metres / 1000.0:.1f} km from the nearest node')
    return None


def datum_refusal(saved: MapOrigin, datum: MapOrigin) -> str | None:
    """
    Return why the datum of a saved graph is not the one that was set; None if it is.

    Parameters
    ----------
    saved, datum : MapOrigin, they must be equal except for the altitude

    """
    metres = float(distances(saved, datum.latitude, datum.longitude)[0])
    turned = abs(wrap(datum.yaw - saved.yaw))
    if metres <= SAME_PLACE and turned <= SAME_YAW:
        return None
    return (f'the saved graph is of another site: its datum is {saved}, the present one {datum}; '
            f'they are {metres:.2f} m and {turned:.6f} rad apart')


def _distance_to(saved: SavedGraph, fix: MapOrigin) -> float:
    """Return the distance of a fix to the datum or the nearest node, whichever is less [m]."""
    assert saved.datum is not None
    least = float(distances(fix, saved.datum.latitude, saved.datum.longitude)[0])
    if saved.alignment.state != AlignmentState.ALIGNED.value:
        return least  # the nodes are not in the map
    points = TangentPlane(*saved.datum).to_geodetic(saved.path[:, :2])
    return min(least, float(np.min(distances(fix, points[:, 0], points[:, 1]))))


def _require(valid: npt.ArrayLike, reason: str) -> None:
    if not np.all(valid):
        raise ValueError(reason)


def _same_length(where: str, value: Any, *names: str) -> None:
    lengths = {name: len(getattr(value, name)) for name in names}
    _require(len(set(lengths.values())) == 1, f'{where}: expected equal lengths, got {lengths}')


def _increasing(where: str, numbers: IntArray) -> None:
    _require(numbers[1:] > numbers[:-1], f'{where}: expected increasing numbers')


def _in_graph(where: str, ids: IntArray, present: IntArray) -> None:
    missing = ids[~np.isin(ids, present)]
    _require(len(missing) == 0, f'{where}: {missing[:1]} is not in the graph')


def _inside(where: str, numbers: IntArray, size: int) -> None:
    _require((numbers >= 0) & (numbers < size), f'{where}: expected indices in 0..{size - 1}')
