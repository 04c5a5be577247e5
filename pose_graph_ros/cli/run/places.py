# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map of a run: paths, ellipses, fixes, closures and what is believed of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.cli.evaluation import distances, Drive, place_odometry
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.judgement.texts import Key, sentence
from pose_graph_ros.core.judgement.verdicts import State, Verdict
from pose_graph_ros.core.residuals.source_residuals import spread

TOLERANCE = 0.015
"""Distance between a line and the points that are left out [m]."""
_CHUNK = 512  # a point is kept in every so many, so that few rounds are needed
_STRETCH = 20 * _CHUNK  # number of points that are looked at together


def rounded(values: npt.ArrayLike, digits: int = 3) -> list[Any]:
    """
    Return values as a list for JSON, None for those that are not finite.

    Parameters
    ----------
    values : array_like, of any shape
    digits : int, after the point

    """
    array = np.round(np.asarray(values, dtype=np.float64), digits) + 0.0
    if np.all(np.isfinite(array)):
        return list(array.tolist())
    as_objects = array.astype(object)
    as_objects[~np.isfinite(array)] = None
    return list(as_objects.tolist())


def number(value: float | None, digits: int = 4) -> float | None:
    """
    Return a number with some significant digits; None if it is not finite.

    Parameters
    ----------
    value : float or None
    digits : int

    """
    return None if value is None or not math.isfinite(value) else float(f'{value:.{digits}g}')


def simplified(points: FloatArray, tolerance: float = TOLERANCE, most: int = 20_000) -> IntArray:
    """
    Return which points a line needs, shape (K,), increasing.

    This is the method of Douglas and Peucker, for all parts of a stretch at once. While more than
    `most` points are needed, those that are left are simplified again with twice the tolerance.

    Parameters
    ----------
    points : ndarray, shape (N, 2)
    tolerance : float, distance from the line up to which a point may be left out [m]
    most : int, at least 2

    """
    kept = _needed(points, tolerance)
    while len(kept) > most:
        tolerance = max(2.0 * tolerance, 1e-3)
        kept = kept[_needed(points[kept], tolerance)]
    return kept


def _needed(points: FloatArray, tolerance: float) -> IntArray:
    """Return which points a line needs, stretch by stretch, as memory grows with their length."""
    n = len(points)
    if n <= 2:
        return np.arange(n)
    return np.unique(np.concatenate([
        begin + _needed_in_stretch(points[begin:begin + _STRETCH + 1], tolerance)
        for begin in range(0, n - 1, _STRETCH)]))


def _needed_in_stretch(points: FloatArray, tolerance: float) -> IntArray:
    n = len(points)
    kept = np.unique(np.append(np.arange(0, n, _CHUNK), n - 1))
    while True:
        part = np.clip(np.searchsorted(kept, np.arange(n), side='right') - 1, 0, len(kept) - 2)
        far = _distances(points, points[kept][part], points[kept][part + 1])
        largest = np.maximum.reduceat(far, kept[:-1])
        candidates = np.flatnonzero((far > tolerance) & (far == largest[part]))
        _, first = np.unique(part[candidates], return_index=True)
        if len(first) == 0:
            return kept
        kept = np.union1d(kept, candidates[first])


def _distances(points: FloatArray, begin: FloatArray, end: FloatArray) -> FloatArray:
    """Return the distances of points from line segments, shape (N,)."""
    along = end - begin
    length2 = np.maximum(np.sum(along**2, axis=1), 1e-18)
    share = np.clip(np.sum((points - begin) * along, axis=1) / length2, 0.0, 1.0)
    return np.asarray(np.hypot(*(points - begin - share[:, None] * along).T))


STATES = ('believed', 'believed weakly', 'waiting', 'doubted', 'refused', 'held out')
"""What the numbers of states in run.json stand for."""
BELIEVED, REFUSED, HELD_OUT = 0, 4, 5
_NUMBERS = {state: STATES.index(state.value) for state in State}
# Most points of a path, of a series of errors, and ellipses.
MOST_POSES, MOST_ERRORS, MOST_ELLIPSES = 10_000, 2000, 200
# Most fixes, and most loop closures, of a source; half of them are kept for those not believed.
MOST_OF_SOURCE = 20_000


@dataclass(slots=True)
class Frame:
    """Where times and places of run.json begin, and the texts that its tables refer to."""

    start_ns: int
    offset: FloatArray
    """Shape (2,) [m]."""
    texts: list[str] = field(default_factory=list)
    _known: dict[str, int] = field(default_factory=dict)

    def seconds(self, stamps_ns: IntArray) -> list[float]:
        """Return stamps as seconds since the start."""
        return rounded((np.asarray(stamps_ns) - self.start_ns) * 1e-9)

    def places(self, points: FloatArray, digits: int = 2) -> tuple[list[float], list[float]]:
        """
        Return x and y of points relative to the offset.

        Parameters
        ----------
        points : ndarray, shape (N, 2) [m]
        digits : int

        """
        moved = np.asarray(points).reshape(-1, 2) - self.offset
        return rounded(moved[:, 0], digits), rounded(moved[:, 1], digits)

    def text(self, text: str) -> int:
        """Return the number of a text; -1 for an empty one."""
        if text == '':
            return -1
        if text not in self._known:
            self._known[text] = len(self.texts)
            self.texts.append(text)
        return self._known[text]


