# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The whole state of an engine as a value, for files.

`core.parts` makes it from the parts of the engine and restores them from it; `graph_files` writes
and reads it. Settings are not part of it: a loaded graph has those of the engine that loads it.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.alignment.monitor import AlignmentState, SavedAlignment
from pose_graph_ros.core.geometry.geodesy import distances, MapOrigin, TangentPlane
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, wrap
from pose_graph_ros.core.graph.checks import check as check_table, check_priors, Ids
from pose_graph_ros.core.graph.constraints import EdgeKind, KindArray
from pose_graph_ros.core.graph.graph import GraphRows
from pose_graph_ros.core.graph.reweighting import SavedLosses
from pose_graph_ros.core.judgement.judge import SavedJudgement
from pose_graph_ros.core.odometry.node_table import SavedNodes
from pose_graph_ros.core.odometry.turns import SavedGyro
from pose_graph_ros.core.saved_columns import Matrix
from pose_graph_ros.core.sources.gauss_markov import NO_TRANSITION
from pose_graph_ros.core.sources.gyro_bias import SavedGyroBias
from pose_graph_ros.core.sources.source_constraints import SavedEdges, SavedSource

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
    waiting: SavedEdges  # edges for the next update
    set_aside: SavedEdges  # after a failed solve, for the next full optimisation
    judgement: SavedJudgement  # what is believed, and who has decided so
    # the same for people, of all closures and all that is not believed: a sentence by id
    verdicts: Mapping[str, str]
    newest_covariance: Matrix  # of the newest hidden node, in map axes
    chi2: float
    n_left_out: int  # received measurements that are neither in the graph nor saved
    datum: MapOrigin | None  # of the map, if it has one
    gyros: Mapping[str, SavedGyro] = field(default_factory=dict)
    gyro_biases: Mapping[str, SavedGyroBias] = field(default_factory=dict)

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
            numbers = np.concatenate(([-1], present, [end]))
            _require(np.diff(numbers) > 0, f'graph.{name}: expected increasing numbers')
        check_priors(rows.priors, ())
        for prior in rows.priors:
            _in_graph('graph.priors', prior.nodes, rows.node_ids)
        if self.datum is not None:
            TangentPlane(*self.datum)   # raises if it is no point on the Earth
        for place, names in _SAME_LENGTH:
            for where, value in _found(self, place):
                lengths = {name: len(getattr(value, name)) for name in names.split()}
                _require(len(set(lengths.values())) == 1,
                         f'{where}: expected equal lengths, got {lengths}')
        for expected, holds, places in _NUMBERS:
            for where, numbers in chain(*(_found(self, place) for place in places.split())):
                _require(holds(np.asarray(numbers)), f'{where}: expected {expected}')
        biases = rows.node_ids[rows.is_bias]
        known = ids | {'hidden': nodes.ids, 'biases': biases}
        for name, places in _IDS.items():
            for where, numbers in chain(*(_found(self, place) for place in places.split())):
                _in_graph(where, numbers, known[name])
        self._check_nodes()
        self._check_odometry()
        self._check_judgement(ids)
        self._check_gyros(biases)
        for name, source in self.sources.items():
            self._check_source(f'sources.{name}', source, ids)

    def _check_judgement(self, ids: Mapping[str, IntArray]) -> None:
        closures, fixes, alignment = self.judgement.closures, self.judgement.fixes, self.alignment
        _require(alignment.state in STATES, f'alignment.state: expected one of {STATES}')
        for where, table in (('alignment', alignment), ('closures', closures), ('fixes', fixes)):
            _require((table.source >= 0) & (table.source < len(table.sources)),
                     f'{where}.source: expected indices of sources')
        _require(self._kinds(closures.rows) == EdgeKind.LOOP_CLOSURE,
                 'judgement.closures: expected rows of loop closures')
        _in_graph('judgement.fixes', fixes.observed[fixes.observed != -1], ids['observed'])
        for kind, name in enumerate(('observed', 'edges')):
            _in_graph('judgement.fixes', fixes.rows[fixes.edges == kind], ids[name])

    def _check_gyros(self, biases: IntArray) -> None:
        for name, gyro in self.gyros.items():
            _require(gyro.next_node <= len(self.nodes.ids),
                     f'gyros.{name}: expected a hidden node')
            _require((gyro.waiting[:, 1] > 0.0) & np.all(gyro.waiting[:, (2, 4)] >= 0.0, axis=1),
                     f'gyros.{name}.waiting: expected times and variances')
        for name, bias in self.gyro_biases.items():
            where, (edges, states) = f'gyro_biases.{name}.edges', bias.edges.T
            _in_graph(where, edges, self.rows.edge_ids)
            _in_graph(where, states, biases)
            _require(np.all(np.diff(edges) > 0) & (self._kinds(edges) == EdgeKind.TURN),
                     f'{where}: expected increasing edges of rotations')

    def _check_nodes(self) -> None:
        rows, nodes, thinned = self.rows, self.nodes, self.nodes.thinned
        n, n_frozen = len(nodes.ids), len(nodes.frozen)
        _require(n_frozen + len(nodes.odometry) == n and n_frozen < n,
                 'nodes: expected a frozen pose or an odometry pose of each, got '
                 f'{n_frozen} and {len(nodes.odometry)} for {n} nodes')
        _check_odometry_errors('nodes.errors', nodes.errors)
        _require((nodes.relocated > 0) & (nodes.relocated < n),
                 f'nodes.relocated: expected numbers in 1..{n - 1}')
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
        _require(len(nodes.leads) > 0 and nodes.leads_after_ns[0] < nodes.stamps_ns[0],
                 'nodes.leads: expected at least one source, since before the first node')
        for name in nodes.leads:
            _require(name in nodes.streams and nodes.streams[name].last is not None,
                     f'nodes.leads: there is no odometry of {name!r}')
        for name, stream in nodes.streams.items():
            where = f'nodes.streams.{name}'
            _require(len(stream.waiting_twists) in (0, len(stream.waiting)),
                     f'{where}.waiting_twists: expected none, or as many as there are samples')
            _require(np.diff(np.append(stream.stamps_ns, stream.waiting_ns)) > 0,
                     f'{where}: expected increasing stamps')
            _require(-1 <= stream.tied < len(nodes.ids)
                     and 0 <= stream.next_to_tie <= len(nodes.ids),
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

    def _check_source(
        self, where: str, source: SavedSource, ids: Mapping[str, IntArray],
    ) -> None:
        n, constraints, bins = len(source.rows), source.rows[:, 1], source.bins
        _require(np.diff(source.seen_ns) >= 0, f'{where}.seen_ns: must not decrease')
        _require(len(source.noise) in (0, n) and len(source.edges) in (0, n)
                 and np.all(source.edges >= -1), f'{where}: expected no noise and edges, or {n}')
        _check_odometry_errors(f'{where}.odometry', source.odometry)
        as_edges = bins is not None and source.errors is None
        _in_graph(f'{where}.rows', constraints, ids['edges' if as_edges else 'observed'])
        if bins is None:
            return
        held = constraints if as_edges else source.edges
        _in_graph(f'{where}.edges', held, ids['edges'])
        _require(self._kinds(held) == EdgeKind.BIAS, f'{where}: expected edges to biases')
        has_prior = bins.ties == NO_TRANSITION
        _require(np.count_nonzero(has_prior) <= 1,
                 f'{where}.bins.ties: expected at most one {NO_TRANSITION}')
        if not np.any(has_prior):
            _in_graph(f'{where}.bins.ties', bins.ties[:1], ids['observed'])
            has_prior[:1] = True
        _in_graph(f'{where}.bins.ties', bins.ties[~has_prior], ids['edges'])

    def _kinds(self, edges: IntArray) -> KindArray:
        """Return the kinds of edges that are in the graph, by id."""
        return self.rows.edges.kind[np.searchsorted(self.rows.edge_ids, edges)]


# Columns of equal lengths, and what else is asked of numbers, by places in a `SavedGraph`.
_EDGES = 'sources i j mean information kind stamps_ns'
_LOSSES = 'rows losses thresholds shares'
_SAME_LENGTH = (
    ('nodes', 'stamps_ns ids'), ('nodes', 'leads leads_after_ns'),
    ('nodes.thinned', 'numbers anchors relative noise'),
    ('nodes.streams.*', 'stamps_ns samples dense'), ('nodes.streams.*', 'waiting_ns waiting'),
    ('sources.*', 'seen_ns seen_references'), ('sources.*.bins', 'numbers rows ties'),
    ('edge_losses', _LOSSES), ('observed_losses', _LOSSES),
    ('alignment', 'source stamps_ns node offset mean information kind'),
    ('waiting', _EDGES), ('set_aside', _EDGES),
    ('judgement.closures', 'rows source stamps_ns state since_ns decision distance'),
    ('judgement.closures', 'sources scales'),
    ('judgement.fixes',
     'rows edges source stamps_ns believed since_ns decision observed distance'),
    ('judgement.fixes', 'loosened weights'), ('judgement.odometry', 'left_sources left'),
    ('gyros.*.rates', 'stamps_ns rates'), ('gyros.*', 'waiting_ns waiting_ends waiting'),
    ('gyro_biases.*', 'numbers ids'))
_NUMBERS: tuple[tuple[str, Callable[[npt.NDArray[Any]], npt.ArrayLike], str], ...] = (
    ('increasing numbers', lambda numbers: np.diff(numbers) > 0,
     'nodes.stamps_ns nodes.ids nodes.thinned.numbers edge_losses.rows observed_losses.rows '
     'sources.*.bins.numbers gyros.*.rates.stamps_ns gyro_biases.*.numbers gyro_biases.*.ids'),
    ('nothing below 0', lambda numbers: numbers >= 0,
     'edge_losses.cursor observed_losses.cursor sources.*.n_otherwise sources.*.noise'),
    ('positive numbers', lambda numbers: numbers > 0,
     'edge_losses.thresholds observed_losses.thresholds alignment.next_verdict '
     'judgement.closures.scales judgement.fixes.weights gyros.*.next_node '
     'gyro_biases.*.width_ns sources.*.next_estimate sources.*.odometry_scale sources.*.errors '
     'sources.*.bins.width_ns'),
    ('0 or 1', lambda numbers: np.isin(numbers, (0, 1)),
     'judgement.fixes.edges judgement.fixes.believed'),
    ('edges between poses', lambda numbers: numbers < EdgeKind.BIAS,
     'waiting.kind set_aside.kind'))
# What ids are of.
_IDS = {
    'hidden': 'alignment.node waiting.i waiting.j set_aside.i set_aside.j gyros.*.waiting_ends',
    'biases': 'gyro_biases.*.ids sources.*.bins.rows',
    'edges': 'edge_losses.rows judgement.closures.rows judgement.fixes.loosened sources.*.ties',
    'observed': 'observed_losses.rows'}


def _found(value: Any, place: str, where: str = '') -> Iterator[tuple[str, Any]]:
    """Yield what is at a place, with its name: none where it is None, each item for a star."""
    name, _, rest = place.partition('.')
    if place == '':
        yield where[1:], value
    elif value is not None:
        for key, each in value.items() if name == '*' else ((name, getattr(value, name)),):
            if each is not None:
                yield from _found(each, rest, f'{where}.{key}')


def _require(valid: npt.ArrayLike, reason: str) -> None:
    if not np.all(valid):
        raise ValueError(reason)


def _in_graph(where: str, ids: IntArray, present: IntArray) -> None:
    missing = ids[~np.isin(ids, present)]
    _require(len(missing) == 0, f'{where}: {missing[:1]} is not in the graph')


def _check_odometry_errors(where: str, numbers: FloatArray) -> None:
    _require(len(numbers) == 0 or (len(numbers) == 4 and np.all(np.isfinite(numbers))
                                   and min(numbers[:2]) > 0.0 and numbers[3] > -1.0),
             f'{where}: expected two positive numbers and two others')


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
        metres = _distance_to(saved, fix)
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


def _distance_to(saved: SavedGraph, fix: MapOrigin) -> float:
    """Return the distance of a fix to the datum or the nearest node, whichever is less [m]."""
    assert saved.datum is not None
    least = float(distances(fix, saved.datum.latitude, saved.datum.longitude)[0])
    if saved.alignment.state != AlignmentState.ALIGNED.value:
        return least  # the nodes are not in the map
    points = TangentPlane(*saved.datum).to_geodetic(saved.path[:, :2])
    return min(least, float(np.min(distances(fix, points[:, 0], points[:, 1]))))
