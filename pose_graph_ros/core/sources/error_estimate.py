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

from collections.abc import Collection, Generator
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import (
    FactorKind,
    Factors,
    full,
    upper,
)
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.odometry.motion import AS_CLAIMED, OdometryErrors
from pose_graph_ros.core.sources.bias import CorrelatedErrors
from pose_graph_ros.core.sources.error_likelihood import (
    chain_motions,
    filtered,
    MeasuredPath,
    no_past,
    PastPath,
)
from pose_graph_ros.core.sources.settings import SOURCES

# Place of the noise of odometry in a point, from the end; that of turns, if way has its own.
ODOMETRY = -2
LOG_2 = math.log(2.0)

Point = tuple[float, ...]


class Estimate(NamedTuple):
    """What the positions of a source and odometry show together."""

    # statistics of the errors of the source; None for white errors
    errors: CorrelatedErrors | None
    odometry: OdometryErrors
    rate_sigma: float = math.inf  # sigma of the constant error of the yaw rate [rad/s]
    scale_sigma: float = math.inf  # sigma of that of the scale


NOTHING = Estimate(None, AS_CLAIMED)
Search = Generator[None, None, Estimate]  # yields after each step
PathSteps = Generator[None, None, MeasuredPath]  # the same of a path


class PathOdometry(NamedTuple):
    """What is known of the odometry between the hidden nodes."""

    ids: IntArray  # ids of the nodes, ascending, shape (N,)
    stamps_ns: IntArray  # shape (N,) [ns]
    errors: OdometryErrors  # those that the edges in the graph know of
    # constant errors that the motions of a path are to be without, near the true ones
    reference: OdometryErrors


class _Edges(NamedTuple):
    """The odometry after each pose of a path, as `chain_motions` takes it."""

    means: FloatArray
    informations: FloatArray
    seconds: FloatArray


class Minimum(NamedTuple):
    value: float
    point: Point


def measured_path(
    graph: Graph, odometry: PathOdometry, stamps_ns: IntArray, ids: IntArray,
    past: PastPath | None = None,
) -> PathSteps:
    """
    Return the positions of a source along the path by odometry, sorted by stamp, after some steps.
    """
    stamps_ns, observed = _sorted(graph, stamps_ns, ids)
    chosen = _chosen(len(observed))
    stamps_ns, observed = stamps_ns[chosen], observed.rows(chosen)
    begin_at = None if past is None else past.node
    until, edges = _odometry(graph, odometry, observed.i, begin_at)
    yield
    n, begin = len(until), 0
    motions = _no_motions(n)
    while begin < n:
        most = until[max(begin - 1, 0)] + SOURCES.nodes_per_step
        end = max(int(np.searchsorted(until, most)), begin + 1)
        chain_motions(*edges, until, begin, end, *motions)
        begin = end
        yield
    taken_out = np.tile((odometry.reference.rate, odometry.reference.scale), (n, 1))
    if past is None:
        return _path(stamps_ns, observed, *motions, taken_out)
    return past.continued(stamps_ns, _path(
        stamps_ns, observed, *(column[1:] for column in (*motions, taken_out))))


def left_behind(
    graph: Graph, odometry: PathOdometry, stamps_ns: IntArray, ids: IntArray, *,
    past: PastPath | None, node: int,
) -> PastPath:
    """Return the positions of a source before a node, when those before it leave the graph."""
    stamps_ns, observed = _sorted(graph, stamps_ns, ids)
    before = np.flatnonzero(observed.i < node)
    stamps_ns, observed = stamps_ns[before], observed.rows(before)
    if past is None:
        past = no_past(int(observed.i[0]) if len(observed) > 0 else node)
    until, edges = _odometry(graph, odometry, np.append(observed.i, node), past.node)
    n = len(until)
    motions = _no_motions(n)
    chain_motions(*edges, until, 0, n, *motions)
    return past.extended(stamps_ns, _path(
        stamps_ns, observed, *(column[1:] for column in (*motions, np.zeros((n, 2))))), node)


def _no_motions(n: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    return np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, 3))


def _sorted(
    graph: Graph, stamps_ns: IntArray, ids: IntArray,
) -> tuple[IntArray, Factors]:
    """Return those of some observed nodes that are in the graph, and no headings, by stamp."""
    rows = graph.factor_rows(ids)
    stamps_ns, rows = stamps_ns[rows >= 0], rows[rows >= 0]
    factors = graph.factor_records
    placed = factors['kind'][rows] != FactorKind.HEADING
    stamps_ns, rows = stamps_ns[placed], rows[placed]
    where = factors['mean'][rows]
    order = np.lexsort((where[:, 1], where[:, 0], stamps_ns))
    return stamps_ns[order], graph.factors_at(graph.factor_ids[rows[order]])


