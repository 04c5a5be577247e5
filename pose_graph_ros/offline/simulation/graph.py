# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A simulated graph: nodes along a course, with odometry, closures, fixes and global poses.

Its information is honest: every error is drawn from the covariance that comes with it, but for
what is false or moved, and for a claimed sigma that is not 1. So chi2 at the truth, without these,
is distributed as chi-square with as many degrees of freedom as there are measured numbers.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.quantities import Metres
from pose_graph_ros.offline.simulation import sensors
from pose_graph_ros.offline.simulation.motion import Motion
from pose_graph_ros.offline.simulation.recording import absolute, Course
from pose_graph_ros.offline.simulation.settings import (
    CLOSURES,
    FIXES,
    Jump,
    ODOMETRY,
    POSES,
    START_NS,
)


@dataclass(frozen=True, slots=True)
class SimulatedGraph:
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
    loops, group, missing = _closures(
        way, Motion(truth, way.motion.distance[at]), node_distance)
    fixes, wrong_fixes = _observed(way, truth, FIXES)
    absolute, wrong_poses = _observed(way, truth, POSES)
    return SimulatedGraph(
        truth, composed(poses[0], odometry.mean), Factors.joined((odometry, loops)), group,
        Factors.joined((fixes, absolute)),
        np.append(wrong_fixes, len(fixes) + wrong_poses), missing)


def odometry_edges(
    generator: np.random.Generator, truth: Trajectory, jumps: Iterable[Jump] = (),
) -> Factors:
    """Return the edges from each node to the next, with the noise of the model."""
    steps, n = se2.between(truth.poses[:-1], truth.poses[1:]), len(truth) - 1
    variances = sensors.model_variances(steps)
    mean = se2.compose(steps, np.sqrt(variances) * generator.standard_normal(steps.shape))
    for jump in jumps:
        if jump.step is None:
            raise ConfigError(f'jump of {ODOMETRY}: in a graph it cannot begin again, expected '
                              'DX,DY')
        k = int(np.searchsorted(truth.stamps_ns, START_NS + round(jump.at_s * 1e9))) - 1
        if 0 <= k < n:
            mean[k] = se2.compose(mean[k], np.array(jump.step))
    information = np.zeros((n, 3, 3))
    information[:, range(3), range(3)] = 1.0 / variances
    return Factors(np.arange(n), np.arange(1, n + 1), mean, information,
                 np.full(n, FactorKind.ODOMETRY))


def composed(first: FloatArray, steps: FloatArray) -> FloatArray:
    """Return the poses that steps (N, 3) lead to, shape (N + 1, 3)."""
    heading = first[2] + np.concatenate(([0.0], np.cumsum(steps[:, 2])))
    moves = np.einsum('nij,nj->ni', se2.rotation(heading[:-1]), steps[:, :2])
    positions = first[:2] + np.concatenate((np.zeros((1, 2)), np.cumsum(moves, axis=0)))
    return se2.wrapped(np.column_stack((positions, heading)))


def _closures(way: Course, path: Motion, node_distance: float) -> tuple[Factors, IntArray, int]:
    """Return loop closures, the group of each, and how many groups are missing."""
    settings, streams, truth = way.setup.closures, way.streams, path.truth
    if settings is None:
        return Factors(), np.empty(0, dtype=np.int64), 0
    settings = replace(settings, first_s=0.0)
    # so that no two closures of a group have the same ends
    spacing = max(settings.false.spacing, 1.5 * node_distance)
    settings = replace(settings, false=replace(settings.false, spacing=spacing))
    old, new = sensors.revisits(streams['closures'], path, np.arange(len(truth)), settings)
    found = streams['rate'].random(len(old)) < settings.rate
    old, new = old[found], new[found]
    poses = sensors.closure_poses(
        streams['closures'], truth.poses[old], truth.poses[new], settings)
    every, missing = sensors.with_false(
        streams['false'], path, settings, truth.stamps_ns[np.column_stack((old, new))], poses)
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
