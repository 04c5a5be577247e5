# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Compute the distances of the corrected path and of odometry alone from the truth and the fixes.

Paths are interpolated at the stamps of the truth or of the fixes; stamps outside a path are
ignored. Odometry has its own frame, so it is first aligned with the truth (or the fixes) by the
best rigid motion, which is the most favourable comparison for it. So is the truth with the path:
its map may begin elsewhere, as where only a part of a recording is replayed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import gammaincinv

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.similarity import fit_similarity
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.judgement.verdicts import State


@dataclass(frozen=True, slots=True)
class Drive:
    """Input and result of the pose graph, and the truth if it is known; all finite."""

    odometry: Trajectory  # raw odometry, `T_odom_base`
    fix_stamps_ns: IntArray  # stamps of the fixes, shape (M,) [ns]
    fix_positions: FloatArray  # positions of the fixes in the map, shape (M, 2) [m]
    fix_held_out: npt.NDArray[np.bool_]  # whether a fix was kept out of the pose graph, shape (M,)
    corrected: Trajectory  # result, `T_map_base`
    truth: Trajectory | None  # true poses, `T_map_base`; None if unknown
    loop_stamps_ns: IntArray  # stamps of both ends of the loop closures, shape (L, 2) [ns]
    map_axes: tuple[str, str] = ('x', 'y')  # names of the axes of the map
    fix_unused: npt.NDArray[np.bool_] | None = None
    """Whether a fix is doubted or waits, shape (M,); None if all are believed."""
    loop_states: Sequence[State] = ()
    """Of the loop closures; none if all are believed."""
    fix_refused: npt.NDArray[np.bool_] | None = None
    """Whether a fix is not in the graph, shape (M,); None if all are."""
    fix_sources: Sequence[str] = ()
    """Names of the sources of the fixes; none if unknown."""
    loop_sources: Sequence[str] = ()
    """The same of the loop closures."""
    truth_moved: tuple[float, float] | None = None
    """How far the truth was moved to fit the path [m, rad]; None if it was not."""

    @property
    def fix_kinds(self) -> dict[str, npt.NDArray[np.bool_]]:
        """Which fixes are used, doubted and held out, shape (M,) each; others are refused."""
        nothing = np.zeros_like(self.fix_held_out)
        refused = nothing if self.fix_refused is None else self.fix_refused
        doubted = nothing if self.fix_unused is None else self.fix_unused
        rest = ~self.fix_held_out & ~refused
        return {'used': rest & ~doubted, 'doubted': rest & doubted, 'held out': self.fix_held_out}

    def loops(self, *states: State) -> npt.NDArray[np.bool_]:
        """Return which loop closures are in one of some states, shape (L,)."""
        known = self.loop_states or [State.BELIEVED] * len(self.loop_stamps_ns)
        return np.array([state in states for state in known], dtype=bool)

    def __post_init__(self) -> None:
        count = len(self.fix_stamps_ns)
        shapes = self.fix_positions.shape, self.fix_held_out.shape, self.loop_stamps_ns.shape[1:]
        if shapes != ((count, 2), (count,), (2,)):
            raise ValueError(f'expected {count} positions (M, 2) and flags (M,) of fixes, and '
                             f'stamps of loop closures (L, 2), got {shapes}')
        if len(self.fix_held_out if self.fix_unused is None else self.fix_unused) != count or len(
                self.loop_states) not in (0, len(self.loop_stamps_ns)):
            raise ValueError('expected what is believed of all fixes (M,) and loop closures (L,)')
        paths = (self.odometry, self.corrected, *([] if self.truth is None else [self.truth]))
        values = (self.fix_positions, *(path.poses for path in paths))
        if not all(np.all(np.isfinite(array)) for array in values):
            raise ValueError('expected finite positions, got NaN or infinity')


@dataclass(frozen=True, slots=True)
class ErrorRow:
    """Statistics of at least one error of one kind."""

    name: str
    count: int
    median: float
    rms: float
    p95: float
    maximum: float
    unit: str = 'm'