def _path(
    stamps_ns: IntArray, observed: Factors, *motions: FloatArray,
) -> MeasuredPath:
    """Return the path of some positions, with the columns that say how the robot moved."""
    covariance = np.linalg.inv(observed.information[:, :2, :2])
    seconds = np.asarray((stamps_ns - stamps_ns[:1]) * 1e-9, dtype=np.float64)
    return MeasuredPath(
        seconds, observed.mean[:, :2].copy(), 0.5 * np.trace(covariance, axis1=1, axis2=2),
        observed.offset[:, :2].copy(), *motions)


def _chosen(n: int) -> IntArray | slice:
    newest, n_older = SOURCES.newest_positions, SOURCES.older_positions
    if n <= newest + n_older:
        return slice(n)
    older = np.linspace(0, n - newest, n_older, endpoint=False).astype(np.int64)
    return np.concatenate((older, np.arange(n - newest, n)))


def _odometry(
    graph: Graph, odometry: PathOdometry, nodes: IntArray, begin: int | None = None,
) -> tuple[IntArray, _Edges]:
    """Return where nodes are among the poses of a path, and the odometry after each pose."""
    at, rows = np.cumsum(graph.is_pose) - 1, graph.node_rows(nodes)
    if begin is not None:
        rows = np.append(graph.node_rows(begin), rows)
        rows = np.maximum(rows, rows[0])
    first = int(at[np.min(rows)]) if len(rows) > 0 else 0
    until = np.maximum.accumulate(at[rows] - first)
    n = int(until[-1]) if len(until) > 0 else 0
    edge_after = np.full(n, -1)
    factors = graph.factor_records
    edges = np.flatnonzero(factors['kind'] == FactorKind.ODOMETRY)
    start, end, _ = at[factors['ends'][edges]].T - first
    inside: BoolArray = (start >= 0) & (start < n) & (end == start + 1)
    # of several edges the first is that of the primary odometry
    edge_after[start[inside][::-1]] = edges[inside][::-1]
    stamps_ns = odometry.stamps_ns[np.searchsorted(
        odometry.ids, graph.node_ids[graph.is_pose][first:first + n + 1])]
    seconds = np.asarray(np.diff(stamps_ns) * 1e-9, dtype=np.float64)
    known = edge_after >= 0
    found = edge_after[known]
    claimed = odometry.errors.inverse_noise.informations(full(factors['information'][found]))
    means, informations = np.zeros((n, 3)), np.zeros((n, 6))
    means[known] = odometry.reference.motions(odometry.errors.as_odometry_says(
        factors['mean'][found], seconds[known]), seconds[known])
    informations[known] = upper(claimed)
    return until, _Edges(means, informations, seconds)


def search(positions: MeasuredPath, *, correlated: bool = False) -> Search:
    """
    Return what the positions on a path show of their errors and of odometry, after some steps.
    """
    if len(positions.seconds) < SOURCES.least_positions:
        return NOTHING
    evaluate = Evaluation(positions)
    best = (yield from most_likely(evaluate, correlated=correlated)).point
    odometry, *sigmas = yield from _odometry_errors(evaluate, best)
    return Estimate(errors_of(best), odometry, *sigmas)


def errors_of(point: Point) -> CorrelatedErrors | None:
    """Return the statistics of errors at a point; None for white errors."""
    if len(point) <= 3:
        return None
    tau, part, *_, white_part = (2.0 ** exponent for exponent in point)
    return CorrelatedErrors(tau, part, white_part)


def most_likely(
    evaluate: 'Evaluation', *, correlated: bool = False,
) -> Generator[None, None, Minimum]:
    """
    Return the best point: of correlated errors only if these are much more likely than white ones.

    Where they were found to be `correlated` before, it is enough that they are more likely.
    """
    positions = evaluate.path
    yield from evaluate.find_heading()
    white = yield from descend(evaluate, [(at, at, 0.0) for at in SOURCES.white_beginnings])
    period = float(np.median(np.diff(positions.seconds)))
    shortest, longest = (
        math.ceil(math.log2(max(time, 1e-3)) / SOURCES.finest) * SOURCES.finest
        for time in (period, SOURCES.longest_time * float(positions.seconds[-1])))
    evaluate.bounds = shortest, longest
    found = Minimum(math.inf, white.point)
    for odometry in {*SOURCES.odometry_beginnings, white.point[:2]}:
        found = min(found, (yield from descend(evaluate, [
            (time, part, *odometry, white_part)
            for time in np.arange(shortest, longest + 0.1, 1.0).tolist()
            for part, white_part in SOURCES.beginnings])))
    errors = errors_of(found.point)
    assert errors is not None
    correlation = errors.correlated * math.exp(-period / errors.tau) / (
        errors.correlated + errors.white)
    needed = (0.0 if correlated else SOURCES.significant) + SOURCES.per_lost * max(
        evaluate.lost[white.point], evaluate.lost[found.point])
    significant = white.value - found.value > needed and correlation > SOURCES.least_shared
    return found if significant else white


