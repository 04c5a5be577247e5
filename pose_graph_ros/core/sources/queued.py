# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Constraints on their way into the graph; some wait until there is a landmark."""

from collections import Counter
from collections.abc import Callable
from typing import Annotated, Final, NamedTuple

import numpy as np

from pose_graph_ros.core import measurements as ms, saved_columns
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors, RECORD
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

NO_NOISE: Final[FloatArray] = np.zeros(2)


class Queued(NamedTuple):
    """
    A constraint for the next update, or in it, with what is needed to add, to name and to undo it.

    An end at a state of the bias of its source is -1 until it is added.
    """

    source: str
    factor: Annotated[Factors, saved_columns.Column(RECORD)]  # one row
    stamp_ns: int = -1  # of the measurement [ns]; -1 for an edge of odometry
    reference_ns: int = -1  # stamp of the other end of a loop closure [ns]; else -1
    # what the motion since the node adds to the variances of its position and heading
    noise: saved_columns.Numbers = NO_NOISE
    number: int = -1  # its id in the graph, once it is in an update
    held_by: int = -1  # id of the edge that holds it instead of the observed node `number`, or -1

    @property
    def held(self) -> int:
        """Id of the factor that holds it."""
        return self.held_by if self.held_by >= 0 else self.number

    @property
    def measured(self) -> type[ms.PoseMeasurement]:
        """What was measured; `LoopClosure` for all edges between poses."""
        kinds = {FactorKind.GLOBAL_POSE: ms.GlobalPose, FactorKind.POSITION: ms.Position,
                 FactorKind.HEADING: ms.HeadingOnly, FactorKind.RANGE: ms.Range}
        return kinds.get(FactorKind(int(self.factor.kind[0])), ms.LoopClosure)

    @property
    def nodes(self) -> list[int]:
        """Ids of the nodes that it is on, without biases."""
        return [int(end[0]) for end in (self.factor.i, self.factor.j) if end[0] >= 0]

    @property
    def is_in_map(self) -> bool:
        """Whether it is a measurement relative to the map."""
        factor = self.factor
        return bool(factor.kind[0] >= FactorKind.GLOBAL_POSE and factor.j[0] < 0 <= factor.i[0])

    @property
    def is_placed(self) -> bool:
        """Whether it is one that contains a position: not if it is a heading."""
        return self.is_in_map and int(self.factor.kind[0]) != FactorKind.HEADING

    @property
    def needs_bias(self) -> bool:
        """Whether one of its ends is a state of the bias, as those of a gyroscope."""
        return len(self.nodes) == 0 or int(self.factor.kind[0]) == FactorKind.TURN


# --- beacons: landmarks of the graph, whose distances from points of the robot are measured
#
# A beacon at a given place is held there, once the graph lies in the map. One at an unknown place
# starts when ranges determine it, and they wait until then. With a_k the points in the map that
# they were measured from and r_k the ranges, |b - a_k| = r_k, and differences of the squares are
# linear in the place b:
#
#     2 (a_k - mean a) . b = |a_k|^2 - r_k^2 - mean (|a|^2 - r^2)
#
# A straight way leaves two places, which shows in the covariance of this system. The place where a
# beacon starts is no measurement of it, so the optimum does not depend on it.

HELD = 0.01  # sigma of a given place [m]
LOOSE = 1000.0  # sigma of a start that is no measurement, relative to a node [m]
MOST_WAITING = 500  # ranges of a beacon that wait; the oldest are dropped
MOST_BEACONS = 100  # beacons whose ranges wait; those of the oldest are dropped
DETERMINED = 0.2  # sigma of the place below which it is determined, as a share of the ranges
DRIFT = 0.02  # of the way between the points, as a share


class WaitingRange(NamedTuple):
    queued: Queued  # an edge to the landmark -1
    measurement: ms.Range


