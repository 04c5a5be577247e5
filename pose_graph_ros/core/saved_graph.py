# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A whole pose graph with all that the engine knows about it, as a value: what files keep.

The parts of the engine write and read these values (`saving`), `io.graph_files` makes text of
them. Settings are no part of it: a graph that is loaded goes on with those of its new owner.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core.constraints import check as check_table, EdgeKind
from pose_graph_ros.core.graph import GraphRows
from pose_graph_ros.core.motion import Pose
from pose_graph_ros.core.se2 import FloatArray, IntArray
from pose_graph_ros.core.sources import Loss
from pose_graph_ros.core.tangent_plane import distances, MapOrigin, TangentPlane

# A datum that was set is that of the saved graph within these [m, rad].
SAME_PLACE = 0.01
SAME_YAW = 1e-6
# A first fix within this of any node of the saved graph is one of the same site [m].
SAME_SITE = 10_000.0
# Of `estimate.AlignmentState`, by its values.
STATES = ('local', 'unaligned', 'aligned')


class Column(NamedTuple):
    """What the rows of an array are."""

    kind: type
    shape: tuple[int, ...] = ()


Integers = Annotated[IntArray, Column(int)]
Flags = Annotated[npt.NDArray[np.bool_], Column(bool)]
Numbers = Annotated[FloatArray, Column(float)]
Rows3 = Annotated[FloatArray, Column(float, (3,))]
Rows4 = Annotated[FloatArray, Column(float, (4,))]
Rows6 = Annotated[FloatArray, Column(float, (6,))]
Rows7 = Annotated[FloatArray, Column(float, (7,))]
Rows8 = Annotated[FloatArray, Column(float, (8,))]
Pairs = Annotated[IntArray, Column(int, (2,))]
Matrix = tuple[Pose, Pose, Pose]


@dataclass(frozen=True, slots=True)
class SavedInstant:
    """The state of a source of odometry at its newest settled sample; see `odometry_stream`."""

    raw: Pose
    """The sample as it came."""
    offset: Pose | None
    counted: Pose
    counted_ns: int
    held: Pose
    rate: tuple[float, float, float, float, float, float, float] | None
    """Velocity, recent and greatest speeds; None before they are known."""
    since_ns: int
    since: Pose
    way: tuple[float, float]
    jumped: bool


@dataclass(frozen=True, slots=True)
class SavedStream:
    """A source of odometry: its samples near the hidden nodes and its newest ones."""

    stamps_ns: Integers
    """Of samples that are settled, shape (T,)."""
    samples: Rows8
    """In a frame without jumps; with path lengths, turns and variances so far, shape (T, 8)."""
    dense: Flags
    resting: bool
    last: SavedInstant | None
    waiting_ns: Integers
    """Of samples that are not settled yet, shape (W,)."""
    waiting: Rows7
    """As they came: pose, speed, variances of the twist (zero where unknown), shape (W, 7)."""
    restarted_ns: int
    """The newest stamp at which it began anew after a graph was loaded, or -1."""
    tied: int
    """Newest node that it ties to another, or -1 ..."""
    next_to_tie: int
    """... and the next to look at."""


@dataclass(frozen=True, slots=True)
class SavedBridge:
    """Motion from the newest node to where the leading source began to lead."""

    mean: Pose
    covariance: Matrix


@dataclass(frozen=True, slots=True)
class SavedNodes:
    """The hidden nodes by stamp, and who made them."""

    stamps_ns: Integers
    """Shape (H,)."""
    rows: Integers
    """In the graph, shape (H,)."""
    odometry: Rows3
    """Where odometry alone puts them, shape (H, 3)."""
    leads: tuple[str, ...]
    """Sources of odometry that made them, one after the other ..."""
    leads_after_ns: Integers
    """... each with the stamp after which it did."""
    lead_ns: int
    base_ns: int
    base: Pose
    bridge: SavedBridge | None
    streams: Mapping[str, SavedStream]


@dataclass(frozen=True, slots=True)
class SavedBins:
    """The states of the error of a source; see `correlated`."""

    width_ns: int
    numbers: Integers
    """Of the bins, increasing."""
    rows: Integers
    ties: Integers


@dataclass(frozen=True, slots=True)
class SavedSource:
    """A source of measurements."""

    seen_ns: Integers
    """Stamps of all that have come, increasing ..."""
    seen_references: Integers
    """... and what tells closures of one stamp apart; see `pending`."""
    rows: Pairs
    """Stamps and rows of its constraints, shape (K, 2): edges to biases or observed nodes."""
    n_otherwise: int
    """Constraints that came before its settings were others."""
    ties: Integers
    """Its edges between hidden nodes; not those of an odometry that made the nodes."""
    bins: SavedBins | None
    """Where its errors are estimated as a bias."""


@dataclass(frozen=True, slots=True)
class SavedLosses:
    """Constraints of one table that have a robust loss."""

    rows: Integers
    losses: Integers
    """0 none, 1 Huber, 2 Cauchy."""
    thresholds: Numbers
    shares: Numbers
    cursor: int


@dataclass(frozen=True, slots=True)
class SavedAlignment:
    """What is known of the angle between odometry and map, and the measurements that tell it."""

    state: str
    sigma: float | None
    """[rad]; None for infinite."""
    next_verdict: int
    sources: tuple[str, ...]
    source: Integers
    """Index of each measurement's source."""
    stamps_ns: Integers
    node: Integers
    offset: Rows3
    mean: Rows3
    information: Rows6
    kind: Integers


@dataclass(frozen=True, slots=True)
class SavedEdges:
    """Edges that have not joined the graph yet."""

    sources: tuple[str, ...]
    i: Integers
    j: Integers
    mean: Rows3
    information: Rows6
    kind: Integers


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
    if saved.alignment.state != 'aligned':
        return least  # the nodes are not in the map
    points = TangentPlane(*saved.datum).to_geodetic(saved.rows.poses[saved.nodes.rows, :2])
    return min(least, float(np.min(distances(fix, points[:, 0], points[:, 1]))))


def as_pose(numbers: FloatArray) -> Pose:
    """Return three numbers as plain ones."""
    x, y, theta = numbers.tolist()
    return x, y, theta


def as_matrix(numbers: FloatArray) -> Matrix:
    """Return a matrix, shape (3, 3), in plain numbers."""
    first, second, third = numbers
    return as_pose(first), as_pose(second), as_pose(third)


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