def place_truth(drive: Drive) -> Drive:
    """Return a drive with the truth moved rigidly to where it fits the corrected path best."""
    truth = drive.truth
    if truth is None or not np.any(inside := drive.corrected.covers(truth.stamps_ns)):
        return drive
    before = truth.poses[inside, :2]
    pose = fit_similarity(before, drive.corrected.at(truth.stamps_ns[inside])[:, :2]).pose
    placed = Trajectory(truth.stamps_ns, se2.compose(pose, truth.poses))
    shift = np.mean(placed.poses[inside, :2] - before, axis=0)
    return replace(drive, truth=placed, truth_moved=(
        float(np.hypot(*shift)), abs(float(pose[2]))))


def place_odometry(drive: Drive) -> Trajectory:
    """Return the odometry laid over truth, else fixes, else result; as it is if none overlaps."""
    anchors = [(drive.fix_stamps_ns, drive.fix_positions),
               (drive.corrected.stamps_ns, drive.corrected.poses[:, :2])]
    if drive.truth is not None:
        anchors.insert(0, (drive.truth.stamps_ns, drive.truth.poses[:, :2]))
    for stamps, positions in anchors:
        inside = drive.odometry.covers(stamps)
        if np.any(inside):
            odometry = drive.odometry.at(stamps[inside])[:, :2]
            pose = fit_similarity(odometry, positions[inside]).pose
            return Trajectory(drive.odometry.stamps_ns, se2.compose(pose, drive.odometry.poses))
    return drive.odometry


