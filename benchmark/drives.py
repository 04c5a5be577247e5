# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Drives with fixes, recorded or simulated, whose measurements can be changed, and their way in.

The noise of a simulated drive is what the engine is told.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import Measurement, OdometrySample, Position, YawRate
from pose_graph_ros.offline.simulation import sensors
from pose_graph_ros.offline.simulation.recording import course
from pose_graph_ros.offline.simulation.settings import Fixes, Gyro, OdometryErrors, Wheels
from pose_graph_ros.offline.simulation.worlds import WORLDS

SECOND = 1_000_000_000
SIGMA = 1.0
"""Of the fixes [m]."""
WHITE = Fixes(1.0, SIGMA, 0.0)
"""At 1 Hz."""
PLAZA = 'robot/plaza1'
Event = tuple[str, OdometrySample | Measurement]
"""A source, and what it says."""


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
    others: tuple[Event, ...] = ()
    """Of other sources."""
    sigma: float = SIGMA
    """What the fixes claim [m]."""

    @property
    def middle_ns(self) -> int:
        """When most faults begin."""
        stamps = self.odometry.stamps_ns
        return int(stamps[0] + stamps[-1]) // 2

    def events(self) -> list[Event]:
        """Return what comes, by stamp."""
        events: list[Event] = [('odom', OdometrySample(stamp, pose)) for stamp, pose in zip(
            self.odometry.stamps_ns.tolist(), self.odometry.poses, strict=True)]
        events += positions('fix', self.stamps_ns, self.fixes, self.sigma)
        return sorted([*events, *self.others], key=lambda event: event[1].stamp_ns)

    def only_right(self) -> 'Drive':
        """Return the drive without what is wrong."""
        kept = np.array([('fix', stamp) not in self.wrong for stamp in self.stamps_ns.tolist()],
                        dtype=bool)
        others = tuple((source, one) for source, one in self.others
                       if (source, one.stamp_ns) not in self.wrong)
        return replace(self.only(kept), others=others, wrong=frozenset())

    def only(self, chosen: BoolArray) -> 'Drive':
        """Return the drive with some of its fixes."""
        return replace(self, stamps_ns=self.stamps_ns[chosen], fixes=self.fixes[chosen])

    def moved(self, chosen: BoolArray, by: FloatArray) -> 'Drive':
        """
        Move some of the fixes, which are wrong then.

        Parameters
        ----------
        chosen : ndarray of bool, shape (M,)
        by : ndarray, shape (2,) or (M, 2) [m]

        """
        wrong = frozenset(('fix', stamp) for stamp in self.stamps_ns[chosen].tolist())
        first, last = self.stamps_ns[chosen][[0, -1]].tolist() if chosen.any() else (0, -1)
        return replace(self, fixes=self.fixes + np.where(chosen[:, None], by, 0.0),
                       wrong=self.wrong | wrong, fault_ns=(first, last + 1))

    def offset(self, begin_s: float, end_s: float, by: FloatArray) -> 'Drive':
        """Move the fixes of a time since the middle [s] by so much, shape (2,) [m]."""
        end_ns = self.middle_ns + round(end_s * SECOND)
        moved = self.moved(self.within(begin_s, end_s), by)
        return replace(moved, fault_ns=(moved.fault_ns[0], end_ns), good_ns=end_ns)

    def silent(self, begin_s: float, end_s: float) -> 'Drive':
        """Leave out the fixes of a time since the middle [s]."""
        return replace(self.only(~self.within(begin_s, end_s)),
                       good_ns=self.middle_ns + round(end_s * SECOND))

    def within(self, begin_s: float, end_s: float) -> BoolArray:
        """Return which fixes are of a time since the middle [s], shape (M,)."""
        since = (self.stamps_ns - self.middle_ns) / SECOND
        return np.asarray((since >= begin_s) & (since < end_s))


def positions(
    source: str, stamps_ns: IntArray, places: FloatArray, sigma: float = SIGMA,
) -> list[Event]:
    """Return fixes as they come."""
    return [(source, Position(stamp, place, sigma**2 * np.eye(2), np.zeros(2)))
            for stamp, place in zip(stamps_ns.tolist(), places, strict=True)]