class Beacons:
    """The landmarks of beacons by name, and the ranges of those that have none yet."""

    def __init__(self, counts: Counter[tuple[str, str]]) -> None:
        self.ids: dict[str, int] = {}
        self._counts = counts  # of answers, by source
        self._waiting: dict[str, list[WaitingRange]] = {}
        self._next_try: dict[str, int] = {}  # number of ranges at which a beacon is located next

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    @property
    def measurements(self) -> list[tuple[str, ms.Range]]:
        """The ranges that wait, with their sources."""
        return [(each.queued.source, each.measurement)
                for ranges in self._waiting.values() for each in ranges]

    def add(self, waiting: WaitingRange) -> None:
        """Add a range, which `take_ready` returns once the beacon has a landmark."""
        ranges = self._waiting.setdefault(waiting.measurement.beacon, [])
        ranges.append(waiting)
        dropped = ranges[:-MOST_WAITING]
        del ranges[:-MOST_WAITING]
        if len(self._waiting) > MOST_BEACONS:
            oldest = next(iter(self._waiting))
            dropped += self._waiting.pop(oldest)
            self._next_try.pop(oldest, None)
        for each in dropped:
            self._counts[each.queued.source, 'dropped_unlocated'] += 1

    def take_ready(self, graph: Graph, apply: Callable[[GraphUpdate], bool], *,
                   aligned: bool) -> list[Queued]:
        """
        Take the ranges that can be added to the graph, after making the landmarks for them.

        `apply` changes the graph, and returns whether it could.
        """
        ready: list[Queued] = []
        for beacon, ranges in [*self._waiting.items()]:
            kept = [each for each in ranges if graph.node_rows(each.queued.factor.i)[0] >= 0]
            for gone in ranges[:len(ranges) - len(kept)]:
                self._counts[gone.queued.source, 'before_window'] += 1
            self._waiting[beacon] = kept
            if beacon not in self.ids and len(kept) > 0:
                landmark = graph.next_ids.node
                start = self._start(beacon, graph, aligned=aligned)
                if start is not None and apply(start):
                    self.ids[beacon] = landmark
            if beacon in self.ids:
                ready += [each.queued._replace(factor=each.queued.factor.replaced(
                    j=[self.ids[beacon]])) for each in kept]
            if beacon in self.ids or len(kept) == 0:
                del self._waiting[beacon]
                self._next_try.pop(beacon, None)
        return ready

    def _start(self, beacon: str, graph: Graph, *, aligned: bool) -> GraphUpdate | None:
        """Return the update that makes the landmark of a beacon; None if it cannot start yet."""
        ranges, landmark = self._waiting[beacon], graph.next_ids.node
        given = ranges[-1].measurement.place
        if given is not None:
            return None if not aligned else GraphUpdate(landmarks=given[None], factors=Factors.on(
                [landmark], None, *_held(given, HELD), [FactorKind.POSITION]))
        if len(ranges) < self._next_try.get(beacon, 3):
            return None
        # again when there are a fifth more; of the most that wait, with each
        self._next_try[beacon] = min(len(ranges) + len(ranges) // 5 + 1, MOST_WAITING)
        edges = Factors.joined([each.queued.factor for each in ranges])
        poses = graph.poses_of(edges.i)
        place = located(se2.transform(poses, edges.constants[:, :2]), edges.mean[:, 0],
                        1.0 / np.sqrt(edges.information[:, 0, 0]))
        if place is None:
            return None
        seen = se2.transform(se2.inverse(poses[-1]), place)
        return GraphUpdate(landmarks=place[None], factors=Factors(
            edges.i[-1:], [landmark], *_held(seen, LOOSE), [FactorKind.POINT]))


def _held(place: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return mean and information of a place, one row each."""
    return (np.append(place, 0.0)[None], np.diag((sigma**-2, sigma**-2, 0.0))[None])


def located(points: FloatArray, ranges: FloatArray, sigmas: FloatArray) -> FloatArray | None:
    """Return the place of a beacon by ranges from points, shape (M, 2); None if undetermined."""
    centre = np.mean(points, axis=0)
    points = points - centre
    sigmas = sigmas + DRIFT * np.hypot(points[:, 0], points[:, 1])
    weights = (2.0 * np.maximum(ranges, sigmas) * sigmas)**-2
    squares = np.sum(points**2, axis=1) - ranges**2
    rows = 2.0 * (points - np.average(points, axis=0, weights=weights))
    normal = rows.T @ (weights[:, None] * rows)
    if np.linalg.eigvalsh(normal)[0] * (DETERMINED * np.median(ranges))**2 < 1.0:
        return None
    place = np.linalg.solve(normal, rows.T @ (
        weights * (squares - np.average(squares, weights=weights))))
    for _ in range(20):
        away = place - points
        distances = np.hypot(away[:, 0], away[:, 1]) + 1e-9
        errors, rows = (distances - ranges) / sigmas, away / (distances * sigmas)[:, None]
        robust = 1.0 / (1.0 + (errors / 3.0)**2)
        try:
            place = place - np.linalg.solve(
                rows.T @ (robust[:, None] * rows), rows.T @ (robust * errors))
        except np.linalg.LinAlgError:   # so far away that all ranges are parallel
            return None
    # if they do not agree, more of them will
    return np.asarray(place + centre) if np.median(np.abs(errors)) < 3.0 else None
