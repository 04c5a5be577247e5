# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Drives with fixes of which some are wrong, as receivers and localisers are: what is believed when.

Every fault is made of a clean drive, so that the truth is known, and begins at half of its time.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmark import drives
from benchmark.drives import Kind, SECOND
from benchmark.robust_closures import drain
from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import GlobalPose, Measurement, OdometrySample, Position

UPDATE_EVERY = SECOND
WON = 3.0
"""The newest pose is right if its error is at most this [m]."""
WATCHED = 300 * SECOND
"""Time after a fault in which the newest pose must be right again [ns]."""
SIGMA = 1.0
"""Of the fixes [m]."""


@dataclass(frozen=True, slots=True)
class Drive:
    """Odometry, truth and fixes of one drive, perhaps with a fault."""

    odometry: Trajectory
    truth: Trajectory
    stamps_ns: IntArray
    """Of the fixes, shape (M,)."""
    fixes: FloatArray
    """Shape (M, 2) [m]."""
    wrong: frozenset[tuple[str, int]] = frozenset()
    """Source and stamp of each wrong measurement."""
    fault_ns: tuple[int, int] = (0, 0)
    """When the wrong ones come; they are to be doubted in this time."""
    good_ns: int = 0
    """When what is right comes again; 0: there is no such time."""
    others: tuple[tuple[str, Measurement], ...] = ()
    """Of other sources."""

    @property
    def middle_ns(self) -> int:
        """When faults begin."""
        stamps = self.odometry.stamps_ns
        return int(stamps[0] + stamps[-1]) // 2

    def events(self) -> list[tuple[str, OdometrySample | Measurement]]:
        """Return what comes, by stamp."""
        events: list[tuple[str, OdometrySample | Measurement]] = [
            ('odom', OdometrySample(stamp, pose)) for stamp, pose in zip(
                self.odometry.stamps_ns.tolist(), self.odometry.poses, strict=True)]
        events += [('fix', Position(stamp, fix, SIGMA**2 * np.eye(2), np.zeros(2)))
                   for stamp, fix in zip(self.stamps_ns.tolist(), self.fixes, strict=True)]
        return sorted([*events, *self.others], key=lambda event: event[1].stamp_ns)

    def offset(self, begin_s: float, end_s: float, by: tuple[float, float]) -> 'Drive':
        """Move the fixes of a time since the middle [s] by so much [m]."""
        chosen = self._in(begin_s, end_s)
        fixes = self.fixes + np.where(chosen[:, None], by, 0.0)
        stamps = self.stamps_ns[chosen].tolist()
        end_ns = self.middle_ns + round(end_s * SECOND)
        return replace(self, fixes=fixes, fault_ns=(stamps[0], end_ns), good_ns=end_ns,
                       wrong=self.wrong | {('fix', stamp) for stamp in stamps})

    def silent(self, begin_s: float, end_s: float) -> 'Drive':
        """Leave out the fixes of a time since the middle [s]."""
        kept = ~self._in(begin_s, end_s)
        return replace(self, stamps_ns=self.stamps_ns[kept], fixes=self.fixes[kept],
                       good_ns=self.middle_ns + round(end_s * SECOND))

    def _in(self, begin_s: float, end_s: float) -> np.ndarray:
        since = (self.stamps_ns - self.middle_ns) / SECOND
        return (since >= begin_s) & (since < end_s)


def plaza(folder: Path, seed: int) -> Drive:
    """Read the drive of a lawn mower, `odom.csv` and `gt.csv`, and make fixes of its truth."""
    odometry, truth = (np.genfromtxt(folder / name, delimiter=',', skip_header=1)
                       for name in ('odom.csv', 'gt.csv'))
    odometry, truth = (rows[np.append(True, np.diff(np.round(rows[:, 0] * 1e9)) > 0)]
                       for rows in (odometry, truth))
    return _drive(*(Trajectory(np.round(rows[:, 0] * 1e9).astype(np.int64), rows[:, 1:4])
                    for rows in (odometry, truth)), seed)


def simulated(seed: int) -> Drive:
    """Simulate a drive of 15 minutes at 1 m/s."""
    drive = drives.simulate(
        Kind('', duration=900.0, odometry_rate=5.0), seed, OdometryNoise())
    return _drive(Trajectory(drive.stamps_ns, drive.odometry),
                  Trajectory(drive.stamps_ns, drive.truth), seed)


def _drive(odometry: Trajectory, truth: Trajectory, seed: int) -> Drive:
    stamps = np.arange(odometry.stamps_ns[0] + SECOND,
                       min(odometry.stamps_ns[-1], truth.stamps_ns[-1]), SECOND)
    fixes = truth.at(stamps)[:, :2] + np.random.default_rng(seed).normal(
        0.0, SIGMA, (len(stamps), 2))
    return Drive(odometry, truth, stamps, fixes)


