# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What sensors measure along a true motion, and what disturbs them.

Truth is given densely, in the frame of the world. Disturbances are jumps, outages, delays,
disorder and messages that come twice.

Place recognition is wrong in two ways. A single image looks like one of anywhere. And a whole
stretch is taken for another one that looks like it, such as an aisle of a hall for the next, which
gives a group of closures that agree with one another.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree

from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.offline.simulation import settings
from pose_graph_ros.offline.simulation.settings import Closures, Setup, START_NS, Wheels
from pose_graph_ros.offline.simulation.worlds import gauss_markov, Motion, PERIOD_S

ODOMETRY_PERIOD_S = 0.05
TRIES, TRIED = 10_000, 8
"""Pairs of places that are tried for so many groups; a short drive has none that look alike."""
AGAIN_S = 1.0  # within which a message that comes twice comes again
MOVING = 1e-4  # motion in a period of the truth above which wheels turn [m]
MODEL = OdometryNoise()
CELL_S = 1.0
"""
How often errors of odometry by the model are drawn [s].

The engine sums up the turns that odometry shows; errors of each sample would lengthen that sum.
"""


class Measured(NamedTuple):
    """What a sensor says, M times."""

    stamps_ns: IntArray  # shape (M,); of closures (M, 2), of the earlier and the later pose [ns]
    values: FloatArray
    wrong: IntArray  # number of the jump, or of the group of false closures; -1: right, shape (M,)

    @property
    def later_ns(self) -> IntArray:
        """When it was measured, shape (M,) [ns]."""
        return self.stamps_ns if self.stamps_ns.ndim == 1 else self.stamps_ns[:, 1]

    def rows(self, which: BoolArray | IntArray) -> 'Measured':
        """Return some of it."""
        return Measured(self.stamps_ns[which], self.values[which], self.wrong[which])


def jittered_stamps(generator: Generator, truth: Trajectory, period_s: float) -> IntArray:
    """
    Return stamps of a sensor during the truth, with random phase and jitter, shape (M,) [ns].
    """
    span = truth.stamps_ns[-1] - truth.stamps_ns[0]
    ticks = np.arange(generator.uniform(0.2, 0.8), span * 1e-9 / period_s - 0.2)
    ticks += np.clip(generator.normal(0.0, 0.01, len(ticks)), -0.1, 0.1)
    return np.asarray(truth.stamps_ns[0] + np.round(ticks * period_s * 1e9).astype(np.int64))


def odometry(generator: Generator, truth: Trajectory, wheels: Wheels) -> Trajectory:
    """Return `T_odom_base` by odometry."""
    measured = (_by_wheels if wheels.errors is settings.OdometryErrors.WHEELS else _by_model)(
        generator, se2.between(truth.poses[:-1], truth.poses[1:]), wheels)
    x, y, turned = (0.0, 0.0, -truth.poses[0, 2]) if wheels.start is None else wheels.start
    heading = se2.wrap(truth.poses[0, 2] + turned) + np.concatenate((
        [0.0], np.cumsum(measured[:, 2])))
    middle = 0.5 * (heading[1:] + heading[:-1])
    moves = measured[:, :1] * np.column_stack((np.cos(middle), np.sin(middle)))
    moves += measured[:, 1:2] * np.column_stack((-np.sin(middle), np.cos(middle)))
    positions = np.array([x, y]) + np.concatenate(([[0.0, 0.0]], np.cumsum(moves, axis=0)))
    dense = Trajectory(truth.stamps_ns, np.column_stack((positions, se2.wrap(heading))))
    stamps = jittered_stamps(generator, truth, ODOMETRY_PERIOD_S)
    return Trajectory(stamps, dense.at(stamps))


def _by_wheels(generator: Generator, steps: FloatArray, wheels: Wheels) -> FloatArray:
    """Return the motions that the wheels measure, ahead, sideways and turned, shape (N, 3)."""
    forward, turn = np.hypot(steps[:, 0], steps[:, 1]), steps[:, 2]
    left = wheels.scale[0] * (forward - 0.5 * wheels.track_width * turn)
    right = wheels.scale[1] * (forward + 0.5 * wheels.track_width * turn)

    # the inner wheel skids slightly in turns, and sometimes a wheel spins for half a second
    turning = np.abs(turn) / PERIOD_S
    left *= 1.0 + np.where(turn > 0.0, 0.02, 0.005) * turning
    right *= 1.0 + np.where(turn < 0.0, 0.02, 0.005) * turning
    impulses = generator.random((2, len(steps))) < wheels.slip_events_per_s * PERIOD_S
    spin = gaussian_filter1d(impulses / PERIOD_S, 0.2 / PERIOD_S)
    left *= 1.0 + wheels.slip_s * spin[0]
    right *= 1.0 + wheels.slip_s * spin[1]

    wander = gauss_markov(generator, len(steps), wheels.wander, PERIOD_S / wheels.wander_time_s)
    forward = 0.5 * (left + right) + generator.normal(0.0, 3e-4, len(steps)) * (forward > MOVING)
    turn = (right - left) / (wheels.track_scale * wheels.track_width) + np.where(
        forward > MOVING, wander * PERIOD_S, 0.0) + wheels.heading_drift * forward
    return np.column_stack((forward, np.zeros(len(steps)), turn))


