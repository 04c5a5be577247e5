# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Wrong fixes, wrong poses and wrong odometry, as receivers, localisers and wheels make them.

Every fault is made of a clean drive, so that the truth is known, and most begin at half of its
time.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from benchmark.drives import SECOND
from benchmark.robust_drives import Drive, SIGMA
from benchmark.worlds import integrate
from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import GlobalPose, Position

POSE_SIGMA = np.array((0.2, 0.2, 0.05))
"""Of a localiser [m, m, rad]."""

Fault = Callable[[Drive, np.random.Generator], Drive]


def aside(rng: np.random.Generator, far: float, count: int | None = None) -> FloatArray:
    """
    Return vectors of some length in random directions, shape (2,) or (count, 2).

    Parameters
    ----------
    rng : Generator
    far : float, the length [m]
    count : int, optional

    """
    angle = rng.uniform(-np.pi, np.pi, count)
    return far * np.stack((np.cos(angle), np.sin(angle)), axis=-1)


def jumps(share: float, near: float, far: float) -> Fault:
    """
    Return a fault: single fixes jump.

    Parameters
    ----------
    share : float, of all fixes
    near, far : float, smallest and largest distance [m]

    """
    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        chosen = rng.random(len(drive.fixes)) < share
        by = aside(rng, 1.0, len(chosen)) * rng.uniform(near, far, (len(chosen), 1))
        return replace(drive.moved(chosen, by), fault_ns=_whole(drive))
    return make


def after_outage(far: float, seconds: float) -> Fault:
    """
    Return a fault: 60 s without fixes, then all to one side for a time.

    Parameters
    ----------
    far : float [m]
    seconds : float

    """
    return lambda drive, rng: drive.silent(0.0, 60.0).offset(
        60.0, 60.0 + seconds, aside(rng, far))


def re_initialised(far: float, seconds: float) -> Fault:
    """
    Return a fault: all fixes to one side for a time, without an outage.

    Parameters
    ----------
    far : float [m]
    seconds : float

    """
    return lambda drive, rng: drive.offset(0.0, seconds, aside(rng, far))


def multipath(drive: Drive, rng: np.random.Generator) -> Drive:
    """Return errors to one side, in stretches of 20 to 60 s, in a quarter of the time."""
    end = float(drive.odometry.stamps_ns[-1] - drive.middle_ns) / SECOND
    at, made = -end + 60.0, drive
    while at < end:
        length = rng.uniform(20.0, 60.0)
        chosen = drive.within(at, at + length)
        made = made.moved(chosen, aside(rng, 4.0 + rng.exponential(15.0)) + rng.normal(
            0.0, 1.0, (len(chosen), 2)))
        at += length + rng.uniform(60.0, 180.0)
    return replace(made, fault_ns=_whole(drive))


def long_multipath(far: float, seconds: float) -> Fault:
    """
    Return a fault: errors to one side that come and go within 10 s and wander in between.

    Parameters
    ----------
    far : float, about so much [m]
    seconds : float

    """
    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        since = (drive.stamps_ns - drive.middle_ns) / SECOND
        share = np.clip(np.minimum(since, seconds - since) / 10.0, 0.0, 1.0)
        wander = 0.2 * far * _correlated(rng, len(since), 10.0)
        off = share[:, None] * (aside(rng, far) + wander)
        begin, end = (drive.middle_ns + round(s * SECOND) for s in (0.0, seconds))
        return replace(drive.moved(share > 0.0, off), fault_ns=(begin, end), good_ns=end)
    return make


def dragged(speed: float, seconds: float) -> Fault:
    """
    Return a fault: the fixes are dragged away, and come back at once.

    Parameters
    ----------
    speed : float [m/s]
    seconds : float

    """
    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        since = (drive.stamps_ns - drive.middle_ns) / SECOND
        return drive.offset(0.0, seconds, aside(rng, speed) * np.clip(since, 0.0, None)[:, None])
    return make


def slip(forward: float = 0.0, angle: float = 0.0, *, silent: bool) -> Fault:
    """
    Return a fault: odometry goes on, or turns, by so much more in 10 s.

    Parameters
    ----------
    forward : float [m]
    angle : float [rad]
    silent : bool, whether that is within 60 s without fixes

    """
    def make(drive: Drive, _: np.random.Generator) -> Drive:
        begin = drive.middle_ns + 25 * SECOND
        quiet = drive.silent(0.0, 60.0) if silent else replace(drive, good_ns=begin)
        return replace(quiet, odometry=_continued(
            drive.odometry, begin, np.array((forward, 0.0, angle)), 10.0))
    return make


