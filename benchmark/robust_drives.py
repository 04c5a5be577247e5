# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives with fixes, recorded or simulated, whose measurements can be changed."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmark import drives
from benchmark.drives import Kind, SECOND
from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import Measurement, OdometrySample, Position

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
    sigma: float = SIGMA
    """What the fixes claim [m]."""

    @property
    def middle_ns(self) -> int:
        """When most faults begin."""
        stamps = self.odometry.stamps_ns
        return int(stamps[0] + stamps[-1]) // 2

    def events(self) -> list[tuple[str, OdometrySample | Measurement]]:
        """Return what comes, by stamp."""
        events: list[tuple[str, OdometrySample | Measurement]] = [
            ('odom', OdometrySample(stamp, pose)) for stamp, pose in zip(
                self.odometry.stamps_ns.tolist(), self.odometry.poses, strict=True)]
        events += [
            ('fix', Position(stamp, fix, self.sigma**2 * np.eye(2), np.zeros(2)))
            for stamp, fix in zip(self.stamps_ns.tolist(), self.fixes, strict=True)]
        return sorted([*events, *self.others], key=lambda event: event[1].stamp_ns)

    def only_right(self) -> 'Drive':
        """Return the drive without what is wrong."""
        kept = np.array([('fix', stamp) not in self.wrong for stamp in self.stamps_ns.tolist()],
                        dtype=bool)
        others = tuple((source, one) for source, one in self.others
                       if (source, one.stamp_ns) not in self.wrong)
        return replace(self, stamps_ns=self.stamps_ns[kept], fixes=self.fixes[kept],
                       others=others, wrong=frozenset())

    def moved(self, chosen: BoolArray, by: FloatArray) -> 'Drive':
        """
        Move some of the fixes, which are wrong then.

        Parameters
        ----------
        chosen : ndarray of bool, shape (M,)
        by : ndarray, shape (2,) or (M, 2) [m]

        """
        wrong = frozenset(('fix', stamp) for stamp in self.stamps_ns[chosen].tolist())
        first = int(self.stamps_ns[chosen][0]) if chosen.any() else 0
        last = int(self.stamps_ns[chosen][-1]) + 1 if chosen.any() else 0
        return replace(self, fixes=self.fixes + np.where(chosen[:, None], by, 0.0),
                       wrong=self.wrong | wrong, fault_ns=(first, last))

    def offset(self, begin_s: float, end_s: float, by: FloatArray) -> 'Drive':
        """Move the fixes of a time since the middle [s] by so much, shape (2,) [m]."""
        end_ns = self.middle_ns + round(end_s * SECOND)
        moved = self.moved(self.within(begin_s, end_s), by)
        return replace(moved, fault_ns=(moved.fault_ns[0], end_ns), good_ns=end_ns)

    def silent(self, begin_s: float, end_s: float) -> 'Drive':
        """Leave out the fixes of a time since the middle [s]."""
        kept = ~self.within(begin_s, end_s)
        return replace(self, stamps_ns=self.stamps_ns[kept], fixes=self.fixes[kept],
                       good_ns=self.middle_ns + round(end_s * SECOND))

    def within(self, begin_s: float, end_s: float) -> BoolArray:
        """Return which fixes are of a time since the middle [s], shape (M,)."""
        since = (self.stamps_ns - self.middle_ns) / SECOND
        return np.asarray((since >= begin_s) & (since < end_s))


def plaza(folder: Path, seed: int, around_s: float = np.inf) -> Drive:
    """
    Read the drive of a lawn mower, `odom.csv` and `gt.csv`, and make fixes of its truth.

    Parameters
    ----------
    folder : Path
    seed : int
    around_s : float, time before and after the middle of the recording [s]

    """
    odometry, truth = (np.genfromtxt(folder / name, delimiter=',', skip_header=1)
                       for name in ('odom.csv', 'gt.csv'))
    odometry, truth = (rows[np.append(True, np.diff(np.round(rows[:, 0] * 1e9)) > 0)]
                       for rows in (odometry, truth))
    middle = 0.5 * (odometry[0, 0] + odometry[-1, 0])
    odometry = odometry[np.abs(odometry[:, 0] - middle) < around_s]
    return _drive(*(Trajectory(np.round(rows[:, 0] * 1e9).astype(np.int64), rows[:, 1:4])
                    for rows in (odometry, truth)), seed)


def simulated(seed: int, duration_s: float = 900.0) -> Drive:
    """Simulate a drive of 15 minutes, or another duration [s], at 1 m/s."""
    drive = drives.simulate(
        Kind('', duration=duration_s, odometry_rate=5.0), seed, OdometryNoise())
    return _drive(Trajectory(drive.stamps_ns, drive.odometry),
                  Trajectory(drive.stamps_ns, drive.truth), seed)


def _drive(odometry: Trajectory, truth: Trajectory, seed: int) -> Drive:
    begin = max(odometry.stamps_ns[0], truth.stamps_ns[0])
    stamps = np.arange(begin + SECOND, min(odometry.stamps_ns[-1], truth.stamps_ns[-1]), SECOND)
    fixes = truth.at(stamps)[:, :2] + np.random.default_rng(seed).normal(
        0.0, SIGMA, (len(stamps), 2))
    return Drive(odometry, truth, stamps, fixes)
