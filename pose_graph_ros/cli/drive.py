# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A drive: what was measured, the corrected path, how far they are apart, and the files of these.

Paths are interpolated at the stamps of the truth or of the fixes; stamps outside a path are
ignored. Odometry has its own frame, so it is first aligned with the truth (or the fixes) by the
best rigid motion, which is the most favourable comparison for it. So is the truth with the path:
its map may begin elsewhere, as where only a part of a recording is replayed.
"""

from array import array
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from pose_graph_ros.adapters.bags import Bag, Inputs, MessageError, read_inputs, reader_of
from pose_graph_ros.adapters.sources import MessageReader, ODOMETRY
from pose_graph_ros.cli.truth import Heighted, is_known, path_of, Truth, UNKNOWN
from pose_graph_ros.core import measurements as ms
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.geometry import geodesy, se2
from pose_graph_ros.core.geometry.se2 import BoolArray, Covariances, FloatArray, IntArray, Points
from pose_graph_ros.core.geometry.trajectory import fit_motion, Trajectory
from pose_graph_ros.core.judgement.texts import Key
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.quantities import StampNs
from pose_graph_ros.offline import noise

STATES = (State.BELIEVED.value, State.WEAKLY_BELIEVED.value, State.WAITING.value,
          State.DOUBTED.value, 'refused', 'held out')
BELIEVED, WEAKLY_BELIEVED, WAITING, DOUBTED, REFUSED, HELD_OUT = range(len(STATES))
"""What became of a measurement: the states of verdicts, not in the graph, kept out of it."""


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


@dataclass(frozen=True)
class Drive:
    """Input and result of the pose graph, and the truth if it is known; all finite."""

    odometry: Trajectory  # raw, `T_odom_base`
    corrected: Trajectory  # result, `T_map_base`
    truth: Trajectory | None  # `T_map_base`, headings may be NaN; None if unknown
    fix_stamps_ns: IntArray  # (M,)
    fix_positions: Points  # in the map, (M, 2)
    fix_states: IntArray  # numbers of `STATES`, (M,)
    fix_sources: Sequence[str]
    loop_stamps_ns: IntArray  # of both ends of the loop closures, (L, 2)
    loop_states: IntArray  # numbers of `STATES`, (L,)
    loop_sources: Sequence[str]
    map_axes: tuple[str, str] = ('x', 'y')
    arrived_ns: 'Mapping[str, Sequence[StampNs]]' = field(default_factory=dict)
    """Stamps of what was measured, in the order of arrival, by source."""
    odometry_heights: FloatArray = field(default_factory=lambda: np.zeros(0))   # [m]
    truth_heights: FloatArray = field(default_factory=lambda: np.zeros(0))  # NaN: unknown [m]
    damage: Sequence[str] = ()  # what is missing in its bags
    truth_moved: tuple[float, float] | None = None  # to fit the path [m, rad]; None: it was not

    @property
    def fix_kinds(self) -> dict[str, BoolArray]:
        """Which fixes are used, doubted or waiting, held out and refused, shape (M,) each."""
        states = self.fix_states
        return {'used': states <= WEAKLY_BELIEVED, 'doubted': np.isin(states, (WAITING, DOUBTED)),
                'held out': states == HELD_OUT, 'refused': states == REFUSED}

    @cached_property
    def placed_odometry(self) -> Trajectory:
        """Odometry laid over truth, else fixes, else result; as it is if none overlaps."""
        for stamps, positions in (
                *(() if self.truth is None else [(self.truth.stamps_ns, self.truth.poses[:, :2])]),
                (self.fix_stamps_ns, self.fix_positions),
                (self.corrected.stamps_ns, self.corrected.poses[:, :2])):
            if np.any(inside := self.odometry.covers(stamps)):
                pose = fit_motion(self.odometry.at(stamps[inside])[:, :2], positions[inside])
                return Trajectory(self.odometry.stamps_ns, se2.compose(pose, self.odometry.poses))
        return self.odometry

    @cached_property
    def rows(self) -> list[ErrorRow]:
        """The errors of odometry, fixes and path; a row without any is left out."""
        rows: list[ErrorRow] = []
        odometry, path, truth = self.placed_odometry, self.corrected, self.truth
        of_kind = {kind: (self.fix_stamps_ns[chosen], self.fix_positions[chosen])
                   for kind, chosen in self.fix_kinds.items()}
        if truth is not None:
            true = truth.stamps_ns, truth.poses[:, :2]
            known, kinds = is_known(truth, self.fix_stamps_ns), self.fix_kinds
            ours, doubted = ((self.fix_stamps_ns[chosen], self.fix_positions[chosen])
                             for chosen in (known & ~kinds['doubted'], known & kinds['doubted']))
            for name, one, other in (
                    ('odometry alone', odometry, true),
                    ('fixes', truth, ours), ('doubted fixes', truth, doubted),
                    ('corrected path', path, true)):
                rows += error_rows(f'{name} to truth', distances(one, *other)[1])
            inside = path.covers(truth.stamps_ns) & np.isfinite(truth.poses[:, 2])
            rows += error_rows('corrected heading to truth', np.rad2deg(np.abs(se2.wrap(
                path.at(truth.stamps_ns[inside])[:, 2] - truth.poses[inside, 2]))), 'deg')
        for kind in ('used', 'doubted', 'held out'):
            for name, one in (('odometry alone', odometry), ('corrected path', path)):
                rows += error_rows(f'{name} to fixes {kind}', distances(one, *of_kind[kind])[1])
        return rows


def place_truth(drive: Drive, truth: Truth = UNKNOWN) -> Drive:
    """Return a drive with its truth where that is compared with the corrected path."""
    if drive.truth is None:
        return drive
    placed, turn = truth.placed(drive.truth, drive.corrected)
    if turn is None:
        return drive
    inside = drive.corrected.covers(placed.stamps_ns)
    shift = np.mean((placed.poses - drive.truth.poses)[inside, :2], axis=0)
    return replace(drive, truth=placed, truth_moved=(float(np.hypot(*shift)), turn))


def with_truth(drive: Drive, truth: Truth, known: Heighted | None) -> Drive:
    """Return a drive with the true poses, if they are known, where they are compared."""
    return drive if known is None else place_truth(
        replace(drive, truth=known[0], truth_heights=known[1]), truth)


def distances(path: Trajectory, stamps_ns: IntArray,
              positions: Points) -> tuple[IntArray, FloatArray]:
    """Return the stamps that a path covers, and its distances from positions at these [m]."""
    inside = path.covers(stamps_ns)
    offsets = path.at(stamps_ns[inside])[:, :2] - positions[inside]
    return stamps_ns[inside], np.hypot(offsets[:, 0], offsets[:, 1])


def extent(path: Trajectory) -> tuple[float, float]:
    """Return the duration [s] and the length [m] of a path."""
    stamps, steps = path.stamps_ns, np.diff(path.poses[:, :2], axis=0)
    return (float(stamps[-1] - stamps[0]) * 1e-9 if len(stamps) > 0 else 0.0,
            float(np.sum(np.hypot(steps[:, 0], steps[:, 1]))))


def lengths(drive: Drive) -> dict[str, float | None]:
    """
    Return the lengths of path, odometry and truth during the path [m], for JSON.

    They are those in the plane, and with the heights of the poses where these are known.
    """
    found: dict[str, float | None] = {'path': extent(drive.corrected)[1]}
    for name, path, heights in (('odometry', drive.odometry, drive.odometry_heights),
                                ('truth', drive.truth, drive.truth_heights)):
        found |= {name: None, f'{name}_with_heights': None}
        if path is not None and np.any(inside := drive.corrected.covers(path.stamps_ns)):
            flat = np.hypot(*np.diff(path.poses[inside, :2], axis=0).T)
            up = np.diff(heights[inside]) if len(heights) == len(path) else np.zeros(0)
            found[name] = float(np.sum(flat))
            if np.any(up) and np.all(np.isfinite(up)):
                found[f'{name}_with_heights'] = float(np.sum(np.hypot(flat, up)))
    return found


def error_rows(name: str, errors: FloatArray, unit: str = 'm') -> list[ErrorRow]:
    """Return a list with the statistics of errors; an empty one without errors."""
    return [] if len(errors) == 0 else [ErrorRow(
        name, len(errors), float(np.median(errors)), float(np.sqrt(np.mean(np.square(errors)))),
        float(np.percentile(errors, 95.0)), float(np.max(errors)), unit)]


def consistency(drive: Drive, covariances: Covariances) -> dict[str, dict[str, Any] | None]:
    """
    Return the NEES of the corrected path to the truth, of positions and of poses, for JSON.

    It is None if there is no valid covariance. Covariances are in map axes, and NaN where there is
    none. Where they are relative to a fixed node, whose own is zero, the errors are, too. Else the
    truth was moved to fit the path, which makes errors and so the NEES smaller. Errors along a
    path are not independent, so that the true interval is wider.
    """
    truth, path = drive.truth, drive.corrected
    assert truth is not None, 'only a truth tells errors'
    inside = is_known(truth, path.stamps_ns) & np.all(np.isfinite(covariances), axis=(1, 2))
    true, poses = truth.at(path.stamps_ns[inside]), path.poses[inside]
    if np.any(np.isfinite(true[:, 2])) and np.any(np.all(covariances == 0.0, axis=(1, 2))):
        # a truth may begin just after the fixed node: the surest one that it covers is as good
        surest = int(np.argmin(np.trace(covariances[inside], axis1=1, axis2=2)))
        true = se2.compose(se2.compose(poses[surest], se2.inverse(true[surest])), true)
    errors = poses - true
    errors[:, 2] = se2.wrap(errors[:, 2])
    found: dict[str, dict[str, Any] | None] = {}
    for name, size in (('position', 2), ('pose', 3)):
        blocks = covariances[inside][:, :size, :size]
        valid = (np.linalg.eigvalsh(blocks)[:, 0] > 0.0) & np.isfinite(errors[:, size - 1])
        e, n = errors[valid, :size, None], int(np.sum(valid))
        nees = np.sum(e * np.linalg.solve(blocks[valid], e), axis=(1, 2))
        # quantiles of chi-square
        interval = 2.0 * gammaincinv(0.5 * max(n, 1) * size, (0.025, 0.975)) / max(n, 1)
        found[name] = None if n == 0 else {
            'mean': float(np.mean(nees)), 'expected': size, 'interval': interval.tolist(),
            'within': float(np.mean(nees < 2.0 * gammaincinv(0.5 * size, 0.95))), 'count': n}
    return found


def format_table(rows: Sequence[ErrorRow]) -> str:
    """Return the rows as a plain text table of less than 80 columns."""
    if len(rows) == 0:
        return 'nothing to compare: neither truth nor fixes overlap with the paths in time'
    width = max(len(row.name) for row in rows)
    return '\n'.join([
        f'{"":{width}}  {"median":>7} {"rms":>7} {"95 %":>7} {"max":>7}      {"count":>7}',
        *(f'{row.name:{width}}  {row.median:7.2f} {row.rms:7.2f} {row.p95:7.2f} '
          f'{row.maximum:7.2f} {row.unit:<4} {row.count:7}' for row in rows)])


def summary(drive: Drive, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a drive as plain Python values, ready for JSON."""
    duration, distance = extent(drive.corrected)
    return {'duration_s': duration, 'distance_m': distance, 'odometry': len(drive.odometry),
            'lengths_m': lengths(drive), 'poses': len(drive.corrected), **{
                f'fixes_{kind.replace(" ", "_")}': int(
                np.sum(chosen)) for kind, chosen in drive.fix_kinds.items()},
            'loop_closures': len(drive.loop_stamps_ns), 'truth': drive.truth is not None,
            'errors': [asdict(row) for row in drive.rows], **extra}


