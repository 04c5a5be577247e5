# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map of a run: paths, ellipses, fixes, closures and what is believed of them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.cli.drive import distances, Drive
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import Covariances, FloatArray, IntArray, Points
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.judgement.texts import Key, sentence
from pose_graph_ros.core.judgement.verdicts import Verdict
from pose_graph_ros.core.quantities import Metres, StampNs
from pose_graph_ros.offline.residuals.source_residuals import spread

STATES = ('believed', 'believed weakly', 'waiting', 'doubted', 'refused', 'held out')
"""What the numbers of states in run.json stand for."""
BELIEVED, REFUSED, HELD_OUT = 0, 4, 5
MOST_POSES = 10_000  # of a path
MOST_OF_SOURCE = 20_000  # fixes or loop closures; half are kept for those not believed


def rounded(values: npt.ArrayLike, digits: int = 3) -> list[Any]:
    """Return values as a list for JSON, None for those that are not finite."""
    array = np.round(np.asarray(values, dtype=np.float64), digits) + 0.0
    as_objects = array.astype(object)
    as_objects[~np.isfinite(array)] = None
    return list(as_objects.tolist())


def number(value: float | None, digits: int = 4) -> float | None:
    """Return a number with some significant digits; None if it is not finite."""
    return None if value is None or not math.isfinite(value) else float(f'{value:.{digits}g}')


def simplified(points: Points, tolerance: Metres = 0.015, most: int = 20_000) -> IntArray:
    """
    Return which points a line needs, increasing: no others are farther from it than the tolerance.

    This is the method of Douglas and Peucker, for all parts of a stretch at once. While more than
    `most` points are needed, those that are left are simplified again with twice the tolerance.
    """
    kept = _needed(points, tolerance)
    while len(kept) > most:
        tolerance = max(2.0 * tolerance, 1e-3)
        kept = kept[_needed(points[kept], tolerance)]
    return kept


def _needed(points: Points, tolerance: Metres) -> IntArray:
    """Return which points a line needs, stretch by stretch, as memory grows with their length."""
    n, stretch = len(points), 10_240
    if n <= 2:
        return np.arange(n)
    return np.unique(np.concatenate([
        begin + _needed_in_stretch(points[begin:begin + stretch + 1], tolerance)
        for begin in range(0, n - 1, stretch)]))


def _needed_in_stretch(points: Points, tolerance: Metres) -> IntArray:
    n = len(points)
    kept = np.unique(np.append(np.arange(0, n, 512), n - 1))  # some, so that rounds are few
    while True:
        part = np.clip(np.searchsorted(kept, np.arange(n), side='right') - 1, 0, len(kept) - 2)
        begin, along = points[kept][part], np.diff(points[kept], axis=0)[part]
        length2 = np.maximum(np.sum(along**2, axis=1), 1e-18)
        share = np.clip(np.sum((points - begin) * along, axis=1) / length2, 0.0, 1.0)
        far = np.hypot(*(points - begin - share[:, None] * along).T)
        largest = np.maximum.reduceat(far, kept[:-1])
        candidates = np.flatnonzero((far > tolerance) & (far == largest[part]))
        _, first = np.unique(part[candidates], return_index=True)
        if len(first) == 0:
            return kept
        kept = np.union1d(kept, candidates[first])


@dataclass(slots=True)
class Frame:
    """Where times and places of run.json begin, and the texts that its tables refer to."""

    start_ns: StampNs
    offset: FloatArray  # (2,) [m]
    texts: dict[str, int] = field(default_factory=dict)  # with their numbers, which are in order

    def seconds(self, stamps_ns: IntArray) -> list[float]:
        """Return stamps as seconds since the start."""
        return rounded((np.asarray(stamps_ns) - self.start_ns) * 1e-9)

    def places(self, points: Points, digits: int = 2) -> tuple[list[float], list[float]]:
        """Return x and y of points relative to the offset."""
        moved = np.asarray(points).reshape(-1, 2) - self.offset
        return rounded(moved[:, 0], digits), rounded(moved[:, 1], digits)

    def text(self, text: str) -> int:
        """Return the number of a text; -1 for an empty one."""
        return -1 if text == '' else self.texts.setdefault(text, len(self.texts))


