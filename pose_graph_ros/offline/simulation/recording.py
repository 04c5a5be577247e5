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
from pose_graph_ros.offline.simulation import sensors
from pose_graph_ros.offline.simulation.closures import (
    measured,
    Path,
    revisits,
    with_false,
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
    START_NS,
    TOPICS,
    TRUTH,
)
from pose_graph_ros.offline.simulation.worlds import World

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
    ends, poses = _true_closures(state('closures'), truth, path, closures)
    sensors.moved(state('jumps'), stamps, values, usual.jumps_of(FIXES))
    with_false(state('false'), path, closures, ends[:0], poses[:0])
    state('truth')
    return states


def record(way: Course) -> Recording:
    """Return what all sensors say on a course."""
    setup, truth, streams = way.setup, way.truth, way.streams
    measured_at = dict.fromkeys(TOPICS, np.empty(0, dtype=np.int64))  # with what outages leave out

    def heard(topic: str, stamps: IntArray) -> BoolArray:
        measured_at[topic] = stamps
        return sensors.heard(stamps, topic, setup.outages)

    odometry = sensors.odometry(streams['odometry'], truth, setup.wheels)
    velocities, to_map = sensors.velocities(odometry), _map(truth, odometry.poses[0])
    odometry = sensors.jumped(odometry, setup)
    kept = heard(ODOMETRY, odometry.stamps_ns)
    odometry, velocities = Trajectory(
        odometry.stamps_ns[kept], odometry.poses[kept]), velocities[kept]

    fix_stamps, places, fix_is_wrong = absolute(way, FIXES, truth)
    kept = heard(FIXES, fix_stamps)
    fix_stamps, fix_is_wrong = fix_stamps[kept], fix_is_wrong[kept]
    fixes = CITY.to_geodetic(places[kept])
    if len(fixes) > 0:
        to_map = _fixed_map(fixes[0])
    pose_stamps, poses, pose_is_wrong = absolute(
        way, POSES, Trajectory(truth.stamps_ns, to_map(truth.poses)))
    kept = heard(POSES, pose_stamps)
    pose_stamps, poses, pose_is_wrong = (
        pose_stamps[kept], se2.wrapped(poses[kept]), pose_is_wrong[kept])
    ends, loop_poses, group, missing = _closures(way)
    kept = heard(CLOSURES, ends[:, 1])
    ends, loop_poses, group = ends[kept], loop_poses[kept], group[kept]

    rates = (np.empty(0) if setup.gyro is None else
             sensors.yaw_rates(streams['gyro'], truth.poses[:, 2], setup.gyro))
    kept = heard(GYRO, rate_stamps := truth.stamps_ns[:len(rates)])
    rate_stamps, rates = rate_stamps[kept], rates[kept]

    truth_stamps = sensors.jittered_stamps(streams['truth'], truth, sensors.ODOMETRY_PERIOD_S)
    arrivals = {topic: sensors.arrivals(
        streams[topic], topic, stamps[sensors.heard(stamps, topic, setup.outages)], setup)
        for topic, stamps in measured_at.items()}
    arrivals[TRUTH] = sensors.arrivals(
        np.random.default_rng(0), TRUTH, truth_stamps, setup)
    ahead = {topic: sum(round(each.seconds * 1e9) for each in setup.offsets
                        if each.topic == topic) for topic in TOPICS}
    return Recording(
        setup=setup, distance=float(way.motion.distance[-1]),
        truth=Trajectory(truth_stamps, to_map(truth.at(truth_stamps))),
        odometry=Trajectory(odometry.stamps_ns + ahead[ODOMETRY], odometry.poses),
        velocities=velocities,
        fix_stamps_ns=fix_stamps + ahead[FIXES], fixes=fixes, fix_is_wrong=fix_is_wrong,
        pose_stamps_ns=pose_stamps + ahead[POSES], poses=poses, pose_is_wrong=pose_is_wrong,
        loop_stamps_ns=ends + ahead[CLOSURES], loop_poses=loop_poses, loop_group=group,
        rate_stamps_ns=rate_stamps + ahead[GYRO], rates=rates, arrivals=arrivals,
        silenced=tuple(int(np.sum(~sensors.heard(
            measured_at[each.topic], each.topic, [each]))) for each in setup.outages),
        missing_groups=missing)


def absolute(
    way: Course, topic: str, truth: Trajectory,
) -> tuple[IntArray, FloatArray, BoolArray]:
    """Return stamps of fixes or global poses, what they say in the map, and which are wrong."""
    setup, streams = way.setup, way.streams
    if topic == FIXES and setup.fixes is not None:
        stamps, values = sensors.positions(streams['fixes'], truth, setup.fixes)
    elif topic == POSES and setup.poses is not None:
        stamps, values = sensors.global_poses(streams['poses'], truth, setup.poses)
    else:
        stamps, values = np.empty(0, dtype=np.int64), np.empty((0, 2 if topic == FIXES else 3))
    return stamps, *sensors.moved(
        streams['jumps' if topic == FIXES else 'pose jumps'], stamps, values,
        setup.jumps_of(topic))


def _map(truth: Trajectory, origin: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return what moves poses of the world to the frame in which odometry begins."""
    moved = se2.compose(origin, se2.inverse(truth.poses[0]))
    return lambda poses: se2.compose(moved, poses)


def _fixed_map(fix: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return what moves poses of the world to the plane that touches the Earth at a fix."""
    plane = TangentPlane(*fix.tolist())

    def to_map(poses: FloatArray) -> FloatArray:
        poses = poses.copy()
        poses[:, :2] = plane.to_map(*CITY.to_geodetic(poses[:, :2]).T)
        return poses
    return to_map


def _closures(way: Course) -> tuple[IntArray, FloatArray, IntArray, int]:
    """Return stamps, measured poses and groups of closures, and how many groups are missing."""
    settings = way.setup.closures
    if settings is None:
        return np.empty((0, 2), dtype=np.int64), np.empty((0, 3)), np.empty(0, dtype=np.int64), 0
    path = Path(way.truth.stamps_ns, way.truth.poses, way.motion.distance)
    ends, poses = _true_closures(way.streams['closures'], way.truth, path, settings)
    found = way.streams['rate'].random(len(ends)) < settings.rate
    return with_false(way.streams['false'], path, settings, ends[found], poses[found])


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