def noisier(factor: float) -> Fault:
    """Return a fault: odometry is so many times as noisy as its model says, fixes are right."""
    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        path, model = drive.odometry, OdometryNoise()
        steps = se2.between(path.poses[:-1], path.poses[1:])
        distance, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
        sigma = np.sqrt(factor**2 - 1.0) * np.column_stack((
            model.sigma_distance * np.sqrt(distance), model.sigma_lateral * np.sqrt(distance),
            np.sqrt(model.sigma_heading_distance**2 * distance
                    + model.sigma_heading_turn**2 * turn)))
        steps = se2.compose(steps, sigma * rng.normal(size=steps.shape))
        return replace(drive, odometry=Trajectory(
            path.stamps_ns, integrate(path.poses[0], steps)))
    return make


def correlated(tau: float) -> Fault:
    """Return a drive whose fixes have slow errors of the sigma that they claim; none is wrong."""
    return lambda drive, rng: replace(drive, fixes=(
        drive.truth.at(drive.stamps_ns)[:, :2]
        + SIGMA * _correlated(rng, len(drive.stamps_ns), tau)))


def sparse(period: int) -> Fault:
    """Return a fault: a fix every so many seconds only, of which a fifth jump."""
    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        few = replace(drive, stamps_ns=drive.stamps_ns[::period], fixes=drive.fixes[::period])
        return jumps(0.2, 20.0, 50.0)(few, rng)
    return make


