# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The statistics of the errors of a source that its measurements and odometry make the most likely.

Of all values on a lattice those with the largest likelihood (`error_likelihood`) are searched,
once for errors that are white and once for errors with a correlated part. Senders know the size of
their errors better than how these go on, so a total variance other than the claimed one counts
against both. The noise of odometry is mostly a guess: it is searched along, that of the way and
that of turns by themselves, and odometry may have a constant error of the scale and of the yaw
rate. Otherwise its drift, or that it has less than its settings say, would be taken for errors of
the source. Correlated errors are believed if they are much more likely than white ones.

The result depends on the measurements and on odometry alone, not on the estimate of the graph,
and so not on the order of arrival. Searches are generators: each step takes a bounded time.
"""

from collections.abc import Generator
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.constraints import EdgeKind, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.sources.error_likelihood import (
    chain_motions,
    filtered,
    MeasuredPath,
)
from pose_graph_ros.core.sources.gauss_markov import CorrelatedErrors
from pose_graph_ros.core.sources.past_path import no_past, PastPath

# Number of measurements that are used: the newest ones, and as many of all older ones.
NEWEST = OLDER = 2000
# Minimum number of measurements for an estimate.
LEAST_POSITIONS = 10
# Number of filtered measurements in one step of a search, of 0.3 us each.
PER_STEP = 5000
# Number of nodes that are joined in one step, of 0.1 us each.
NODES_PER_STEP = 10_000
# How much more likely correlated errors must be, in twice the difference of the logarithms; once
# they are believed, they must only be more likely, so that it does not flip to and fro.
SIGNIFICANT = 20.0
# The same for each time that the filter was lost: then odometry was wrong, or many positions.
PER_LOST = 100.0
# The same of a scale of the noise of odometry other than 1.
SIGNIFICANT_SCALE = 4.0
# Longest time constant, in units of the time from the first measurement to the last. Shorter ones
# would make the variance of an error that hardly changes in this time too small.
LONGEST = 16.0
# Smallest correlation of consecutive measurements that matters.
LEAST_CORRELATION = 0.2
# Sigma of the logarithm of the total variance in units of the claimed one, before it is seen.
SPREAD = 0.7
# The same of white errors that are smaller: where positions scatter much less than is claimed, the
# rest of the claim is mostly an error that changes slowly.
SMALLER_SPREAD = 0.5
# The same of the noise of way and turn by odometry: settings of turns are hardly ever known.
WAY_SPREAD, TURN_SPREAD = 2.0, 3.0
# Exponents of 2 on the lattice: smallest step, and bounds of the variances.
FINEST, LEAST, MOST = 0.25, -10.0, 8.0
# Exponents with which the searches begin: correlated and white part; way and turn, also less than
# white errors need; way, turn and white part.
BEGINNINGS = ((0.0, -5.0), (0.0, -3.0), (-0.5, -2.0), (-1.0, -1.0))
ODOMETRY_BEGINNINGS = (0.0, 0.0), (-4.0, -4.0)
WHITE_BEGINNINGS = tuple((at, at, 0.0) for at in (-6.0, -4.0, -2.0, 0.0, 2.0, 4.0, 6.0))
# Place of the noise of odometry in a point, from the end; that of turns, if way has its own.
ODOMETRY = -2
# Headings at which the filter starts, of which the best one is used.
HEADINGS = 16
LOG_2 = math.log(2.0)

Point = tuple[float, ...]


class Estimate(NamedTuple):
    """What the positions of a source and odometry show together."""

    errors: CorrelatedErrors | None
    """Statistics of the errors of the source; None for white errors."""
    odometry_scale: float
    """Factor on the sigmas of odometry."""


NOTHING = Estimate(None, 1.0)
Search = Generator[None, None, Estimate]
"""Yields after each step."""
PathSteps = Generator[None, None, MeasuredPath]
"""The same of a path."""


class _Minimum(NamedTuple):
    """The best point of the lattice so far."""

    value: float
    point: Point


def measured_path(
    graph: Graph, stamps_ns: IntArray, ids: IntArray, past: PastPath | None = None,
) -> PathSteps:
    """
    Return the positions of a source along the path by odometry, sorted by stamp, after some steps.

    Parameters
    ----------
    graph : Graph, whose nodes may leave between two steps
    stamps_ns : ndarray of int64, shape (K,)
    ids : ndarray of int64, shape (K,), of the observed nodes; headings among them are left out
    past : PastPath, optional, positions that have left the graph

    """
    stamps_ns, observed = _sorted(graph, stamps_ns, ids)
    chosen = _chosen(len(observed))
    stamps_ns, observed = stamps_ns[chosen], observed.rows(chosen)
    begin_at = None if past is None else past.node
    until, edge_after = _odometry(graph, observed.node, begin_at)
    yield
    n = len(until)
    joined, spread, way = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3))
    begin = 0
    while begin < n:
        most = until[max(begin - 1, 0)] + NODES_PER_STEP
        end = max(int(np.searchsorted(until, most)), begin + 1)
        # those of nodes that have left since count as unknown
        rows_after = graph.edge_rows(edge_after)
        chain_motions(
            graph.memory['edge_f'], rows_after, until, begin, end, joined, spread, way)
        begin = end
        yield
    if past is not None:
        return past.continued(
            stamps_ns, _path(stamps_ns, observed, joined[1:], spread[1:], way[1:]))
    return _path(stamps_ns, observed, joined, spread, way)


def left_behind(
    graph: Graph, stamps_ns: IntArray, ids: IntArray, past: PastPath | None, node: int,
) -> PastPath:
    """
    Return the positions of a source before a node, when those before it leave the graph.

    Parameters
    ----------
    graph : Graph, with the nodes that leave
    stamps_ns : ndarray of int64, shape (K,)
    ids : ndarray of int64, shape (K,), of the observed nodes that leave
    past : PastPath, optional, those that have left before
    node : int, id of the first node that stays

    """
    stamps_ns, observed = _sorted(graph, stamps_ns, ids)
    before = np.flatnonzero(observed.node < node)
    stamps_ns, observed = stamps_ns[before], observed.rows(before)
    if past is None:
        past = no_past(int(observed.node[0]) if len(observed) > 0 else node)
    until, edge_after = _odometry(graph, np.append(observed.node, node), past.node)
    n = len(until)
    motion, noise, way = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3))
    chain_motions(
        graph.memory['edge_f'], graph.edge_rows(edge_after), until, 0, n, motion, noise, way)
    return past.extended(
        stamps_ns, _path(stamps_ns, observed, motion[1:], noise[1:], way[1:]), node)


def _sorted(
    graph: Graph, stamps_ns: IntArray, ids: IntArray,
) -> tuple[IntArray, ObservedNodes]:
    """Return those of some observed nodes that are in the graph, and no headings, by stamp."""
    rows = graph.observed_rows(ids)
    stamps_ns, rows = stamps_ns[rows >= 0], rows[rows >= 0]
    placed = graph.memory['observed_i'][rows, tb.OBS_KIND] != ObservedKind.HEADING
    stamps_ns, rows = stamps_ns[placed], rows[placed]
    where = graph.memory['observed_f'][rows, tb.MEAN:tb.MEAN + 2]
    order = np.lexsort((where[:, 1], where[:, 0], stamps_ns))
    return stamps_ns[order], graph.observed_at(graph.observed_ids[rows[order]])


def _path(
    stamps_ns: IntArray, observed: ObservedNodes, motion: FloatArray, noise: FloatArray,
    way: FloatArray,
) -> MeasuredPath:
    """Return the path of some positions."""
    covariance = np.linalg.inv(observed.information[:, :2, :2])
    seconds = np.asarray((stamps_ns - stamps_ns[:1]) * 1e-9, dtype=np.float64)
    return MeasuredPath(
        seconds, observed.mean[:, :2].copy(), 0.5 * np.trace(covariance, axis1=1, axis2=2),
        observed.offset[:, :2].copy(), motion, noise, way)


def _chosen(n: int) -> IntArray | slice:
    """Return which of n measurements, by stamp, are used."""
    if n <= NEWEST + OLDER:
        return slice(n)
    older = np.linspace(0, n - NEWEST, OLDER, endpoint=False).astype(np.int64)
    return np.concatenate((older, np.arange(n - NEWEST, n)))


def _odometry(
    graph: Graph, nodes: IntArray, begin: int | None = None,
) -> tuple[IntArray, IntArray]:
    """
    Return where nodes are among the poses of a path, and the id of the edge after each.

    With `begin`, the id of a node that is still there, that is the first of them.
    """
    at, rows = np.cumsum(graph.is_pose) - 1, graph.node_rows(nodes)
    if begin is not None:
        rows = np.append(graph.node_rows(begin), rows)
        rows = np.maximum(rows, rows[0])
    first = int(at[np.min(rows)]) if len(rows) > 0 else 0
    until = np.maximum.accumulate(at[rows] - first)
    edge_after = np.full(int(until[-1]) if len(until) > 0 else 0, -1)
    table = graph.memory['edge_i'][:graph.n_edges]
    edges = np.flatnonzero(table[:, tb.EDGE_KIND] == EdgeKind.ODOMETRY)
    start = at[table[edges, tb.END_I]] - first
    inside: BoolArray = ((start >= 0) & (start < len(edge_after))
                         & (at[table[edges, tb.END_J]] - first == start + 1))
    # of several edges the first is that of the primary odometry
    edge_after[start[inside][::-1]] = graph.edge_ids[edges[inside]][::-1]
    return until, edge_after


def search(positions: MeasuredPath, *, correlated: bool = False) -> Search:
    """
    Return what the positions on a path show of their errors and of odometry, after some steps.

    Parameters
    ----------
    positions : MeasuredPath
    correlated : bool, whether the errors are taken for correlated ones until now

    """
    if len(positions.seconds) < LEAST_POSITIONS:
        return NOTHING
    evaluate = _Evaluation(positions)
    yield from evaluate.find_heading()
    white = yield from _descend(evaluate, list(WHITE_BEGINNINGS))
    period = float(np.median(np.diff(positions.seconds)))
    shortest, longest = (
        math.ceil(math.log2(max(time, 1e-3)) / FINEST) * FINEST
        for time in (period, LONGEST * float(positions.seconds[-1])))
    evaluate.bounds = shortest, longest
    found = _Minimum(math.inf, white.point)
    for odometry in {*ODOMETRY_BEGINNINGS, white.point[:2]}:
        found = min(found, (yield from _descend(evaluate, [
            (time, part, *odometry, white_part)
            for time in np.arange(shortest, longest + 0.1, 1.0).tolist()
            for part, white_part in BEGINNINGS])))
    tau, part, *_, white_part = (2.0 ** exponent for exponent in found.point)
    errors = CorrelatedErrors(tau, part, white_part)
    correlation = part * math.exp(-period / tau) / (part + white_part)
    needed = (0.0 if correlated else SIGNIFICANT) + PER_LOST * max(
        evaluate.lost[white.point], evaluate.lost[found.point])
    significant = white.value - found.value > needed and correlation > LEAST_CORRELATION
    scale = yield from _odometry_scale(evaluate, (found if significant else white).point)
    return Estimate(errors if significant else None, scale)


def _odometry_scale(
    evaluate: '_Evaluation', best: Point,
) -> Generator[None, None, float]:
    """
    Return the factor on the sigmas of odometry; 1 unless its claim is much less likely.

    The graph has one factor for way and turn, and no constant errors, so that its factor is
    another one. A factor below 1 is the largest that is likely enough, and only beside white
    errors: correlated ones show too little of what odometry does over longer times.
    """
    *errors, way, turn, white = best
    found = yield from _descend(evaluate, [(*errors, at, white) for at in (way, turn, 0.0)])
    *errors, exponent, white = found.point
    claimed = yield from _descend(evaluate, [(*errors, 0.0, white)], fixed=ODOMETRY)
    if claimed.value - found.value <= SIGNIFICANT_SCALE or (len(errors) > 0 and exponent < 0.0):
        return 1.0
    while exponent < 0.0:
        more = (*errors, exponent + FINEST, white)
        if (yield from evaluate.value(more)) - found.value > SIGNIFICANT_SCALE:
            break
        exponent += FINEST
    return 2.0 ** (0.5 * max(exponent, min(way, 0.0), min(turn, 0.0)))


class _Evaluation:
    """Evaluates points of the lattice, at most once each."""

    def __init__(self, positions: MeasuredPath) -> None:
        # the kernel takes no other layout, which arrays of the past may have
        self._path = MeasuredPath(*map(np.ascontiguousarray, positions))
        self._heading = 0.0
        self._values: dict[Point, float] = {}
        self.lost: dict[Point, int] = {}
        """How often the filter was lost."""
        self._left = PER_STEP
        self.bounds = LEAST, MOST
        """Of the exponent of the time constant."""

    def find_heading(self) -> Generator[None, None, None]:
        """Find the heading at the first position that makes white errors the most likely."""
        best = math.inf
        for angle in (2.0 * math.pi / HEADINGS * np.arange(HEADINGS)).tolist():
            value, _ = filtered(*self._path, 1.0, 0.0, 1.0, 1.0, 1.0, angle, True)
            if value < best:
                best, self._heading = value, angle
            yield from self._pause()

    def value(self, point: Point) -> Generator[None, None, float]:
        """
        Return twice the negative logarithm of the posterior probability of a point.

        A point has the exponents of tau and the correlated variance, if there is one, the noise of
        way and turn by odometry, and the white variance. If it has one number for way and turn,
        odometry has no constant errors.
        """
        if point not in self._values:
            constant = len(point) % 2 == 1
            way, turn = point[-3 if constant else ODOMETRY], point[ODOMETRY]
            tau, correlated = (
                (2.0 ** point[0], 2.0 ** point[1]) if len(point) > 3 else (1.0, 0.0))
            white = 2.0 ** point[-1]
            value, self.lost[point] = filtered(
                *self._path, tau, correlated, 2.0 ** way, 2.0 ** turn, white, self._heading,
                constant)
            total = math.log2(correlated + white)
            spread = SPREAD if len(point) > 3 or total > 0.0 else SMALLER_SPREAD
            self._values[point] = value + LOG_2**2 * (
                (total / spread) ** 2 + (way / WAY_SPREAD) ** 2 + (turn / TURN_SPREAD) ** 2)
            yield from self._pause()
        return self._values[point]

    def _pause(self) -> Generator[None, None, None]:
        self._left -= len(self._path.seconds)
        if self._left < 0:
            self._left = PER_STEP
            yield

    def clipped(self, point: Point) -> Point:
        """Return a point inside the bounds."""
        times = 1 if len(point) > 3 else 0
        low, high = self.bounds
        return (*(min(max(exponent, low), high) for exponent in point[:times]),
                *(min(max(exponent, LEAST), MOST) for exponent in point[times:]))


def _descend(
    evaluate: _Evaluation, beginnings: list[Point], fixed: int = 0,
) -> Generator[None, None, _Minimum]:
    """
    Return the best point near the best beginning, by steps that are halved.

    Parameters
    ----------
    evaluate : _Evaluation
    beginnings : list of points
    fixed : int, index from the end of a number that stays as it is, if it is negative

    """
    values: list[_Minimum] = []
    for point in beginnings:
        values.append(_Minimum((yield from evaluate.value(point)), point))
    best, step = min(values), 1.0
    while step >= FINEST:
        before = best
        for axis in range(-len(best.point), 0):
            if axis == fixed:
                continue
            for move in (step, -step):
                moved = list(best.point)
                moved[axis] += move
                point = evaluate.clipped(tuple(moved))
                best = min(best, _Minimum((yield from evaluate.value(point)), point))
        if best.value == before.value:
            step /= 2.0
    return best
