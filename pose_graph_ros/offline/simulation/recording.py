# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A simulated recording: what all sensors say in a world, when it is recorded, and the truth.

The frame `map` is that of a localisation which knows no more than the sensors. With fixes it is
east and north on the plane that touches the ellipsoid at the measured position of the *first fix*,
including its error. Without, it is the frame in which odometry begins.
"""

from collections.abc import Callable, Mapping
import copy
from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.quantities import Seconds
from pose_graph_ros.offline.simulation import disturbances, sensors
from pose_graph_ros.offline.simulation.closures import (
    false_pairs,
    false_poses,
    measured,
    Path,
    revisits,
)
from pose_graph_ros.offline.simulation.motion import Motion, PERIOD_S
from pose_graph_ros.offline.simulation.settings import (
    CLOSURES,
    Closures,
    FIXES,
    GYRO,
    ODOMETRY,
    POSES,
    Setup,
    TOPICS,
    TRUTH,
)
from pose_graph_ros.offline.simulation.worlds import World

START_NS = 1_746_518_400_250_000_000  # stamp of the start [ns]
CITY = TangentPlane(50.7271, 7.0866, 61.0)  # worlds are on the plane that touches the Earth here
STREAMS = ('world', 'gyro', 'odometry', 'fixes', 'poses', 'closures', 'rate', 'jumps',
           'pose jumps', 'false', 'truth', *TOPICS)
"""Who draws random numbers of its own; the place in this list is a part of its seed."""


@dataclass(frozen=True, slots=True)
class Recording:
    """Measurements and true poses of a simulated drive; all stamps as the messages have them."""

    setup: Setup
    distance: float  # driven [m]
    truth: Trajectory  # true poses, `T_map_base`
    odometry: Trajectory  # measured poses, `T_odom_base`
    velocities: FloatArray  # measured before each of them, in its frame, shape (N, 3) [m/s, rad/s]
    fix_stamps_ns: IntArray  # stamps of the fixes, shape (M,) [ns]
    fixes: FloatArray  # latitude, longitude and ellipsoidal height, shape (M, 3) [deg, deg, m]
    fix_is_wrong: BoolArray  # whether a fix was moved by a jump, shape (M,)
    pose_stamps_ns: IntArray  # stamps of the global poses, shape (P,) [ns]
    poses: FloatArray  # global poses, in the map, shape (P, 3) [m, m, rad]
    pose_is_wrong: BoolArray  # whether one was moved by a jump, shape (P,)
    loop_stamps_ns: IntArray  # of the earlier and later pose of loop closures, shape (L, 2) [ns]
    loop_poses: FloatArray  # measured later pose in the earlier one, shape (L, 3) [m, m, rad]
    loop_group: IntArray  # number of the group of false closures, -1: true, shape (L,)
    rate_stamps_ns: IntArray  # of the gyroscope, shape (R,) [ns]; none without one
    rates: FloatArray  # its yaw rates, shape (R,) [rad/s]
    arrivals: Mapping[str, tuple[IntArray, IntArray]]
    """By topic: which messages are recorded, and when [ns], by that time, shape (K,) each."""
    silenced: tuple[int, ...]  # measurements that each outage has left out
    missing_groups: int  # of false closures, for which there were no places

    @property
    def start_ns(self) -> int:
        """Stamp of the start, from which all times count [ns]."""
        return START_NS

    @property
    def loop_is_false(self) -> BoolArray:
        """Whether a loop closure ties two different places, shape (L,)."""
        return self.loop_group >= 0


@dataclass(frozen=True, slots=True)
class Course:
    """A motion through a world, what is simulated there, and random numbers for it."""

    motion: Motion
    truth: Trajectory  # in the frame of the world, every 10 ms; headings are not wrapped
    setup: Setup
    streams: Mapping[str, np.random.Generator]


def course(
    world: World, seed: int, duration_s: Seconds,
    change: Callable[[Setup], Setup] = lambda usual: usual,
) -> Course:
    """Return a motion through a world; equal arguments give equal ones."""
    streams = {name: np.random.default_rng((seed, k)) for k, name in enumerate(STREAMS)}
    generator = np.random.default_rng(seed) if world.one_stream else streams['world']
    motion = world.drive(generator, duration_s)
    truth = Trajectory(START_NS + np.round(motion.time * 1e9).astype(np.int64), motion.poses)
    usual = world.setup(motion)
    if world.one_stream:
        streams |= _states(generator, motion, truth, usual)
    return Course(motion, truth, change(usual), streams)


def _states(
    generator: np.random.Generator, motion: Motion, truth: Trajectory, usual: Setup,
) -> dict[str, np.random.Generator]:
    """
    Return the states of a generator from which the usual sensors draw one after the other.

    A sensor with other settings begins at the same state, so that it draws what it usually would,
    and the others do too.
    """
    assert usual.fixes is not None
    assert usual.closures is not None
    fixes, closures = usual.fixes, usual.closures
    path = Path(truth.stamps_ns, truth.poses, motion.distance)
    states: dict[str, np.random.Generator] = {}

    def state(name: str) -> np.random.Generator:
        states[name] = copy.deepcopy(generator)
        return generator

    sensors.odometry(state('odometry'), truth, usual.wheels)
    stamps, values = sensors.positions(state('fixes'), truth, fixes)
    _true_closures(state('closures'), truth, path, closures)
    disturbances.moved(state('jumps'), stamps, values,
                       [each for each in usual.jumps if each.topic == FIXES], START_NS)
    _false_closures(state('false'), path, closures, 0)
    state('truth')
    return states


def record(way: Course) -> Recording:
    """Return what all sensors say on a course."""
    setup, truth, streams = way.setup, way.truth, way.streams
    path = Path(truth.stamps_ns, truth.poses, way.motion.distance)
    start_ns = int(truth.stamps_ns[0])
    keep = _Outages(setup, start_ns)

    odometry = sensors.odometry(streams['odometry'], truth, setup.wheels)
    origin = odometry.poses[0]    # still at rest
    velocities = sensors.velocities(odometry)
    odometry = disturbances.jumped(
        odometry, [each for each in setup.jumps if each.topic == ODOMETRY], start_ns)
    kept_odometry = keep(ODOMETRY, odometry.stamps_ns)
    odometry = Trajectory(odometry.stamps_ns[kept_odometry], odometry.poses[kept_odometry])

    fix_stamps, fixes, fix_is_wrong = _fixes(way, keep)
    to_map = _map(truth, fixes, origin)
    pose_stamps, poses, pose_is_wrong = _global_poses(way, to_map, keep)
    ends, loop_poses, group, missing = _closures(way, path, keep)

    rates = (np.empty(0) if setup.gyro is None else
             sensors.yaw_rates(streams['gyro'], truth.poses[:, 2], setup.gyro))
    rate_stamps = truth.stamps_ns[:len(rates)]
    kept = keep(GYRO, rate_stamps)
    rate_stamps, rates = rate_stamps[kept], rates[kept]

    truth_stamps = sensors.jittered_stamps(streams['truth'], truth, sensors.ODOMETRY_PERIOD_S)
    measured_at = {ODOMETRY: odometry.stamps_ns, GYRO: rate_stamps, FIXES: fix_stamps,
                   POSES: pose_stamps, CLOSURES: ends[:, 1]}
    arrivals = {topic: disturbances.arrivals(streams[topic], topic, stamps, setup)
                for topic, stamps in measured_at.items()}
    arrivals[TRUTH] = disturbances.arrivals(
        np.random.default_rng(0), TRUTH, truth_stamps, setup)
    ahead = {topic: sum(round(each.seconds * 1e9) for each in setup.offsets
                        if each.topic == topic) for topic in TOPICS}
    return Recording(
        setup=setup, distance=float(way.motion.distance[-1]),
        truth=Trajectory(truth_stamps, to_map(truth.at(truth_stamps))),
        odometry=Trajectory(odometry.stamps_ns + ahead[ODOMETRY], odometry.poses),
        velocities=velocities[kept_odometry],
        fix_stamps_ns=fix_stamps + ahead[FIXES], fixes=fixes, fix_is_wrong=fix_is_wrong,
        pose_stamps_ns=pose_stamps + ahead[POSES], poses=poses, pose_is_wrong=pose_is_wrong,
        loop_stamps_ns=ends + ahead[CLOSURES], loop_poses=loop_poses, loop_group=group,
        rate_stamps_ns=rate_stamps + ahead[GYRO], rates=rates, arrivals=arrivals,
        silenced=tuple(keep.silenced), missing_groups=missing)


class _Outages:
    """Which measurements are in no outage; counts the others."""

    def __init__(self, setup: Setup, start_ns: int) -> None:
        self._outages, self._start_ns = setup.outages, start_ns
        self.silenced = [0] * len(setup.outages)

    def __call__(self, topic: str, stamps_ns: IntArray) -> BoolArray:
        kept = np.ones(len(stamps_ns), dtype=bool)
        for k, outage in enumerate(self._outages):
            if outage.topic == topic:
                inside = ~disturbances.heard(stamps_ns, (outage,), self._start_ns)
                self.silenced[k] = int(np.sum(inside))
                kept &= ~inside
        return kept


def _fixes(way: Course, keep: _Outages) -> tuple[IntArray, FloatArray, BoolArray]:
    """Return stamps of the fixes, what they say [deg, deg, m], and which are wrong."""
    settings = way.setup.fixes
    if settings is None:
        return np.empty(0, dtype=np.int64), np.empty((0, 3)), np.zeros(0, dtype=bool)
    stamps, positions = sensors.positions(way.streams['fixes'], way.truth, settings)
    positions, wrong = disturbances.moved(
        way.streams['jumps'], stamps, positions,
        [each for each in way.setup.jumps if each.topic == FIXES], int(way.truth.stamps_ns[0]))
    kept = keep(FIXES, stamps)
    return stamps[kept], CITY.to_geodetic(positions[kept]), wrong[kept]


def _map(
    truth: Trajectory, fixes: FloatArray, origin: FloatArray,
) -> Callable[[FloatArray], FloatArray]:
    """Return what moves poses of the world to the map; `origin` is where odometry begins."""
    if len(fixes) == 0:
        moved = se2.compose(origin, se2.inverse(truth.poses[0]))
        return lambda poses: se2.compose(moved, poses)
    plane = TangentPlane(*fixes[0].tolist())

    def to_map(poses: FloatArray) -> FloatArray:
        poses = poses.copy()
        poses[:, :2] = plane.to_map(*CITY.to_geodetic(poses[:, :2]).T)
        return poses
    return to_map


def _global_poses(
    way: Course, to_map: Callable[[FloatArray], FloatArray], keep: _Outages,
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Return stamps of the global poses, the poses in the map, and which are wrong."""
    settings, truth = way.setup.poses, way.truth
    if settings is None:
        return np.empty(0, dtype=np.int64), np.empty((0, 3)), np.zeros(0, dtype=bool)
    stamps, poses = sensors.global_poses(
        way.streams['poses'], Trajectory(truth.stamps_ns, to_map(truth.poses)), settings)
    poses, wrong = disturbances.moved(
        way.streams['pose jumps'], stamps, poses,
        [each for each in way.setup.jumps if each.topic == POSES], int(truth.stamps_ns[0]))
    kept = keep(POSES, stamps)
    return stamps[kept], se2.wrapped(poses[kept]), wrong[kept]