def lines(drive: Drive, frame: Frame) -> tuple[dict[str, Any], IntArray]:
    """Return the paths, and the stamps of the poses of the corrected one [ns]."""
    def line(path: Trajectory, *, heading: bool = True, whole: bool = False) -> dict[str, Any]:
        kept = np.arange(len(path)) if whole and len(path) <= MOST_POSES else simplified(
            path.poses[:, :2], most=MOST_POSES)
        x, y = frame.places(path.poses[kept, :2])
        columns = {'t': frame.seconds(path.stamps_ns[kept]), 'x': x, 'y': y}
        return columns | ({'theta': rounded(path.poses[kept, 2])} if heading else {})

    corrected = line(drive.corrected, whole=True)
    stamps = np.round(np.array(corrected['t']) * 1e9).astype(np.int64) + frame.start_ns
    return {'corrected': corrected, 'odometry': line(drive.placed_odometry, heading=False),
            'truth': None if drive.truth is None else line(drive.truth)}, stamps


def ellipses(path: Trajectory, covariances: Covariances, frame: Frame) -> dict[str, Any]:
    """Return some 200 covariances of positions along a path, in map axes; NaN where unknown."""
    known = np.flatnonzero(np.all(np.isfinite(covariances), axis=(1, 2)))
    if len(known) == 0:
        return {name: [] for name in ('t', 'x', 'y', 'xx', 'xy', 'yy')}
    # evenly along the path and in time, so that stops and fast stretches both have some
    steps = np.hypot(*np.diff(path.poses[known, :2], axis=0).T)
    travelled = np.concatenate(([0.0], np.cumsum(steps)))
    times = (path.stamps_ns[known] - path.stamps_ns[known[0]]) * 1e-9
    measure = sum(each / max(each[-1], 1e-9) for each in (travelled, times))
    at = np.unique(np.searchsorted(measure, np.linspace(0.0, measure[-1], 200)))
    some = known[np.clip(at, 0, len(known) - 1)]
    x, y = frame.places(path.poses[some, :2])
    return {'t': frame.seconds(path.stamps_ns[some]), 'x': x, 'y': y,
            **{name: [number(value) for value in covariances[some, row, column].tolist()]
               for name, row, column in (('xx', 0, 0), ('xy', 0, 1), ('yy', 1, 1))}}


def _by_source(sources: Sequence[str], stamps: IntArray) -> Iterator[tuple[str, IntArray]]:
    """Yield sources with the rows of their measurements, by stamp."""
    for source in dict.fromkeys(sources):
        rows = np.flatnonzero(np.asarray(sources) == source)
        yield source, rows[np.argsort(stamps[rows], kind='stable')]


def _judged(
    verdicts: Sequence[Verdict | None], states: Sequence[int], whys: Sequence[str], frame: Frame,
) -> dict[str, Any]:
    """Return the columns of what is believed, and why not."""
    return {'state': list(states), 'why': [frame.text(why) for why in whys],
            'id': ['' if each is None else each.id for each in verdicts],
            # when they were judged [sigma]
            'd': rounded([np.nan if each is None else each.distance for each in verdicts], 2)}


def fixes(
    drive: Drive, verdicts: Sequence[Verdict], at_ns: IntArray, frame: Frame,
) -> list[dict[str, Any]]:
    """Return the fixes and global poses of each source; `at_ns` are stamps of the path."""
    known = {(each.source, each.stamp_ns): each for each in verdicts if each.reference_ns is None}
    refused = drive.fix_kinds['refused']
    found = []
    sources = drive.fix_sources or ['fix'] * len(drive.fix_stamps_ns)
    for source, every in _by_source(sources, drive.fix_stamps_ns):
        states = np.select([drive.fix_held_out[every], refused[every]], [HELD_OUT, REFUSED], [
            _state(known.get((source, stamp))) for stamp in drive.fix_stamps_ns[every].tolist()])
        some = _shown(states)
        rows, states = every[some], states[some]
        stamps = drive.fix_stamps_ns[rows]
        judged = [known.get((source, stamp)) for stamp in stamps.tolist()]
        x, y = frame.places(drive.fix_positions[rows])
        columns = _judged(judged, states.tolist(), [
            '' if verdict is None or state in (BELIEVED, HELD_OUT)
            else sentence(verdict, frame.start_ns)
            for verdict, state in zip(judged, states.tolist(), strict=True)], frame)
        found.append({
            'source': source, 'left_out': len(every) - len(rows), 't': frame.seconds(stamps),
            'x': x, 'y': y,
            **columns, 'id': columns['id'] if any(judged) else None,
            'held_out': drive.fix_held_out[rows].astype(int).tolist(),
            'at': _nearest(stamps, at_ns)})
    return found