class Recorded(NamedTuple):
    """A measurement of a recording."""

    source: str
    measurement: ms.OdometrySample | ms.Measurement
    held_out: bool = False  # of the graph
    height: float = math.nan  # of the pose of odometry [m], NaN if unknown


def measured_in(bag: Bag, inputs: Inputs, reader: MessageReader, refused: Counter[tuple[str, str]],
                *, held_out: bool) -> Iterator[Recorded]:
    """Yield the valid measurements of a bag, with those that are held out if they are wanted."""
    start_ns: StampNs | None = None
    for source, message, is_held_out in read_inputs(bag, inputs):
        if is_held_out and not held_out:
            continue
        try:
            content = message.decode()
            measurement = reader.read(source, content)
        except MessageError:
            measurement = ms.rejected('malformed', '')
        if isinstance(measurement, ms.Answer):
            refused[source, measurement.reason] += 1
            continue
        if isinstance(measurement, ms.OdometrySample):
            start_ns = measurement.stamp_ns if start_ns is None else start_ns
        is_in_stretch = (
            inputs.stretch is not None and start_ns is not None
            and isinstance(measurement, ms.Fix | ms.GlobalPose | ms.Position) and noise.is_in_part(
                measurement.stamp_ns, start_ns, inputs.stretch, inputs.hold_out - 1,
                inputs.hold_out))
        if held_out or not is_in_stretch:
            yield Recorded(source, measurement, is_held_out or is_in_stretch, (
                content.pose.pose.position.z if inputs.kinds[source] is ODOMETRY else math.nan))