def _jumps(drive: Drive, rng: np.random.Generator) -> Drive:
    chosen = rng.random(len(drive.fixes)) < 0.2
    angle, far = (rng.uniform(*limits, len(chosen)) for limits in ((0.0, 7.0), (20.0, 50.0)))
    off = np.column_stack((far * np.cos(angle), far * np.sin(angle)))
    wrong = frozenset(('fix', stamp) for stamp in drive.stamps_ns[chosen].tolist())
    return replace(drive, fixes=drive.fixes + np.where(chosen[:, None], off, 0.0), wrong=wrong,
                   fault_ns=(int(drive.stamps_ns[0]), int(drive.stamps_ns[-1])))


def _multipath(drive: Drive, rng: np.random.Generator) -> Drive:
    """Return errors to one side, in stretches of 20 to 60 s, in a quarter of the time."""
    fixes, wrong = drive.fixes.copy(), set[tuple[str, int]]()
    end = float(drive.odometry.stamps_ns[-1] - drive.middle_ns) / SECOND
    at = -end + 60.0
    while at < end:
        length = rng.uniform(20.0, 60.0)
        chosen = drive._in(at, at + length)     # noqa: SLF001
        angle, far = rng.uniform(-np.pi, np.pi), 4.0 + rng.exponential(15.0)
        fixes[chosen] += far * np.array((np.cos(angle), np.sin(angle))) + rng.normal(
            0.0, 1.0, (int(np.sum(chosen)), 2))
        wrong |= {('fix', stamp) for stamp in drive.stamps_ns[chosen].tolist()}
        at += length + rng.uniform(60.0, 180.0)
    return replace(drive, fixes=fixes, wrong=frozenset(wrong),
                   fault_ns=(int(drive.stamps_ns[0]), int(drive.stamps_ns[-1])))


def _moved(path: Trajectory, at_ns: int, by: FloatArray, lasting_s: float = 0.0) -> Trajectory:
    """Return a path that continues, from a time on, after a motion in the robot's frame."""
    poses = path.poses.copy()
    late = path.stamps_ns >= at_ns
    at = path.at(at_ns)
    share = np.minimum((path.stamps_ns[late] - at_ns) / max(lasting_s * SECOND, 1.0), 1.0)
    moved = se2.compose(at, share[:, None] * by)
    poses[late] = se2.compose(moved, se2.between(at, poses[late]))
    return Trajectory(path.stamps_ns, poses)


def _slip(drive: Drive, _: np.random.Generator) -> Drive:
    silent = drive.silent(0.0, 60.0)
    return replace(silent, odometry=_moved(
        drive.odometry, drive.middle_ns + 25 * SECOND, np.array((10.0, 0.0, 0.0)), 10.0))


def _restart(drive: Drive, _: np.random.Generator) -> Drive:
    return replace(drive, good_ns=drive.middle_ns, odometry=_moved(
        drive.odometry, drive.middle_ns, np.array((5.0, 1.0, 0.3))))


def _kidnapped(drive: Drive, _: np.random.Generator) -> Drive:
    truth = _moved(drive.truth, drive.middle_ns, np.array((30.0, 20.0, 0.7)))
    late = drive.stamps_ns >= drive.middle_ns
    off = truth.at(drive.stamps_ns)[:, :2] - drive.truth.at(drive.stamps_ns)[:, :2]
    return replace(drive, truth=truth, good_ns=drive.middle_ns,
                   fixes=drive.fixes + np.where(late[:, None], off, 0.0))


def _two_receivers(drive: Drive, rng: np.random.Generator) -> Drive:
    stamps = drive.stamps_ns[:-1] + SECOND // 3
    fixes = drive.truth.at(stamps)[:, :2] + rng.normal(0.0, SIGMA, (len(stamps), 2))
    second = replace(drive, stamps_ns=stamps, fixes=fixes).offset(0.0, 120.0, (20.0, 15.0))
    others = tuple(('second', Position(stamp, fix, SIGMA**2 * np.eye(2), np.zeros(2)))
                   for stamp, fix in zip(stamps.tolist(), second.fixes, strict=True))
    return replace(drive, others=others, fault_ns=second.fault_ns, good_ns=second.good_ns,
                   wrong=frozenset(('second', stamp) for _, stamp in second.wrong))