def _closures(
    way: Course, path: Path, keep: _Outages,
) -> tuple[IntArray, FloatArray, IntArray, int]:
    """Return stamps, measured poses and groups of closures, and how many groups are missing."""
    settings = way.setup.closures
    if settings is None:
        return np.empty((0, 2), dtype=np.int64), np.empty((0, 3)), np.empty(0, dtype=np.int64), 0
    ends, poses = _true_closures(way.streams['closures'], way.truth, path, settings)
    found = way.streams['rate'].random(len(ends)) < settings.rate
    ends, poses = ends[found], poses[found]
    false_ends, false, groups, missing = _false_closures(
        way.streams['false'], path, settings, len(ends))
    order = np.argsort(np.append(ends[:, 1], false_ends[:, 1]), kind='stable')
    ends = np.concatenate((ends, false_ends))[order]
    kept = keep(CLOSURES, ends[:, 1])
    group = np.append(np.full(len(poses), -1), groups)[order]
    return ends[kept], np.concatenate((poses, false))[order][kept], group[kept], missing


def _true_closures(
    generator: np.random.Generator, truth: Trajectory, path: Path, settings: Closures,
) -> tuple[IntArray, FloatArray]:
    """Return stamps (L, 2) and measured poses (L, 3) of loop closures at revisited places."""
    # by distance, so that a vehicle at rest is at one place only
    places = np.unique(np.searchsorted(
        path.distance, np.arange(0.0, path.distance[-1], settings.place_distance)))
    places = places[path.stamps_ns[places] >= path.stamps_ns[0] + settings.first_s * 1e9]
    old, new = revisits(generator, path, places, settings)
    # stamps of a camera, which is not synchronised with the other sensors
    ends = path.stamps_ns[places[np.column_stack((old, new))]]
    ends += generator.integers(1, round(PERIOD_S * 1e9), ends.shape)
    ends = np.minimum(ends, path.stamps_ns[-1])
    poses = truth.at(ends)
    return ends, measured(generator, poses[:, 0], poses[:, 1], settings)


def _false_closures(
    generator: np.random.Generator, path: Path, settings: Closures, true: int,
) -> tuple[IntArray, FloatArray, IntArray, int]:
    """Return stamps (F, 2), measured poses (F, 3), groups (F,), and how many are missing."""
    sizes = settings.false.sizes(true)
    pairs, groups = false_pairs(generator, path, sizes, settings)
    poses = false_poses(generator, path, pairs, groups, settings)
    return path.stamps_ns[pairs], poses, groups, len(sizes) - len(np.unique(groups))