def two_receivers(far: float, seconds: float, rate: int = 1) -> Fault:
    """
    Return a fault: of two receivers one is wrong for a time.

    Parameters
    ----------
    far : float [m]
    seconds : float
    rate : int, of the one that goes wrong [Hz]; the other has 1 Hz

    """
    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        stamps = np.arange(drive.stamps_ns[0] + SECOND // 3, drive.stamps_ns[-1], SECOND // rate)
        fixes = drive.truth.at(stamps)[:, :2] + rng.normal(0.0, SIGMA, (len(stamps), 2))
        second = replace(drive, stamps_ns=stamps, fixes=fixes).offset(
            0.0, seconds, aside(rng, far))
        others = tuple(('second', Position(stamp, fix, SIGMA**2 * np.eye(2), np.zeros(2)))
                       for stamp, fix in zip(stamps.tolist(), second.fixes, strict=True))
        return replace(drive, others=others, fault_ns=second.fault_ns, good_ns=second.good_ns,
                       wrong=frozenset(('second', stamp) for _, stamp in second.wrong))
    return make


def localiser(by: tuple[float, float, float], *times: tuple[float, float]) -> Fault:
    """
    Return a fault: poses of a localiser instead of fixes, somewhere else for some times.

    Parameters
    ----------
    by : tuple, where it believes to be, from where it is [m, m, rad]
    *times : tuple of float, begin and end since the middle [s]

    """
    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        stamps = drive.stamps_ns
        poses = drive.truth.at(stamps) + rng.normal(size=(len(stamps), 3)) * POSE_SIGMA
        lost = np.any([drive.within(*time) for time in times], axis=0)
        poses[lost] = se2.compose(poses[lost], np.array(by))
        begin, end = (drive.middle_ns + round(s * SECOND) for s in (times[0][0], times[-1][1]))
        return replace(
            drive, stamps_ns=stamps[:0], fixes=drive.fixes[:0], fault_ns=(begin, end),
            good_ns=end, wrong=frozenset(('amcl', stamp) for stamp in stamps[lost].tolist()),
            others=tuple(('amcl', GlobalPose(stamp, pose, np.diag(POSE_SIGMA**2)))
                         for stamp, pose in zip(stamps.tolist(), poses, strict=True)))
    return make


def from_the_start(far: float, seconds: float) -> Fault:
    """
    Return a fault: the first fixes of all are to one side.

    Parameters
    ----------
    far : float [m]
    seconds : float

    """
    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        end = int(drive.stamps_ns[0]) + round(seconds * SECOND)
        return replace(drive.moved(drive.stamps_ns < end, aside(rng, far)), good_ns=end,
                       fault_ns=(0, 0))
    return make


def restart(drive: Drive, _: np.random.Generator) -> Drive:
    """Return odometry that begins again 5 m off."""
    return replace(drive, good_ns=drive.middle_ns, odometry=_continued(
        drive.odometry, drive.middle_ns, np.array((5.0, 1.0, 0.3))))


def kidnapped(drive: Drive, _: np.random.Generator) -> Drive:
    """Return a robot that is carried away; odometry does not notice."""
    truth = _continued(drive.truth, drive.middle_ns, np.array((30.0, 20.0, 0.7)))
    late = drive.stamps_ns >= drive.middle_ns
    off = truth.at(drive.stamps_ns)[:, :2] - drive.truth.at(drive.stamps_ns)[:, :2]
    return replace(drive, truth=truth, good_ns=drive.middle_ns,
                   fixes=drive.fixes + np.where(late[:, None], off, 0.0))


def slip_and_offset(drive: Drive, rng: np.random.Generator) -> Drive:
    """Return an outage with a slip of 10 m, after which the fixes are 40 m off for 20 s."""
    return slip(10.0, silent=True)(drive, rng).offset(60.0, 80.0, aside(rng, 40.0))


def _whole(drive: Drive) -> tuple[int, int]:
    return int(drive.stamps_ns[0]), int(drive.stamps_ns[-1])


def _correlated(rng: np.random.Generator, count: int, tau: float) -> FloatArray:
    """Return a Gauss-Markov process of variance 1, a sample in every second, shape (count, 2)."""
    phi = np.exp(-1.0 / tau)
    drive = np.sqrt(1.0 - phi**2) * rng.standard_normal((count, 2))
    drive[0] = rng.standard_normal(2)
    return np.asarray(lfilter([1.0], [1.0, -phi], drive, axis=0))


def _continued(
    path: Trajectory, at_ns: int, by: FloatArray, lasting_s: float = 0.0,
) -> Trajectory:
    """Return a path that continues, from a time on, after a motion in the robot's frame."""
    poses = path.poses.copy()
    late = path.stamps_ns >= at_ns
    at = path.at(at_ns)
    share = np.minimum((path.stamps_ns[late] - at_ns) / max(lasting_s * SECOND, 1.0), 1.0)
    poses[late] = se2.compose(se2.compose(at, share[:, None] * by),
                              se2.between(at, poses[late]))
    return Trajectory(path.stamps_ns, poses)


CLEAN = 'clean'
ASKED: dict[str, Fault] = {
    CLEAN: lambda drive, _: drive,
    'a fifth jump by 20 to 50 m': jumps(0.2, 20.0, 50.0),
    '60 s without, then 30 s all 40 m aside': after_outage(40.0, 30.0),
    '60 s without, in which odometry slips by 10 m': slip(10.0, silent=True),
    'the receiver begins again, 100 m off for 60 s': re_initialised(100.0, 60.0),
    'multipath, to one side, for 20 to 60 s each': multipath,
    'two receivers, one 25 m aside for 120 s': two_receivers(25.0, 120.0),
    'a localiser in the wrong corridor for 40 s': localiser((0.0, 12.0, 0.0), (0.0, 40.0)),
    'odometry begins again, 5 m off': restart,
    'the robot is carried by 36 m': kidnapped,
}
"""What the requirements name."""
FURTHER: dict[str, Fault] = {
    **{f'60 s without, then {seconds} s all {far} m aside': after_outage(far, seconds)
       for far in (15, 40, 100) for seconds in (10, 30, 60)},
    **{f'all {far} m aside for {seconds} s': re_initialised(far, seconds)
       for far, seconds in ((15, 30), (40, 120), (6, 60))},
    **{f'{100 * share:.0f} % jump by {near} to {far} m': jumps(share, near, far)
       for share, near, far in ((0.05, 5, 15), (0.2, 5, 15), (0.4, 5, 15), (0.4, 20, 50))},
    **{f'60 s without, in which odometry slips by {far} m': slip(far, silent=True)
       for far in (3, 20)},
    **{f'odometry slips by {far} m among fixes': slip(far, silent=False) for far in (3, 10, 20)},
    **{f'60 s without, in which odometry turns by {angle} rad': slip(angle=angle, silent=True)
       for angle in (0.2, 0.7, 2.0)},
    **{f'odometry turns by {angle} rad among fixes': slip(angle=angle, silent=False)
       for angle in (0.2, 2.0)},
    '60 s without with a slip of 10 m, then 20 s all 40 m aside': slip_and_offset,
    **{f'odometry {factor} times as noisy as claimed': noisier(factor) for factor in (2, 4)},
    'fixes with slow errors, 60 s': correlated(60.0),
    'fixes claim a third of their sigma': lambda drive, _: replace(drive, sigma=SIGMA / 3.0),
    'fixes claim thrice their sigma': lambda drive, _: replace(drive, sigma=SIGMA * 3.0),
    'a fix in 10 s, a fifth jump by 20 to 50 m': sparse(10),
    'multipath that comes and goes, 15 m for 60 s': long_multipath(15.0, 60.0),
    'multipath that comes and goes, 10 m for 180 s': long_multipath(10.0, 180.0),
    'fixes are dragged away at 0.3 m/s for 100 s': dragged(0.3, 100.0),
    'the first 30 s of all are 40 m aside': from_the_start(40.0, 30.0),
    'two receivers, one 8 m aside for 60 s': two_receivers(8.0, 60.0),
    'two receivers, that of 5 Hz 25 m aside for 120 s': two_receivers(25.0, 120.0, 5),
    'a localiser 3 m aside for 20 s': localiser((0.0, 3.0, 0.0), (0.0, 20.0)),
    'a localiser 8 m aside for 120 s': localiser((0.0, 8.0, 0.0), (0.0, 120.0)),
    'a localiser turned round for 30 s': localiser((0.0, 5.0, np.pi), (0.0, 30.0)),
    'a localiser 12 m aside, three times for 20 s': localiser(
        (0.0, 12.0, 0.0), (0.0, 20.0), (50.0, 70.0), (100.0, 120.0)),
}
"""Other sizes and other faults, for which nothing was tuned."""