def lines(drive: Drive, frame: Frame) -> tuple[dict[str, Any], IntArray]:
    """Return the paths, and the stamps of the poses of the corrected one [ns]."""
    def line(path: Trajectory, *, heading: bool, whole: bool = False) -> dict[str, Any]:
        kept = np.arange(len(path)) if whole and len(path) <= MOST_POSES else simplified(
            path.poses[:, :2], most=MOST_POSES)
        x, y = frame.places(path.poses[kept, :2])
        columns = {'t': frame.seconds(path.stamps_ns[kept]), 'x': x, 'y': y}
        return columns | ({'theta': rounded(path.poses[kept, 2])} if heading else {})

    corrected = line(drive.corrected, heading=True, whole=True)
    stamps = np.round(np.array(corrected['t']) * 1e9).astype(np.int64) + frame.start_ns
    return {'corrected': corrected, 'odometry': line(place_odometry(drive), heading=False),
            'truth': None if drive.truth is None else line(drive.truth, heading=True)}, stamps


def ellipses(path: Trajectory, covariances: FloatArray, frame: Frame) -> dict[str, Any]:
    """
    Return the covariances of positions along a path, in map axes.

    Parameters
    ----------
    covariances : ndarray, shape (P, 3, 3), NaN where unknown

    """
    known = np.flatnonzero(np.all(np.isfinite(covariances), axis=(1, 2)))
    if len(known) == 0:
        return {name: [] for name in ('t', 'x', 'y', 'xx', 'xy', 'yy')}
    # evenly along the path and in time, so that stops and fast stretches both have some
    steps = np.hypot(*np.diff(path.poses[known, :2], axis=0).T)
    travelled = np.concatenate(([0.0], np.cumsum(steps)))
    times = (path.stamps_ns[known] - path.stamps_ns[known[0]]) * 1e-9
    measure = sum(each / max(each[-1], 1e-9) for each in (travelled, times))
    at = np.unique(np.searchsorted(measure, np.linspace(0.0, measure[-1], MOST_ELLIPSES)))
    some = known[np.clip(at, 0, len(known) - 1)]
    x, y = frame.places(path.poses[some, :2])
    cov = covariances[some]
    return {'t': frame.seconds(path.stamps_ns[some]), 'x': x, 'y': y,
            'xx': _significant(cov[:, 0, 0]), 'xy': _significant(cov[:, 0, 1]),
            'yy': _significant(cov[:, 1, 1])}


def _significant(values: FloatArray) -> list[float]:
    return [float(f'{value:.4g}') for value in values.tolist()]


def fixes(
    drive: Drive, verdicts: Sequence[Verdict], at_ns: IntArray, frame: Frame,
) -> list[dict[str, Any]]:
    """
    Return the fixes and global poses of each source.

    Parameters
    ----------
    verdicts : sequence of Verdict, all that there are
    at_ns : ndarray of int, stamps of the poses of the corrected line [ns]

    """
    known = {(each.source, each.stamp_ns): each for each in verdicts if each.reference_ns is None}
    sources = np.array(drive.fix_sources or ['fix'] * len(drive.fix_stamps_ns), dtype=str)
    found = []
    for source in dict.fromkeys(sources.tolist()):
        rows = np.flatnonzero(sources == source)
        rows = rows[np.argsort(drive.fix_stamps_ns[rows], kind='stable')]
        stamps, held_out = drive.fix_stamps_ns[rows], drive.fix_held_out[rows]
        each = [known.get((source, stamp)) for stamp in stamps.tolist()]
        refused = np.zeros_like(held_out) if drive.fix_refused is None else (
            drive.fix_refused[rows])
        states = [HELD_OUT if out else REFUSED if no else BELIEVED if verdict is None
                  else _NUMBERS[verdict.state] for out, no, verdict in zip(
                      held_out.tolist(), refused.tolist(), each, strict=True)]
        shown = _shown(states)
        left_out = len(rows) - len(shown)
        rows, stamps, held_out = rows[shown], stamps[shown], held_out[shown]
        each, states = [each[k] for k in shown.tolist()], [states[k] for k in shown.tolist()]
        x, y = frame.places(drive.fix_positions[rows])
        found.append({
            'source': source, 'left_out': left_out,
            't': frame.seconds(stamps), 'x': x, 'y': y, 'state': states,
            'why': [-1 if verdict is None or state in (BELIEVED, HELD_OUT)
                    else frame.text(sentence(verdict, frame.start_ns))
                    for verdict, state in zip(each, states, strict=True)],
            'held_out': held_out.astype(int).tolist(),
            'id': None if not any(each) else [
                '' if verdict is None else verdict.id for verdict in each],
            'd': rounded([np.nan if verdict is None else verdict.distance for verdict in each], 2),
            'at': _nearest(stamps, at_ns)})
    return found