def distances(
    path: Trajectory, stamps_ns: IntArray, positions: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """
    Return the distances of a path from positions at the stamps that the path covers.

    Parameters
    ----------
    stamps_ns : ndarray, shape (N,)
    positions : ndarray, shape (N, 2)
        In the frame of the path [m].

    Returns
    -------
    stamps_ns, distances : ndarray, shape (K,)
        Stamps that the path covers [ns], and distances at these [m].

    """
    inside = path.covers(stamps_ns)
    offsets = path.at(stamps_ns[inside])[:, :2] - positions[inside]
    return stamps_ns[inside], np.hypot(offsets[:, 0], offsets[:, 1])


def error_rows(name: str, errors: FloatArray, unit: str = 'm') -> list[ErrorRow]:
    """
    Return a list with the statistics of errors; an empty one without errors.

    Parameters
    ----------
    errors : ndarray, shape (N,)
        Absolute values.

    """
    return [] if len(errors) == 0 else [ErrorRow(
        name, len(errors), float(np.median(errors)), float(np.sqrt(np.mean(np.square(errors)))),
        float(np.percentile(errors, 95.0)), float(np.max(errors)), unit)]


def evaluate(drive: Drive) -> list[ErrorRow]:
    """Return the errors of odometry, fixes and path; a row without any is left out."""
    rows: list[ErrorRow] = []
    paths = {'odometry alone': place_odometry(drive), 'corrected path': drive.corrected}
    truth, stamps, positions = drive.truth, drive.fix_stamps_ns, drive.fix_positions
    if truth is not None:
        for name, path in paths.items():
            _, errors = distances(path, truth.stamps_ns, truth.poses[:, :2])
            rows += error_rows(f'{name} to truth', errors)
        doubted = drive.fix_kinds['doubted']
        rows[1:1] = [row for name, chosen in (('fixes', ~doubted), ('doubted fixes', doubted))
                     for row in error_rows(f'{name} to truth', distances(
                         truth, stamps[chosen], positions[chosen])[1])]
        inside = drive.corrected.covers(truth.stamps_ns)
        turns = se2.wrap(
            drive.corrected.at(truth.stamps_ns[inside])[:, 2] - truth.poses[inside, 2])
        rows += error_rows('corrected heading to truth', np.rad2deg(np.abs(turns)), 'deg')
    for kind, chosen in drive.fix_kinds.items():
        for name, path in paths.items():
            _, errors = distances(path, stamps[chosen], positions[chosen])
            rows += error_rows(f'{name} to fixes {kind}', errors)
    return rows


@dataclass(frozen=True, slots=True)
class Consistency:
    """The NEES of a path: squared errors in units of their covariances."""

    mean: float
    expected: int
    """What the mean is of covariances that are right."""
    interval: tuple[float, float]
    """Where the mean of so many independent errors is in 95 % of all cases."""
    within: float
    """Share below the 95 % quantile."""
    count: int


def consistency(drive: Drive, covariances: FloatArray) -> dict[str, Consistency | None]:
    """
    Return the NEES of the corrected path to the truth, of positions and of poses.

    It is None if there is no valid covariance. Covariances, shape (N, 3, 3), are in map axes, and
    NaN where there is none. The truth was moved to fit the path, which makes errors and so the
    NEES smaller; errors along a path are not independent, so that the true interval is wider.
    """
    truth, path = drive.truth, drive.corrected
    assert truth is not None, 'only a truth tells errors'
    inside = truth.covers(path.stamps_ns) & np.all(np.isfinite(covariances), axis=(1, 2))
    errors = path.poses[inside] - truth.at(path.stamps_ns[inside])
    errors[:, 2] = se2.wrap(errors[:, 2])
    found: dict[str, Consistency | None] = {}
    for name, size in (('position', 2), ('pose', 3)):
        blocks = covariances[inside][:, :size, :size]
        valid = np.linalg.eigvalsh(blocks)[:, 0] > 0.0
        e, n = errors[valid, :size, None], int(np.sum(valid))
        nees = np.sum(e * np.linalg.solve(blocks[valid], e), axis=(1, 2))
        # quantiles of chi-square
        low, high = 2.0 * gammaincinv(0.5 * max(n, 1) * size, (0.025, 0.975)) / max(n, 1)
        found[name] = None if n == 0 else Consistency(
            float(np.mean(nees)), size, (float(low), float(high)),
            float(np.mean(nees < 2.0 * gammaincinv(0.5 * size, 0.95))), n)
    return found


def consistency_lines(found: Mapping[str, Consistency | None]) -> list[str]:
    """Return the NEES as text."""
    return [f'NEES of the {name}: ' + ('no valid covariance' if each is None else (
        f'{each.mean:.4g}, expected {each.expected}, {each.interval[0]:.4f} to '
        f'{each.interval[1]:.4f} if errors were independent; {100.0 * each.within:.1f} % below '
        f'the 95 % quantile')) for name, each in found.items()]


def format_table(rows: Sequence[ErrorRow]) -> str:
    """Return the rows as a plain text table of less than 80 columns."""
    if len(rows) == 0:
        return 'nothing to compare: neither truth nor fixes overlap with the paths in time'
    width = max(len(row.name) for row in rows)
    lines = [f'{"":{width}}  {"median":>7} {"rms":>7} {"95 %":>7} {"max":>7}      {"count":>7}']
    for row in rows:
        values = ' '.join(f'{v:7.2f}' for v in (row.median, row.rms, row.p95, row.maximum))
        lines.append(f'{row.name:{width}}  {values} {row.unit:<4} {row.count:7}')
    return '\n'.join(lines)


def summary(
    drive: Drive, rows: Sequence[ErrorRow], extra: Mapping[str, Any],
) -> dict[str, Any]:
    """
    Return the figures of a drive as plain Python values, ready for JSON.

    Parameters
    ----------
    rows : sequence of ErrorRow, result of `evaluate`
    extra : mapping, further figures, which replace figures with the same name

    """
    stamps, positions = drive.corrected.stamps_ns, drive.corrected.poses[:, :2]
    steps = np.diff(positions, axis=0)
    return {
        'duration_s': float(stamps[-1] - stamps[0]) * 1e-9 if len(stamps) else 0.0,
        'distance_m': float(np.sum(np.hypot(steps[:, 0], steps[:, 1]))),
        'odometry': len(drive.odometry), 'poses': len(drive.corrected),
        **{f'fixes_{kind.replace(" ", "_")}': int(np.sum(chosen))
           for kind, chosen in drive.fix_kinds.items()},
        'fixes_refused': 0 if drive.fix_refused is None else int(np.sum(drive.fix_refused)),
        'loop_closures': len(drive.loop_stamps_ns), 'truth': drive.truth is not None,
        'errors': [asdict(row) for row in rows], **extra}