def simulated(
    seed: int, duration_s: float, world: str = 'grid', fixes: Fixes = WHITE, *, every: int = 2,
    drift: float = 0.0, gyro: Gyro | None = None,
) -> Drive:
    """
    Simulate a drive from an unknown heading.

    Parameters
    ----------
    seed : int
    duration_s : float
    world : str, of `WORLDS`
    fixes : Fixes
    every : int, which samples of odometry are taken, of 20 Hz
    drift : float, of the heading by odometry, which is not told [rad/m]
    gyro : Gyro, optional, a further source; every fifth of its rates, of 20 Hz, is a mean

    """
    truth = course(WORLDS[world], seed, duration_s).motion.truth
    rng = np.random.default_rng((seed, 1))
    wheels = Wheels(OdometryErrors.MODEL, heading_drift=drift,
                    start=(5.0, -3.0, rng.uniform(-np.pi, np.pi)))
    odometry = sensors.odometry(rng, truth, wheels)
    stamps, places = sensors.positions(rng, truth, fixes)
    others: tuple[Event, ...] = ()
    if gyro is not None:
        rates = sensors.yaw_rates(rng, truth.poses[:, 2], gyro)
        others = tuple(('gyro', YawRate(stamp, rate)) for stamp, rate in zip(
            truth.stamps_ns.tolist(), rates.tolist(), strict=True))
    sigma = float(np.hypot(fixes.white, fixes.correlated))
    return Drive(Trajectory(odometry.stamps_ns[::every], odometry.poses[::every]), truth,
                 stamps, places, sigma=sigma, others=others)


def plaza(data: Path, seed: int, folder: str = PLAZA) -> Drive:
    """Read the drive of a lawn mower, odometry and truth, and make fixes of its truth at 1 Hz."""
    odometry, truth = (
        Trajectory(stamps, rows[:, :3]) for name in ('odom.csv', 'gt.csv')
        for stamps, rows in [stamped(data / folder / name)])
    return with_fixes(odometry, truth, seed)


def stamped(file: Path) -> tuple[IntArray, FloatArray]:
    """Read a table with times [s] in its first column: stamps [ns], and the other columns."""
    rows = np.genfromtxt(file, delimiter=',', skip_header=1)
    stamps = np.round(rows[:, 0] * 1e9).astype(np.int64)
    new = np.append(True, np.diff(stamps) > 0)
    return stamps[new], rows[new, 1:]


def with_fixes(odometry: Trajectory, truth: Trajectory, seed: int) -> Drive:
    """Return a drive with fixes that are made of its truth, at 1 Hz with white errors of 1 m."""
    begin = max(odometry.stamps_ns[0], truth.stamps_ns[0])
    stamps = np.arange(begin + SECOND, min(odometry.stamps_ns[-1], truth.stamps_ns[-1]), SECOND)
    noise = np.random.default_rng(seed).normal(0.0, SIGMA, (len(stamps), 2))
    return Drive(odometry, truth, stamps, truth.at(stamps)[:, :2] + noise)


def feed(
    backend: PoseGraphBackend, events: Iterable[Event], update_every: float,
) -> Iterator[int]:
    """Feed events in the order given; update so often in stamps of the odometry [s], and yield."""
    due = 0
    for source, event in events:
        if not isinstance(event, OdometrySample):
            backend.add_measurement(event, source)
            continue
        backend.add_odometry(event)
        if event.stamp_ns >= due:
            due = event.stamp_ns + round(update_every * SECOND)
            backend.update()
            yield event.stamp_ns


def off_truth(backend: PoseGraphBackend, truth: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Return the error of the newest pose, shape (3,), and its covariance."""
    estimate = backend.estimate(with_path=False)
    assert estimate is not None
    off = estimate.T_map_base - truth.at(estimate.stamp_ns)
    off[2] = se2.wrap(off[2])
    return off, estimate.covariance


def nees(off: FloatArray, covariance: FloatArray) -> float:
    """Return e^T C^-1 e / 3."""
    return float(off @ np.linalg.solve(covariance, off)) / 3.0


def rms(off: FloatArray) -> float:
    """Return the root mean square of numbers, or of the lengths of vectors, shape (N, 2)."""
    return float(np.sqrt(np.mean(np.square(off if off.ndim == 1 else np.hypot(*off.T)))))


def path_rms(path: Trajectory, truth: Trajectory) -> float:
    """Return the error of a path to the truth [m]."""
    inside = truth.covers(path.stamps_ns)
    return rms((path.poses[inside] - truth.at(path.stamps_ns[inside]))[:, :2])