def drive_in(bag: Bag, inputs: Inputs, values: Mapping[str, Any], backend: PoseGraphBackend,
             truth: Truth = UNKNOWN, *, origin: geodesy.MapOrigin | None,
             refused: Collection[Key] | None = None) -> Drive:
    """
    Return the path of an engine together with the measurements of the bag that it is made of.

    Without the `origin` of its map, the first fix on the path makes it. Raises `BagError` if the
    topic of the truth is missing or of an unsupported type. Else as `collect_drive`.
    """
    reader = reader_of(bag, values)
    if origin is not None:
        reader.datum.keep(origin)
    is_on_earth = len(inputs.fixes) > 0 and not any(values['datum'][2:])
    drive = collect_drive(measured_in(bag, inputs, reader, Counter(), held_out=True), backend,
                          inputs.odometry[0], refused)
    drive = replace(drive, map_axes=('east', 'north') if is_on_earth else ('x', 'y'),
                    damage=[*bag.damage.values()])
    return with_truth(drive, truth, truth.read(bag, inputs.span, reader.datum.plane))


def collect_drive(measurements: Iterable[Recorded], backend: PoseGraphBackend,
                  odometry_source: str, refused: Collection[Key] | None) -> Drive:
    """
    Return the path of an engine together with the measurements that it is made of.

    Loop closures without a verdict are believed but for those that were `refused`; None if it is
    not known which: then all of sources that are judged.
    """
    estimate, verdicts = backend.estimate(), backend.verdicts()
    assert estimate is not None, 'a drive has a hidden node'
    corrected = estimate.path
    loops, sources, held = list[Key](), list[str](), list[bool]()
    odometry = array('q'), array('d'), array('d')
    fixes = list[ms.Fix | ms.GlobalPose | ms.Position]()
    arrived: dict[str, array[int]] = {}
    for source, measurement, held_out, height in measurements:
        arrived.setdefault(source, array('q')).append(measurement.stamp_ns)
        match measurement:
            case ms.Fix() | ms.GlobalPose() | ms.Position():
                fixes.append(measurement)
                sources.append(source)
                held.append(held_out)
            case ms.LoopClosure(stamp, _, _, int(reference)):
                loops.append((source, stamp, reference))
            case ms.OdometrySample(stamp, pose) if source == odometry_source:
                odometry[0].append(stamp)
                odometry[1].extend(pose)
                odometry[2].append(height)
    stamps = np.array([each.stamp_ns for each in fixes], dtype=np.int64)
    arms = np.array([np.zeros(2) if isinstance(each, ms.GlobalPose) else each.lever_arm
                     for each in fixes]).reshape(-1, 2)
    inside, positions = corrected.covers(stamps), np.zeros((len(fixes), 2))
    # a fix that can have been used makes the datum, if there is none
    for k in sorted(range(len(fixes)), key=lambda k: held[k] or not inside[k]):
        each = fixes[k]
        positions[k] = each.placed().position if isinstance(each, ms.Fix) else (
            each.pose[:2] if isinstance(each, ms.GlobalPose) else each.position)
    if np.any(arms):  # from the antenna to the robot, with the heading of the corrected path
        turn = corrected.at(stamps[inside]) * (0.0, 0.0, 1.0)
        positions[inside] -= se2.transform(turn, arms[inside])
    known = {(each.source, each.stamp_ns, each.reference_ns): STATES.index(each.state.value)
             for each in verdicts}
    judged = {each.source for each in verdicts}
    states = np.array([known.get((source, stamp, None), BELIEVED) for source, stamp in zip(
        sources, stamps.tolist(), strict=True)], dtype=np.int64)
    kept_out = np.array(held, dtype=bool)
    # those that the graph has not from its begin on are refused
    lost = stamps >= int(backend.node_stamps_ns[estimate.n_frozen])
    for source, added in backend.measured().items():
        at = np.flatnonzero(
            (np.array(sources, dtype=str) == source) & np.isin(stamps, added) & ~kept_out)
        # of several with one stamp the first one was added
        lost[at[np.unique(stamps[at], return_index=True)[1]]] = False
    refused = {key for key in loops if key[0] in judged} if refused is None else refused
    path, heights = path_of(*odometry)
    return Drive(
        path, corrected, None, stamps, positions,
        np.where(kept_out, HELD_OUT, np.where(lost, REFUSED, states)), sources,
        np.array([(earlier, later) for _, later, earlier in loops], np.int64).reshape(-1, 2),
        np.array([known.get(key, REFUSED if key in refused else BELIEVED) for key in loops], int),
        [source for source, _, _ in loops], arrived_ns=arrived, odometry_heights=heights)
