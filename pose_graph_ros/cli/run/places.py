# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map of a run: paths, ellipses, fixes, closures and what is believed of them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from pose_graph_ros.cli.drive import BELIEVED, distances, Drive, HELD_OUT, REFUSED
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import Covariances, FloatArray, IntArray, Points
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.judgement.texts import Key, sentence
from pose_graph_ros.core.judgement.verdicts import Verdict
from pose_graph_ros.core.quantities import StampNs
from pose_graph_ros.offline.residuals.source_residuals import spread

REFUSED_SOMEHOW = 'Refused; the counts of its source say why.'
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
    def places(path: Trajectory | None) -> dict[str, Any] | None:
        return None if path is None else dict(zip('xy', frame.places(
            path.poses[spread(len(path), MOST_POSES), :2]), strict=True))

    path = drive.corrected
    some = spread(len(path), MOST_POSES)
    return {'corrected': {'t': frame.seconds(path.stamps_ns[some]), **(places(path) or {}),
                          'theta': rounded(path.poses[some, 2])},
            'odometry': places(drive.placed_odometry),
            'truth': places(drive.truth)}, path.stamps_ns[some]


def ellipses(path: Trajectory, covariances: Covariances, frame: Frame) -> dict[str, Any]:
    """Return some 200 covariances of positions along a path, in map axes; NaN where unknown."""
    known = np.flatnonzero(np.all(np.isfinite(covariances), axis=(1, 2)))
    if len(known) == 0:
        return {name: [] for name in ('x', 'y', 'xx', 'xy', 'yy')}
    # evenly along the path and in time, so that stops and fast stretches both have some
    steps = np.hypot(*np.diff(path.poses[known, :2], axis=0).T)
    travelled = np.concatenate(([0.0], np.cumsum(steps)))
    times = (path.stamps_ns[known] - path.stamps_ns[known[0]]) * 1e-9
    measure = sum(each / max(each[-1], 1e-9) for each in (travelled, times))
    at = np.unique(np.searchsorted(measure, np.linspace(0.0, measure[-1], 200)))
    some = known[np.clip(at, 0, len(known) - 1)]
    x, y = frame.places(path.poses[some, :2])
    return {'x': x, 'y': y,
            **{name: [number(value) for value in covariances[some, row, column].tolist()]
               for name, row, column in (('xx', 0, 0), ('xy', 0, 1), ('yy', 1, 1))}}


def _by_source(sources: Sequence[str], stamps: IntArray) -> Iterator[tuple[str, IntArray]]:
    """Yield sources with the rows of their measurements, by stamp."""
    for source in dict.fromkeys(sources):
        rows = np.flatnonzero(np.asarray(sources) == source)
        yield source, rows[np.argsort(stamps[rows], kind='stable')]


def _judged(
    keys: Sequence[Key], states: IntArray, verdicts: Mapping[Key, Verdict],
    reasons: Mapping[Key, str], frame: Frame,
) -> dict[str, Any]:
    """Return the columns of what is believed, and why not."""
    found = [verdicts.get(key) for key in keys]
    whys = []
    for key, state, each in zip(keys, states.tolist(), found, strict=True):
        # of fixes nearly all are believed, for the same reason
        silent = state == HELD_OUT or (state == BELIEVED and key[2] is None)
        whys.append(reasons.get(key, REFUSED_SOMEHOW) if state == REFUSED
                    else '' if silent or each is None else sentence(each, frame.start_ns))
    return {'state': states.tolist(), 'why': [frame.text(why) for why in whys],
            'id': ['' if each is None else each.id for each in found],
            # when they were judged [sigma]
            'd': rounded([np.nan if each is None else each.distance for each in found], 2)}


def fixes(
    drive: Drive, verdicts: Mapping[Key, Verdict], at_ns: IntArray, frame: Frame,
) -> list[dict[str, Any]]:
    """Return the fixes and global poses of each source; `at_ns` are stamps of the path."""
    found = []
    for source, every in _by_source(drive.fix_sources, drive.fix_stamps_ns):
        rows = every[_shown(drive.fix_states[every])]
        stamps = drive.fix_stamps_ns[rows]
        x, y = frame.places(drive.fix_positions[rows])
        found.append({
            'source': source, 'left_out': len(every) - len(rows), 't': frame.seconds(stamps),
            'x': x, 'y': y, 'at': _nearest(stamps, at_ns), **_judged(
                [(source, stamp, None) for stamp in stamps.tolist()], drive.fix_states[rows],
                verdicts, {}, frame)})
    return found


def closures(
    drive: Drive, verdicts: Mapping[Key, Verdict], reasons: Mapping[Key, str], frame: Frame,
) -> list[dict[str, Any]]:
    """Return the loop closures of each source, in the order of their later ends."""
    path, found = drive.corrected, []
    for source, every in _by_source(drive.loop_sources, drive.loop_stamps_ns[:, 1]):
        rows = every[_shown(drive.loop_states[every])]
        stamps = drive.loop_stamps_ns[rows]
        ends = np.sort(stamps, axis=1)
        places = path.at(np.clip(ends, *path.stamps_ns[[0, -1]]))[:, :, :2]
        (x0, y0), (x1, y1) = frame.places(places[:, 0]), frame.places(places[:, 1])
        found.append({
            'source': source, 'left_out': len(every) - len(rows),
            't0': frame.seconds(ends[:, 0]), 't1': frame.seconds(ends[:, 1]),
            'x0': x0, 'y0': y0, 'x1': x1, 'y1': y1, **_judged(
                [(source, later, earlier) for earlier, later in stamps.tolist()],
                drive.loop_states[rows], verdicts, reasons, frame)})
    return found


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
        order = order[drive.fix_states[order] == HELD_OUT]
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