def _amcl(drive: Drive, rng: np.random.Generator) -> Drive:
    """Return poses of a localiser that is in the wrong corridor for 40 s, and no fixes."""
    sigma = np.array((0.2, 0.2, 0.05))
    poses = drive.truth.at(drive.stamps_ns) + rng.normal(size=(len(drive.stamps_ns), 3)) * sigma
    lost = drive._in(0.0, 40.0)     # noqa: SLF001
    poses[lost] = se2.compose(poses[lost], np.array((0.0, 12.0, 0.0)))
    begin, end = drive.middle_ns, drive.middle_ns + 40 * SECOND
    return replace(
        drive, stamps_ns=drive.stamps_ns[:0], fixes=drive.fixes[:0], fault_ns=(begin, end),
        good_ns=end, wrong=frozenset(
            ('amcl', stamp) for stamp in drive.stamps_ns[lost].tolist()),
        others=tuple(('amcl', GlobalPose(stamp, pose, np.diag(sigma**2)))
                     for stamp, pose in zip(drive.stamps_ns.tolist(), poses, strict=True)))


CLEAN = 'clean'
FAULTS: dict[str, Callable[[Drive, np.random.Generator], Drive]] = {
    CLEAN: lambda drive, _: drive,
    'a fifth jump by 20 to 50 m': _jumps,
    '60 s without, then 30 s all 40 m aside': lambda drive, _: drive.silent(
        0.0, 60.0).offset(60.0, 90.0, (24.0, 32.0)),
    '60 s without, in which odometry slips by 10 m': _slip,
    'the receiver begins again, 100 m off for 60 s': lambda drive, _: drive.offset(
        0.0, 60.0, (80.0, -60.0)),
    'multipath, to one side, for 20 to 60 s each': _multipath,
    'two receivers, one 25 m aside for 120 s': _two_receivers,
    'a localiser in the wrong corridor for 40 s': _amcl,
    'odometry begins again, 5 m off': _restart,
    'the robot is carried by 36 m': _kidnapped,
}


@dataclass(slots=True)
class Outcome:
    """What came of a drive with fixes."""

    rms: float
    """Of the path at the end [m]."""
    newest: float
    """Of the newest pose, over all updates [m]."""
    worst: float
    """Largest error of the newest pose from the fault on [m]."""
    won: float
    """Time from when what is right comes until the newest pose stays right [s]."""
    said: float
    """Share of the updates in the fault at which some fix of it waits or is doubted."""
    wrong_believed: int
    right_doubted: int
    n_wrong: int
    errors: dict[int, float] = field(default_factory=dict)


def run(drive: Drive) -> Outcome:
    """Feed a drive with all settings at their defaults."""
    backend = PoseGraphBackend()
    errors: dict[int, float] = {}
    said: list[bool] = []
    due = 0
    for source, event in drive.events():
        if not isinstance(event, OdometrySample):
            backend.add_measurement(event, source)
            continue
        backend.add_odometry(event)
        if event.stamp_ns < due:
            continue
        due = event.stamp_ns + UPDATE_EVERY
        backend.update()
        drain(backend)
        estimate = backend.estimate(with_path=False)
        if estimate is None or estimate.alignment is not AlignmentState.ALIGNED:
            continue
        if drive.truth.covers(estimate.stamp_ns):
            off = estimate.T_map_base - drive.truth.at(estimate.stamp_ns)
            errors[estimate.stamp_ns] = float(np.hypot(off[0], off[1]))
        if drive.fault_ns[0] + 2 * SECOND <= event.stamp_ns < drive.fault_ns[1]:
            said.append(len(doubted(backend) & drive.wrong) > 0)
    backend.optimize()
    estimate = backend.estimate()
    assert estimate is not None
    path = estimate.path
    inside = drive.truth.covers(path.stamps_ns)
    off = path.poses[inside] - drive.truth.at(path.stamps_ns[inside])
    refused = doubted(backend)
    after = {stamp: error for stamp, error in errors.items()
             if drive.good_ns <= stamp < drive.good_ns + WATCHED}
    late = [stamp for stamp, error in after.items() if error > WON]
    since = min(drive.fault_ns[0] or drive.good_ns, drive.good_ns)
    return Outcome(
        float(np.sqrt(np.mean(np.sum(off[:, :2]**2, axis=1)))),
        float(np.sqrt(np.mean(np.square(list(errors.values()))))),
        max((error for stamp, error in errors.items() if stamp >= since > 0), default=np.nan),
        (max(late, default=drive.good_ns) - drive.good_ns) / SECOND if drive.good_ns else np.nan,
        float(np.mean(said)) if len(said) > 0 else np.nan,
        len(drive.wrong - refused), len(refused - drive.wrong), len(drive.wrong), errors)


def doubted(backend: PoseGraphBackend) -> set[tuple[str, int]]:
    """Return source and stamp of all measurements that do not take part at present."""
    if not hasattr(backend, 'verdicts'):
        return set()
    return {(verdict.source, verdict.stamp_ns) for verdict in backend.verdicts()
            if not verdict.state.in_graph and verdict.reference_ns is None}