def _by_model(generator: Generator, steps: FloatArray, wheels: Wheels) -> FloatArray:
    """Return the motions with the noise that the node assumes, shape (N, 3)."""
    variances = model_variances(steps)
    cells = (PERIOD_S / CELL_S * np.arange(len(steps))).astype(np.int64)
    n_cells, noise = int(cells[-1]) + 1, np.empty_like(steps)
    for axis in range(3):
        whole = np.bincount(cells, variances[:, axis], n_cells)
        drawn = generator.standard_normal(n_cells) * np.sqrt(whole)
        noise[:, axis] = variances[:, axis] * (drawn / np.where(whole > 0.0, whole, 1.0))[cells]
    noise[:, 2] += wheels.heading_drift * np.hypot(steps[:, 0], steps[:, 1])
    return steps + noise


def model_variances(steps: FloatArray, model: OdometryNoise = MODEL) -> FloatArray:
    """
    Return the variances of motions by a noise model of the node, but for its floors.

    In: motions of the robot, shape (N, 3). Out: variances in its frame, shape (N, 3).
    """
    distance, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    return np.column_stack((model.sigma_distance**2 * distance, model.sigma_lateral**2 * distance,
                            model.sigma_heading_distance**2 * distance
                            + model.sigma_heading_turn**2 * turn))


def velocities(path: Trajectory) -> FloatArray:
    """Return the mean velocity before each pose, in its frame, shape (N, 3) [m/s, m/s, rad/s]."""
    steps = se2.between(path.poses[:-1], path.poses[1:])
    rates = steps / (np.diff(path.stamps_ns) * 1e-9)[:, None]
    return np.concatenate((rates[:1], rates))


def yaw_rates(generator: Generator, heading: FloatArray, gyro: settings.Gyro) -> FloatArray:
    """Return yaw rates, (R,) [rad/s], given true headings every `PERIOD_S`, not wrapped [rad]."""
    n = len(heading)
    walk = np.cumsum(generator.normal(0.0, gyro.bias_walk * np.sqrt(PERIOD_S), n))
    bias = generator.normal(0.0, gyro.bias) + walk
    noise = generator.normal(0.0, gyro.sigma / np.sqrt(PERIOD_S), n)
    return np.asarray(np.gradient(heading, PERIOD_S) + bias + noise)


def positions(generator: Generator, truth: Trajectory,
              fixes: settings.Fixes) -> tuple[IntArray, FloatArray]:
    """Return the stamps of fixes, shape (M,), and their positions, shape (M, 2) [m]."""
    stamps = jittered_stamps(generator, truth, fixes.period_s)
    errors = np.column_stack([
        gauss_markov(generator, len(stamps), fixes.correlated,
                     fixes.period_s / fixes.correlation_s)
        + generator.normal(0.0, fixes.white, len(stamps)) for _ in range(2)])
    return stamps, truth.at(stamps)[:, :2] + errors


