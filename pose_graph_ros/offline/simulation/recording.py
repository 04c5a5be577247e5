# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A simulated recording: what all sensors say in a world, when it is recorded, and the truth.

The frame `map` is that of a localisation which knows no more than the sensors. With fixes it is
east and north on the plane that touches the ellipsoid at the measured position of the *first fix*,
including its error. Without, it is the frame in which odometry begins.

The information of a simulated graph of the same course is honest: every error is drawn from the
covariance that comes with it, but for what is false or moved, and for a claimed sigma that is not
1. So chi2 at the truth, without these, is distributed as chi-square with as many degrees of
freedom as there are measured numbers.
"""

from collections.abc import Callable, Iterable, Mapping
import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.quantities import Metres, Seconds
from pose_graph_ros.offline.simulation import sensors, settings
from pose_graph_ros.offline.simulation.sensors import Measured
from pose_graph_ros.offline.simulation.settings import CLOSURES, FIXES, ODOMETRY, POSES, Setup
from pose_graph_ros.offline.simulation.worlds import Motion, PERIOD_S, World

CITY = TangentPlane(50.7271, 7.0866, 61.0)  # worlds are on the plane that touches the Earth here
STREAMS = ('world', 'gyro', 'odometry', 'fixes', 'poses', 'closures', 'rate', 'jumps',
           'pose jumps', 'false', 'truth', *settings.TOPICS)
"""Who draws random numbers of its own; the place in this list is a part of its seed."""


class Recording(NamedTuple):
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


class Course(NamedTuple):
    """A motion through a world, what is simulated there, and random numbers for it."""

    motion: Motion
    setup: Setup
    streams: Mapping[str, Generator]


def course(world: World, seed: int, duration_s: Seconds,
           change: Callable[[Setup], Setup] = lambda usual: usual) -> Course:
    """Return a motion through a world; equal arguments give equal ones."""
    streams = {name: np.random.default_rng((seed, k)) for k, name in enumerate(STREAMS)}
    generator = np.random.default_rng(seed) if world.one_stream else streams['world']
    motion = world.drive(generator, duration_s)
    usual = world.setup(motion)
    if world.one_stream:
        streams |= _states(generator, motion, usual)
    return Course(motion, change(usual), streams)


def _states(generator: Generator, motion: Motion, usual: Setup) -> dict[str, Generator]:
    """
    Return the states of a generator from which the usual sensors draw one after the other.

    A sensor with other settings begins at the same state, so that it draws what it usually would,
    and the others do too.
    """
    assert usual.fixes is not None
    assert usual.closures is not None
    truth, closures = motion.truth, usual.closures
    states: dict[str, Generator] = {}

    def state(name: str) -> Generator:
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
    # from the world to the frame in which odometry begins, or to the plane that touches the Earth
    # at the first fix
    begin = se2.compose(odometry.poses[0], se2.inverse(truth.poses[0]))
    plane = None if len(heard) == 0 else TangentPlane(*heard[0].tolist())

    def to_map(poses: FloatArray) -> FloatArray:
        if plane is None:
            return se2.compose(begin, poses)
        poses = poses.copy()
        poses[:, :2] = plane.to_map(*CITY.to_geodetic(poses[:, :2]).T)
        return poses

    poses = absolute(way, POSES, Trajectory(truth.stamps_ns, to_map(truth.poses)))
    none, missing = np.empty(0, dtype=np.int64), 0
    closures = Measured(none.reshape(0, 2), np.empty((0, 3)), none)
    if setup.closures is not None:
        ends, measured = _true_closures(streams['closures'], way.motion, setup.closures)
        found = streams['rate'].random(len(ends)) < setup.closures.rate
        closures, missing = sensors.with_false(
            streams['false'], way.motion, setup.closures, ends[found], measured[found])
    every = {ODOMETRY: Measured(odometry.stamps_ns, path, np.full(len(path), -1)),
             settings.GYRO: Measured(truth.stamps_ns[:len(rates)], rates, np.full(len(rates), -1)),
             FIXES: fixes, POSES: poses._replace(values=se2.wrapped(poses.values)),
             CLOSURES: closures}
    kept = {topic: each.rows(sensors.heard(each.later_ns, topic, setup.outages))
            for topic, each in every.items()}
    arrivals = {topic: sensors.arrivals(streams[topic], topic, each.later_ns, setup)
                for topic, each in kept.items()}
    stamps = sensors.jittered_stamps(streams['truth'], truth, sensors.ODOMETRY_PERIOD_S)
    arrivals[settings.TRUTH] = sensors.arrivals(
        np.random.default_rng(0), settings.TRUTH, stamps, setup)
    for offset in setup.offsets:
        own = kept[offset.topic]
        kept[offset.topic] = own._replace(stamps_ns=own.stamps_ns + round(offset.seconds * 1e9))
    silenced = tuple(int(np.sum(~sensors.heard(every[each.topic].later_ns, each.topic, [each])))
                     for each in setup.outages)
    return Recording(setup, float(way.motion.distance[-1]), Trajectory(
        stamps, to_map(truth.at(stamps))), kept, arrivals, silenced, missing)


def absolute(way: Course, topic: str, truth: Trajectory) -> Measured:
    """Return fixes or global poses, in the frame of the truth."""
    setup, streams = way.setup, way.streams
    if topic == FIXES and setup.fixes is not None:
        stamps, values = sensors.positions(streams['fixes'], truth, setup.fixes)
    elif topic == POSES and setup.poses is not None:
        stamps = sensors.jittered_stamps(streams['poses'], truth, setup.poses.period_s)
        values = se2.wrapped(truth.at(stamps) + np.array(
            setup.poses.sigmas) * streams['poses'].standard_normal((len(stamps), 3)))
    else:
        stamps, values = np.empty(0, dtype=np.int64), np.empty((0, 2 if topic == FIXES else 3))
    return sensors.moved(streams['jumps' if topic == FIXES else 'pose jumps'], stamps, values,
                         setup.jumps_of(topic))


def _true_closures(generator: Generator, path: Motion,
                   closures: settings.Closures) -> tuple[IntArray, FloatArray]:
    """Return stamps (L, 2) and measured poses (L, 3) of loop closures at revisited places."""
    stamps = path.truth.stamps_ns
    # by distance, so that a vehicle at rest is at one place only
    places = np.unique(np.searchsorted(
        path.distance, np.arange(0.0, path.distance[-1], closures.place_distance)))
    places = places[stamps[places] >= stamps[0] + closures.first_s * 1e9]
    old, new = sensors.revisits(generator, path, places, closures)
    # stamps of a camera, which is not synchronised with the other sensors
    ends = stamps[places[np.column_stack((old, new))]]
    ends += generator.integers(1, round(PERIOD_S * 1e9), ends.shape)
    ends = np.minimum(ends, stamps[-1])
    poses = path.truth.at(ends)
    noise = generator.normal(0.0, closures.sigmas, (len(ends), 3))
    return ends, se2.compose(se2.between(poses[:, 0], poses[:, 1]), noise)


# --- a graph

class SimulatedGraph(NamedTuple):
    """A graph of N nodes, whose numbers are 0 to N - 1, and the truth."""

    truth: Trajectory
    """True poses of the nodes at their stamps."""
    start: FloatArray
    """Poses by odometry, from the true first one, shape (N, 3)."""
    edges: Factors
    """Odometry, then loop closures."""
    group: IntArray
    """Number of the group of each false closure, -1: true, shape (L,)."""
    observed: Factors
    wrong: IntArray
    """Which of the observed nodes are moved by a jump, shape (W,)."""
    missing_groups: int
    """Of false closures, for which there were no places."""

    @property
    def loops(self) -> Factors:
        """Loop closures."""
        return self.edges.rows(self.edges.kind == FactorKind.LOOP_CLOSURE)

    def graph(self, poses: FloatArray) -> Graph:
        """Return the graph with some poses, shape (N, 3); its first node is fixed if need be."""
        graph = Graph()
        graph.apply(GraphUpdate(hidden=poses, factors=Factors.joined([self.edges, self.observed]),
                                fix=[0] if len(self.observed) == 0 else []))
        return graph


def graph_of(way: Course, node_distance: Metres) -> SimulatedGraph:
    """
    Return a graph along a course, in the frame in which it begins, or in that of the world.

    The latter if there are fixes or global poses.
    """
    setup, streams = way.setup, way.streams
    at = np.unique(np.searchsorted(
        way.motion.distance, np.arange(0.0, way.motion.distance[-1], node_distance)))
    if len(at) < 2:
        raise ConfigError(f'distance of nodes: expected less than what is driven, '
                          f'{way.motion.distance[-1]:.3g} m, got {node_distance:g} m')
    poses = se2.wrapped(way.motion.truth.poses[at])
    if setup.fixes is None and setup.poses is None:
        poses = se2.between(poses[0], poses)
    truth = Trajectory(way.motion.truth.stamps_ns[at], poses)
    odometry = odometry_edges(streams['odometry'], truth, setup.jumps_of(ODOMETRY))
    loops, group, missing = _loop_edges(way, Motion(truth, way.motion.distance[at]), node_distance)
    fixes, wrong_fixes = _observed(way, truth, FIXES)
    absolute, wrong_poses = _observed(way, truth, POSES)
    return SimulatedGraph(
        truth, se2.composed(poses[0], odometry.mean), Factors.joined((odometry, loops)), group,
        Factors.joined((fixes, absolute)),
        np.append(wrong_fixes, len(fixes) + wrong_poses), missing)


def odometry_edges(generator: Generator, truth: Trajectory,
                   jumps: Iterable[settings.Jump] = ()) -> Factors:
    """Return the edges from each node to the next, with the noise of the model."""
    steps, n = se2.between(truth.poses[:-1], truth.poses[1:]), len(truth) - 1
    variances = sensors.model_variances(steps)
    mean = se2.compose(steps, np.sqrt(variances) * generator.standard_normal(steps.shape))
    for jump in jumps:
        if jump.step is None:
            raise ConfigError(f'jump of {ODOMETRY}: in a graph it cannot begin again, expected '
                              'DX,DY')
        k = int(np.searchsorted(truth.stamps_ns, settings.START_NS + round(jump.at_s * 1e9))) - 1
        if 0 <= k < n:
            mean[k] = se2.compose(mean[k], np.array(jump.step))
    information = np.zeros((n, 3, 3))
    information[:, range(3), range(3)] = 1.0 / variances
    return Factors(np.arange(n), np.arange(1, n + 1), mean, information,
                   np.full(n, FactorKind.ODOMETRY))


def _loop_edges(way: Course, path: Motion, node_distance: float) -> tuple[Factors, IntArray, int]:
    """Return loop closures, the group of each, and how many groups are missing."""
    closures, streams, truth = way.setup.closures, way.streams, path.truth
    if closures is None:
        return Factors(), np.empty(0, dtype=np.int64), 0
    closures = replace(closures, first_s=0.0)
    # so that no two closures of a group have the same ends
    spacing = max(closures.false.spacing, 1.5 * node_distance)
    closures = replace(closures, false=replace(closures.false, spacing=spacing))
    old, new = sensors.revisits(streams['closures'], path, np.arange(len(truth)), closures)
    found = streams['rate'].random(len(old)) < closures.rate
    old, new = old[found], new[found]
    noise = streams['closures'].normal(0.0, closures.sigmas, (len(new), 3))
    poses = se2.compose(se2.between(truth.poses[old], truth.poses[new]), noise)
    every, missing = sensors.with_false(
        streams['false'], path, closures, truth.stamps_ns[np.column_stack((old, new))], poses)
    every = every.rows(sensors.heard(every.later_ns, CLOSURES, way.setup.outages))
    ends = np.searchsorted(truth.stamps_ns, every.stamps_ns)
    information = np.diag(np.array(way.setup.sigmas(CLOSURES))**-2)
    edges = Factors(ends[:, 0], ends[:, 1], every.values, np.tile(information, (len(ends), 1, 1)),
                    np.full(len(ends), FactorKind.LOOP_CLOSURE))
    return edges, every.wrong, missing


def _observed(way: Course, truth: Trajectory, topic: str) -> tuple[Factors, IntArray]:
    """Return fixes or global poses, each with its error moved to the nearest node; the wrong."""
    found = absolute(way, topic, way.motion.truth)
    stamps, values, wrong = found.rows(sensors.heard(found.stamps_ns, topic, way.setup.outages))
    if len(stamps) == 0:
        return Factors(), np.empty(0, dtype=np.int64)
    kind = FactorKind.POSITION if topic == FIXES else FactorKind.GLOBAL_POSE
    width = values.shape[1]
    errors = values - way.motion.truth.at(stamps)[:, :width]
    # the nearest node in time, and the first of those that are nearest to it
    after = np.clip(np.searchsorted(truth.stamps_ns, stamps), 1, len(truth) - 1)
    nearer = stamps - truth.stamps_ns[after - 1] < truth.stamps_ns[after] - stamps
    nodes, first = np.unique(np.where(nearer, after - 1, after), return_index=True)
    mean, information = np.zeros((len(nodes), 3)), np.zeros((len(nodes), 3, 3))
    mean[:, :width] = truth.poses[nodes, :width] + errors[first]
    information[:, range(width), range(width)] = np.array(way.setup.sigmas(topic))**-2
    return (Factors.on(nodes, None, se2.wrapped(mean), information, np.full(len(nodes), kind)),
            np.flatnonzero(wrong[first] >= 0))