def closures(
    drive: Drive, verdicts: Sequence[Verdict], refused: Mapping[Key, str], frame: Frame,
) -> list[dict[str, Any]]:
    """
    Return the loop closures of each source, in the order of their later ends.

    Parameters
    ----------
    verdicts : sequence of Verdict
    refused : mapping, why closures were refused

    """
    known = {(each.source, each.stamp_ns, each.reference_ns): each for each in verdicts}
    sources = np.array(
        drive.loop_sources or ['loop_closure'] * len(drive.loop_stamps_ns), dtype=str)
    found = []
    for source in dict.fromkeys(sources.tolist()):
        rows = np.flatnonzero(sources == source)
        rows = rows[np.argsort(drive.loop_stamps_ns[rows, 1], kind='stable')]
        ends = np.sort(drive.loop_stamps_ns[rows], axis=1)
        keys = [(source, later, earlier) for earlier, later in drive.loop_stamps_ns[rows].tolist()]
        states = [_NUMBERS[known[key].state] if key in known
                  else REFUSED if key in refused else BELIEVED for key in keys]
        shown = _shown(states)
        left_out = len(rows) - len(shown)
        rows, ends = rows[shown], ends[shown]
        why, ids, far = list[int](), list[str](), list[float]()
        for key in [keys[k] for k in shown.tolist()]:
            verdict = known.get(key)
            reason = refused.get(key, '')
            why.append(frame.text(reason if verdict is None
                                  else sentence(verdict, frame.start_ns)))
            ids.append('' if verdict is None else verdict.id)
            far.append(np.nan if verdict is None else verdict.distance)
        first, last = drive.corrected.stamps_ns[[0, -1]]
        places = drive.corrected.at(np.clip(ends, first, last))[:, :, :2]
        (x0, y0), (x1, y1) = frame.places(places[:, 0]), frame.places(places[:, 1])
        found.append({
            'source': source, 'left_out': left_out,
            't0': frame.seconds(ends[:, 0]), 't1': frame.seconds(ends[:, 1]),
            'x0': x0, 'y0': y0, 'x1': x1, 'y1': y1,
            'state': [states[k] for k in shown.tolist()], 'why': why, 'id': ids,
            'd': rounded(far, 2)})
    return found


def errors(drive: Drive, covariances: FloatArray, frame: Frame) -> dict[str, Any] | None:
    """
    Return the errors of the path over time; None without a truth and fixes that are held out.

    Parameters
    ----------
    covariances : ndarray, shape (P, 3, 3), of the corrected path, NaN where unknown

    """
    path, truth, odometry = drive.corrected, drive.truth, place_odometry(drive)
    if truth is not None:
        stamps = truth.stamps_ns[path.covers(truth.stamps_ns)]
        against, places = 'truth', truth.at(stamps) if len(stamps) > 0 else np.empty((0, 3))
    else:
        out = drive.fix_held_out & path.covers(drive.fix_stamps_ns)
        order = np.argsort(drive.fix_stamps_ns[out], kind='stable')
        stamps, positions = drive.fix_stamps_ns[out][order], drive.fix_positions[out][order]
        against, places = 'held-out fixes', np.column_stack((positions, np.zeros(len(stamps))))
    if len(stamps) == 0:
        return None
    some = spread(len(stamps), MOST_ERRORS)
    stamps, places = stamps[some], places[some]
    _, far = distances(path, stamps, places[:, :2])
    by_odometry = np.full(len(stamps), np.nan)
    covered = odometry.covers(stamps)
    by_odometry[covered] = distances(odometry, stamps, places[:, :2])[1]
    sigma = np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1])
    at = np.clip(np.searchsorted(path.stamps_ns, stamps), 0, len(path) - 1)
    heading = None if truth is None else rounded(
        se2.wrap(path.at(stamps)[:, 2] - places[:, 2]), 4)
    return {'against': against, 't': frame.seconds(stamps), 'position': rounded(far),
            'heading': heading,
            'sigma': None if not np.any(np.isfinite(sigma)) else rounded(sigma[at]),
            'odometry': rounded(by_odometry)}


def _shown(states: Sequence[int]) -> IntArray:
    """Return which measurements are in run.json: of very many that are believed, only some."""
    believed = np.isin(states, (BELIEVED, HELD_OUT))
    others, rest = np.flatnonzero(~believed), np.flatnonzero(believed)
    others = others[spread(len(others), MOST_OF_SOURCE // 2)]
    return np.sort(np.append(others, rest[spread(len(rest), MOST_OF_SOURCE - len(others))]))


def _nearest(stamps: IntArray, at_ns: IntArray) -> list[int]:
    """Return the index of the nearest of sorted stamps for each stamp, -1 for those outside."""
    if len(at_ns) == 0:
        return [-1] * len(stamps)
    after = np.clip(np.searchsorted(at_ns, stamps), 0, len(at_ns) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(at_ns[before] - stamps) < np.abs(at_ns[after] - stamps)
    inside = (stamps >= at_ns[0] - 1_000_000) & (stamps <= at_ns[-1] + 1_000_000)
    return list(np.where(inside, np.where(nearer, before, after), -1).tolist())