def closures(
    drive: Drive, verdicts: Sequence[Verdict], refused: Mapping[Key, str], frame: Frame,
) -> list[dict[str, Any]]:
    """Return the loop closures of each source, in the order of their later ends."""
    known = {(each.source, each.stamp_ns, each.reference_ns): each for each in verdicts}
    found = []
    sources = drive.loop_sources or ['loop_closure'] * len(drive.loop_stamps_ns)
    for source, rows in _by_source(sources, drive.loop_stamps_ns[:, 1]):
        keys = [(source, later, earlier) for earlier, later in drive.loop_stamps_ns[rows].tolist()]
        states = np.array([REFUSED if key in refused and key not in known
                           else _state(known.get(key)) for key in keys], dtype=np.int64)
        some = _shown(states)
        keys, ends = [keys[k] for k in some], np.sort(drive.loop_stamps_ns[rows[some]], axis=1)
        judged = [known.get(key) for key in keys]
        path = drive.corrected
        places = path.at(np.clip(ends, *path.stamps_ns[[0, -1]]))[:, :, :2]
        (x0, y0), (x1, y1) = frame.places(places[:, 0]), frame.places(places[:, 1])
        found.append({
            'source': source, 'left_out': len(rows) - len(keys),
            't0': frame.seconds(ends[:, 0]), 't1': frame.seconds(ends[:, 1]),
            'x0': x0, 'y0': y0, 'x1': x1, 'y1': y1, **_judged(judged, states[some].tolist(), [
                refused.get(key, '') if verdict is None else sentence(verdict, frame.start_ns)
                for key, verdict in zip(keys, judged, strict=True)], frame)})
    return found


def _state(verdict: Verdict | None) -> int:
    return BELIEVED if verdict is None else STATES.index(verdict.state.value)


def errors(drive: Drive, covariances: Covariances, frame: Frame) -> dict[str, Any] | None:
    """
    Return the errors of the path over time; None without a truth and fixes that are held out.

    Covariances are those of the corrected path, NaN where unknown.
    """
    path, truth, odometry = drive.corrected, drive.truth, drive.placed_odometry
    if truth is not None:
        against, stamps, places = 'truth', truth.stamps_ns, truth.poses
    else:
        order = np.argsort(drive.fix_stamps_ns, kind='stable')
        order = order[drive.fix_held_out[order]]
        against, stamps, places = (
            'held-out fixes', drive.fix_stamps_ns[order], drive.fix_positions[order])
    inside = np.flatnonzero(path.covers(stamps))
    if len(inside) == 0:
        return None
    some = inside[spread(len(inside), 2000)]
    stamps, places = stamps[some], places[some]
    _, far = distances(path, stamps, places[:, :2])
    by_odometry = np.full(len(stamps), np.nan)
    by_odometry[odometry.covers(stamps)] = distances(odometry, stamps, places[:, :2])[1]
    sigma = np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1])
    at = np.clip(np.searchsorted(path.stamps_ns, stamps), 0, len(path) - 1)
    return {'against': against, 't': frame.seconds(stamps), 'position': rounded(far),
            'heading': None if truth is None else rounded(
                se2.wrap(path.at(stamps)[:, 2] - places[:, 2]), 4),
            'sigma': None if not np.any(np.isfinite(sigma)) else rounded(sigma[at]),
            'odometry': rounded(by_odometry)}


def _shown(states: IntArray) -> IntArray:
    """Return which measurements of a source are in run.json: of very many, only some."""
    believed = np.isin(states, (BELIEVED, HELD_OUT))
    others, rest = np.flatnonzero(~believed), np.flatnonzero(believed)
    others = others[spread(len(others), MOST_OF_SOURCE // 2)]
    return np.sort(np.append(others, rest[spread(len(rest), MOST_OF_SOURCE - len(others))]))


def _nearest(stamps: IntArray, at_ns: IntArray) -> list[int]:
    """Return the index of the nearest of sorted stamps for each stamp, -1 for those outside."""
    after = np.clip(np.searchsorted(at_ns, stamps), 0, len(at_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(at_ns[before] - stamps) < np.abs(at_ns[after] - stamps)
    inside = (stamps >= at_ns[0] - 1_000_000) & (stamps <= at_ns[-1] + 1_000_000)
    return list(np.where(inside, np.where(nearer, before, after), -1).tolist())