def _odometry_errors(
    evaluate: 'Evaluation', best: Point,
) -> Generator[None, None, tuple[OdometryErrors, float, float]]:
    """
    Return the errors of odometry, as claimed unless others are much more likely.

    Factors below 1 are the largest ones that are likely enough, and only beside white errors:
    correlated ones show too little of what odometry does over longer times.
    """
    *errors, way, turn, white = best
    claimed = yield from descend(evaluate, [(*errors, 0.0, white)], fixed=(ODOMETRY,))
    least = yield from evaluate.value(best)
    needed = SOURCES.significant if len(errors) > 0 else SOURCES.significant_odometry
    if claimed.value - least > needed:
        for axis in (-3, ODOMETRY):
            while best[axis] < 0.0:
                more = (*best[:axis], best[axis] + SOURCES.finest, *best[axis + 1:])
                if len(errors) == 0 and (
                        yield from evaluate.value(more)) - least > SOURCES.significant_scale:
                    break
                best = more
        yield from evaluate.value(best)
        rate, scale, rate_variance, scale_variance = evaluate.constants[best]
        return (OdometryErrors(2.0 ** best[-3], 2.0 ** best[ODOMETRY], rate, scale),
                math.sqrt(rate_variance), math.sqrt(scale_variance))
    found = yield from descend(evaluate, [(*errors, at, white) for at in (way, turn, 0.0)])
    exponent = found.point[ODOMETRY]
    if claimed.value - found.value <= SOURCES.significant_scale or exponent < 0.0:
        return AS_CLAIMED, math.inf, math.inf
    return OdometryErrors.scaled(2.0 ** (0.5 * exponent)), math.inf, math.inf


class Evaluation:
    """Evaluates points of the lattice, at most once each."""

    def __init__(
        self, positions: MeasuredPath, spread: float = SOURCES.spread,
        smaller_spread: float = SOURCES.smaller_spread, finest: float = SOURCES.finest,
    ) -> None:
        """Take sigmas of the logarithm of the variance, also of a small one, and the lattice."""
        self._spread, self._smaller_spread, self.finest = spread, smaller_spread, finest
        # the kernel takes no other layout, which arrays of the past may have
        self.path = MeasuredPath(*map(np.ascontiguousarray, positions))
        self._heading = 0.0
        self._values: dict[Point, float] = {}
        self.lost: dict[Point, int] = {}  # how often the filter was lost
        # constant errors of odometry, of yaw rate and scale, and their variances
        self.constants: dict[Point, list[float]] = {}
        self._left = SOURCES.per_step
        # of the exponent of the time constant
        self.bounds = SOURCES.least_exponent, SOURCES.most_exponent

    def find_heading(self) -> Generator[None, None, None]:
        """Find the heading at the first position that makes white errors the most likely."""
        best = math.inf
        for angle in (2.0 * math.pi / SOURCES.headings * np.arange(SOURCES.headings)).tolist():
            value, *_ = filtered(*self.path, 1.0, 0.0, 1.0, 1.0, 1.0, angle, True)
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
            value, self.lost[point], *self.constants[point] = filtered(
                *self.path, tau, correlated, 2.0 ** way, 2.0 ** turn, white, self._heading,
                constant)
            total = math.log2(correlated + white)
            spread = self._spread if len(point) > 3 or total > 0.0 else self._smaller_spread
            self._values[point] = value + LOG_2**2 * (
                (total / spread) ** 2 + (way / SOURCES.way_spread) ** 2
                + (turn / SOURCES.turn_spread) ** 2)
            yield from self._pause()
        return self._values[point]

    def _pause(self) -> Generator[None, None, None]:
        self._left -= len(self.path.seconds)
        if self._left < 0:
            self._left = SOURCES.per_step
            yield

    def clipped(self, point: Point) -> Point:
        times = 1 if len(point) > 3 else 0
        bounds = self.bounds, (SOURCES.least_exponent, SOURCES.most_exponent)
        return tuple(min(max(exponent, low), high) for axis, exponent in enumerate(point)
                     for low, high in [bounds[axis >= times]])


def descend(
    evaluate: Evaluation, beginnings: list[Point], fixed: Collection[int] = (),
) -> Generator[None, None, Minimum]:
    """
    Return the best point near the best beginning, by steps that are halved.

    Axes are counted from the end; those that are `fixed` stay as they are.
    """
    values: list[Minimum] = []
    for point in beginnings:
        values.append(Minimum((yield from evaluate.value(point)), point))
    best, step = min(values), 1.0
    while step >= evaluate.finest:
        before = best
        for axis in range(-len(best.point), 0):
            if axis in fixed:
                continue
            for move in (step, -step):
                moved = list(best.point)
                moved[axis] += move
                point = evaluate.clipped(tuple(moved))
                best = min(best, Minimum((yield from evaluate.value(point)), point))
        if best.value == before.value:
            step /= 2.0
    return best