def revisits(generator: Generator, path: Motion, places: IntArray,
             closures: Closures) -> tuple[IntArray, IntArray]:
    """
    Return the earlier and the later pose of true closures, shape (L,) each, as numbers of places.
    """
    poses, stamps = path.truth.poses[places], path.truth.stamps_ns[places]
    pairs = KDTree(poses[:, :2]).query_pairs(closures.radius, output_type='ndarray')
    old, new = np.sort(pairs, axis=1).T
    good = ((stamps[new] - stamps[old] > closures.min_time_s * 1e9)
            & (path.distance[places[new]] - path.distance[places[old]] > closures.min_distance)
            & (np.abs(se2.wrap(poses[new, 2] - poses[old, 2])) < closures.angle))
    old, new = old[good], new[good]
    # one random pair of each stretch of the path
    order = generator.permutation(len(new))
    _, first = np.unique(path.distance[places[new[order]]] // closures.spacing, return_index=True)
    return old[order[first]], new[order[first]]


def with_false(generator: Generator, path: Motion, closures: Closures, ends: IntArray,
               poses: FloatArray) -> tuple[Measured, int]:
    """
    Return true closures and false ones by their later ends, and how many groups are missing.

    In: the stamps of the true ones, shape (L, 2), and the measured poses, shape (L, 3). Groups are
    missing where the path has too few places that are apart and driven in the same direction.
    """
    false, sizes = closures.false, closures.false.sizes(len(ends))
    begin = max(1, int(np.searchsorted(
        path.truth.stamps_ns, path.truth.stamps_ns[0] + round(false.from_s * 1e9))))
    stretch = max(sizes, default=1) * false.spacing
    last = int(np.searchsorted(path.distance, path.distance[-1] - stretch))
    first = int(np.searchsorted(
        path.truth.stamps_ns, path.truth.stamps_ns[0] + round(closures.first_s * 1e9)))
    found, of, k = list[tuple[int, int]](), list[int](), 0
    for _ in range(TRIES * -(-len(sizes) // TRIED) if last > begin else 0):
        if k == len(sizes):
            break
        new = int(generator.integers(begin, last))
        old = int(generator.integers(0, new))
        along = false.spacing * np.arange(sizes[k])
        at = np.searchsorted(path.distance, path.distance[[old, new]][:, None] + along)
        places = path.truth.poses[at]
        away = np.hypot(*np.moveaxis(places[1] - places[0], -1, 0)[:2])
        alike = np.abs(se2.wrap(places[1, :, 2] - places[0, :, 2])) < closures.angle
        if np.all(away > false.min_distance) and np.all(alike) and first <= at[0, 0] and (
                at[0, -1] < at[1, 0]):
            found += list(zip(*at.tolist(), strict=True))
            of += [k] * sizes[k]
            k += 1
    # the ends of false closures, and the number of the group of each, in order
    pairs, groups = np.array(found, dtype=np.int64).reshape(-1, 2), np.array(of, dtype=np.int64)
    # what they measure is nearly one place
    seen = generator.normal(
        0.0, (0.5 * closures.radius, 0.25 * closures.radius, 0.05), (len(pairs), 3))
    if not false.loose:
        # those of a group agree with each other as true ones would: both stretches are laid upon
        # one another at its first closure
        _, leads, group = np.unique(groups, return_index=True, return_inverse=True)
        (starts, stops), lead = path.truth.poses[pairs].transpose(1, 0, 2), leads[group]
        laid = se2.compose(se2.inverse(se2.between(starts[lead], starts)), seen[lead])
        seen = se2.compose(se2.compose(laid, se2.between(stops[lead], stops)),
                           generator.normal(0.0, closures.sigmas, (len(pairs), 3)))
    every = Measured(np.concatenate((ends, path.truth.stamps_ns[pairs])),
                     np.concatenate((poses, seen)), np.append(np.full(len(ends), -1), groups))
    return (every.rows(np.argsort(every.later_ns, kind='stable')),
            len(sizes) - len(np.unique(groups)))


def jumped(odometry: Trajectory, setup: Setup) -> Trajectory:
    """Return odometry with its jumps, in the order of their times."""
    poses = odometry.poses.copy()
    for jump in sorted(setup.jumps_of(settings.ODOMETRY), key=lambda each: each.at_s):
        k = int(np.searchsorted(odometry.stamps_ns, START_NS + round(jump.at_s * 1e9)))
        # where it is, moved in the frame of the robot, or the origin
        if k < len(poses):
            there = se2.compose(poses[k], np.array(jump.step)) if jump.step else np.zeros(3)
            poses[k:] = se2.compose(there, se2.between(poses[k], poses[k:]))
    return Trajectory(odometry.stamps_ns, poses)


def moved(generator: Generator, stamps_ns: IntArray, values: FloatArray,
          jumps: list[settings.Jump]) -> Measured:
    """Return fixes or global poses, shape (M, 2 or 3), with jumps."""
    time = (stamps_ns - START_NS) * 1e-9
    values, wrong = values.copy(), np.full(len(values), -1)
    for number, jump in enumerate(jumps):
        assert jump.step is not None
        now = (time >= jump.at_s) & (time < jump.at_s + jump.seconds)
        values[now] += jump.step[:values.shape[1]]
        values[now, :2] += generator.normal(0.0, jump.sigma, (int(np.sum(now)), 2))
        wrong[now] = number
    return Measured(stamps_ns, values, wrong)


def heard(stamps_ns: IntArray, topic: str, outages: Iterable[settings.Outage]) -> BoolArray:
    """Return which measurements of a topic are in no outage, shape (M,)."""
    time = (stamps_ns - START_NS) * 1e-9
    kept = np.ones(len(stamps_ns), dtype=bool)
    for outage in (each for each in outages if each.topic == topic):
        kept &= (time < outage.begin_s) | (time >= outage.end_s)
    return kept


def arrivals(generator: Generator, topic: str, stamps_ns: IntArray,
             setup: Setup) -> tuple[IntArray, IntArray]:
    """
    Return which messages of a topic are recorded, and when [ns], shape (K,) each, by that time.
    """
    n = len(stamps_ns)
    late, again = generator.random(n), generator.random((2, n))
    seconds = np.full(n, settings.LATENCY_S[topic])
    for delay in (each for each in setup.delays if each.topic == topic):
        seconds = delay.seconds + delay.jitter_s * late
    recorded = stamps_ns + np.round(seconds * 1e9).astype(np.int64)
    index = np.arange(n)
    for twice in (each for each in setup.duplicates if each.topic == topic):
        chosen = np.flatnonzero(again[0] < twice.share)
        index = np.append(index, chosen)
        recorded = np.append(recorded, recorded[chosen] + np.round(
            AGAIN_S * 1e9 * again[1, chosen]).astype(np.int64))
    order = np.argsort(recorded, kind='stable')
    return index[order], recorded[order]
