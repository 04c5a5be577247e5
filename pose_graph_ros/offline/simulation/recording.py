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
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.quantities import Seconds
from pose_graph_ros.offline.simulation import sensors
from pose_graph_ros.offline.simulation.motion import Motion, PERIOD_S
from pose_graph_ros.offline.simulation.sensors import Measured
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
    measured: Mapping[str, Measured]
    """
    By topic.

    Values of odometry, shape (N, 6), are poses `T_odom_base` and the velocity measured before each
    in its frame [m/s, m/s, rad/s]; of a gyroscope yaw rates, shape (N,) [rad/s]; of fixes
    latitude, longitude and ellipsoidal height, shape (N, 3) [deg, deg, m]; of global poses those
    in the map, shape (N, 3); of closures the later pose in the earlier one, shape (N, 3).
    """
    arrivals: Mapping[str, tuple[IntArray, IntArray]]
    """By topic: which messages are recorded, and when [ns], by that time, shape (K,) each."""
    silenced: tuple[int, ...]  # measurements that each outage has left out
    missing_groups: int  # of false closures, for which there were no places

    @property
    def odometry(self) -> Trajectory:
        """Measured poses, `T_odom_base`."""
        stamps_ns, values, _ = self.measured[ODOMETRY]
        return Trajectory(stamps_ns, values[:, :3])


@dataclass(frozen=True, slots=True)
class Course:
    """A motion through a world, what is simulated there, and random numbers for it."""

    motion: Motion
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
    usual = world.setup(motion)
    if world.one_stream:
        streams |= _states(generator, motion, usual)
    return Course(motion, change(usual), streams)


def _states(
    generator: np.random.Generator, motion: Motion, usual: Setup,
) -> dict[str, np.random.Generator]:
    """
    Return the states of a generator from which the usual sensors draw one after the other.

    A sensor with other settings begins at the same state, so that it draws what it usually would,
    and the others do too.
    """
    assert usual.fixes is not None
    assert usual.closures is not None
    truth, closures = motion.truth, usual.closures
    states: dict[str, np.random.Generator] = {}

    def state(name: str) -> np.random.Generator:
        states[name] = copy.deepcopy(generator)
        return generator

    sensors.odometry(state('odometry'), truth, usual.wheels)
    stamps, values = sensors.positions(state('fixes'), truth, usual.fixes)
    ends, poses = _true_closures(state('closures'), motion, closures)
    sensors.moved(state('jumps'), stamps, values, usual.jumps_of(FIXES))
    sensors.with_false(state('false'), motion, closures, ends[:0], poses[:0])
    state('truth')
    return states


def record(way: Course) -> Recording:
    """Return what all sensors say on a course."""
    setup, truth, streams = way.setup, way.motion.truth, way.streams
    odometry = sensors.odometry(streams['odometry'], truth, setup.wheels)
    path = np.column_stack((sensors.jumped(odometry, setup).poses, sensors.velocities(odometry)))
    rates = (np.empty(0) if setup.gyro is None else
             sensors.yaw_rates(streams['gyro'], truth.poses[:, 2], setup.gyro))
    fixes = absolute(way, FIXES, truth)
    fixes = fixes._replace(values=CITY.to_geodetic(fixes.values))
    heard = fixes.rows(sensors.heard(fixes.stamps_ns, FIXES, setup.outages)).values
    to_map = _fixed_map(heard[0]) if len(heard) > 0 else _map(truth, odometry.poses[0])
    poses = absolute(way, POSES, Trajectory(truth.stamps_ns, to_map(truth.poses)))
    closures, missing = _closures(way)
    every = {
        ODOMETRY: Measured(odometry.stamps_ns, path, np.full(len(path), -1)),
        GYRO: Measured(truth.stamps_ns[:len(rates)], rates, np.full(len(rates), -1)),
        FIXES: fixes, POSES: poses._replace(values=se2.wrapped(poses.values)), CLOSURES: closures}
    kept = {topic: each.rows(sensors.heard(each.later_ns, topic, setup.outages))
            for topic, each in every.items()}
    arrivals = {topic: sensors.arrivals(streams[topic], topic, each.later_ns, setup)
                for topic, each in kept.items()}
    stamps = sensors.jittered_stamps(streams['truth'], truth, sensors.ODOMETRY_PERIOD_S)
    arrivals[TRUTH] = sensors.arrivals(np.random.default_rng(0), TRUTH, stamps, setup)
    ahead = {topic: sum(round(each.seconds * 1e9) for each in setup.offsets
                        if each.topic == topic) for topic in TOPICS}
    return Recording(
        setup, float(way.motion.distance[-1]), Trajectory(stamps, to_map(truth.at(stamps))),
        {topic: each._replace(stamps_ns=each.stamps_ns + ahead[topic])
         for topic, each in kept.items()}, arrivals,
        tuple(int(np.sum(~sensors.heard(every[each.topic].later_ns, each.topic, [each])))
              for each in setup.outages), missing)


def absolute(way: Course, topic: str, truth: Trajectory) -> Measured:
    """Return fixes or global poses, in the frame of the truth."""
    setup, streams = way.setup, way.streams
    if topic == FIXES and setup.fixes is not None:
        stamps, values = sensors.positions(streams['fixes'], truth, setup.fixes)
    elif topic == POSES and setup.poses is not None:
        stamps, values = sensors.global_poses(streams['poses'], truth, setup.poses)
    else:
        stamps, values = np.empty(0, dtype=np.int64), np.empty((0, 2 if topic == FIXES else 3))
    return sensors.moved(streams['jumps' if topic == FIXES else 'pose jumps'], stamps, values,
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


def _closures(way: Course) -> tuple[Measured, int]:
    """Return closures, and how many groups of false ones are missing."""
    settings = way.setup.closures
    if settings is None:
        none = np.empty(0, dtype=np.int64)
        return Measured(none.reshape(0, 2), np.empty((0, 3)), none), 0
    ends, poses = _true_closures(way.streams['closures'], way.motion, settings)
    found = way.streams['rate'].random(len(ends)) < settings.rate
    return sensors.with_false(
        way.streams['false'], way.motion, settings, ends[found], poses[found])


def _true_closures(
    generator: np.random.Generator, path: Motion, settings: Closures,
) -> tuple[IntArray, FloatArray]:
    """Return stamps (L, 2) and measured poses (L, 3) of loop closures at revisited places."""
    stamps = path.truth.stamps_ns
    # by distance, so that a vehicle at rest is at one place only
    places = np.unique(np.searchsorted(
        path.distance, np.arange(0.0, path.distance[-1], settings.place_distance)))
    places = places[stamps[places] >= stamps[0] + settings.first_s * 1e9]
    old, new = sensors.revisits(generator, path, places, settings)
    # stamps of a camera, which is not synchronised with the other sensors
    ends = stamps[places[np.column_stack((old, new))]]
    ends += generator.integers(1, round(PERIOD_S * 1e9), ends.shape)
    ends = np.minimum(ends, stamps[-1])
    poses = path.truth.at(ends)
    return ends, sensors.closure_poses(generator, poses[:, 0], poses[:, 1], settings)
