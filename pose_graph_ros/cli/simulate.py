# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Simulate a drive through some city blocks with known ground truth, and write it as a rosbag2.

The car of `circuit` drives along some streets twice, on the second lap along all of them. It has

- wheel odometry: two wheels with wrong radii, a wrong track width, slip in turns and in a few
  events, and a drifting heading; the odometry frame is rotated by about 2 rad against the map;
- fixes: a slow (Gauss-Markov) and a white error, an outage of 70 s around the start of lap 2, and
  a stretch with reflected signals (multipath), which put them to one side while they claim to be
  as good as ever;
- on request a gyroscope, with white noise and a bias that wanders, and wheels whose heading drifts
  with the distance;
- loop closures at places that are visited again in the same direction, and false ones: a stretch
  of one street is taken for one of another, and single pictures for any that look alike.

The frame `map` is east and north on the plane that touches the ellipsoid at the measured position
of the *first fix of the bag*, including its error, because a localisation that starts from fixes
has no better origin. The antenna is above base_link.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree

from pose_graph_ros.cli.bag_messages import (
    fix_messages,
    loop_closure_messages,
    odometry_messages,
    rate_messages,
    write_bag,
)
from pose_graph_ros.cli.circuit import drive_circuit, gauss_markov, PERIOD_S
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory

START_NS = 1_746_518_400_250_000_000  # stamp of the start [ns]
CITY = TangentPlane(50.7271, 7.0866, 61.0)  # the circuit begins where it touches the ellipsoid
ODOMETRY_PERIOD_S = 0.05
TRACK_WIDTH = 1.5  # distance of the wheels [m]
WHEEL_SCALE = (1.0068, 1.0070)  # ratio of measured to true distance, left and right
TRACK_SCALE = 1.012  # ratio of assumed to true track width
SLIP_EVENTS_PER_S = 1.0 / 60.0
SLIP_S = 0.012  # relative excess of a wheel's speed in a slip event, integrated over it [s]
HEADING_WANDER = 1.2e-3  # standard deviation of the time-correlated error of the yaw rate [rad/s]
WANDER_TIME_S = 40.0  # time constant of this error [s]
ODOMETRY_VARIANCES = (1e-3, 1e-3, 1e6, 1e6, 1e6, 3e-2)  # constant, as many drivers set them
GYRO_SIGMA = 5e-4  # white noise of the gyroscope, as the angle random walk [rad/sqrt(s)]
GYRO_BIAS, GYRO_BIAS_WALK = 0.01, 2e-5  # bias at the start [rad/s], its walk [rad/s/sqrt(s)]
FIX_PERIOD_S = 0.5
FIX_SIGMA_SLOW = 1.2  # standard deviation of the time-correlated error of fixes [m]
FIX_SIGMA_WHITE = 0.4  # and of their white error [m]
FIX_SIGMA = float(np.hypot(FIX_SIGMA_SLOW, FIX_SIGMA_WHITE))
FIX_CORRELATION_S = 60.0  # time constant of the time-correlated error [s]
MULTIPATH_S = (150.0, 175.0)  # start and end of the reflections, from the start of the drive [s]
MULTIPATH_OFFSET = (14.0, -9.0)  # what they add to the fixes, to the east and to the north [m]
MULTIPATH_SIGMA = 1.5  # standard deviation of its changes from fix to fix [m]
OUTAGE_S = (-40.0, 30.0)  # start and end of the outage of fixes from the second lap on [s]
LATENCIES_NS = {'/odom': 4_000_000, '/ground_truth': 4_000_000, '/gps/fix': 130_000_000,
                '/loop_closure': 800_000_000, '/imu/data': 2_000_000}
"""Time from the stamp of a measurement to its recording, by topic [ns]."""
LOOP_SIGMAS = (0.1, 0.1, np.deg2rad(1.0))  # standard deviations of loop closures [m, m, rad]
LOOP_SPACING = 25.0  # length of the stretches of the path with at most one loop closure each [m]
# Largest distance [m] and angle [rad] between the true poses of a loop closure, and smallest time
# [s] and driven distance [m] between them.
LOOP_RADIUS, LOOP_ANGLE = 2.0, np.deg2rad(20.0)
LOOP_MIN_TIME_S, LOOP_MIN_DISTANCE = 15.0, 50.0
# False loop closures: single ones, and ones in a group along two streets; smallest distance of the
# two places, spacing of the group [m], and when they begin [s].
FALSE_SINGLE, FALSE_GROUP = 4, 4
FALSE_MIN_DISTANCE, FALSE_SPACING, FALSE_FROM_S = 40.0, 6.0, 100.0
FALSE_TRIES = 10_000  # of pairs of places; a short drive has none that look alike


@dataclass(frozen=True, slots=True)
class SimulatedDrive:
    """Measurements and true poses of a simulated drive."""

    truth: Trajectory  # true poses, `T_map_base`
    odometry: Trajectory  # measured poses, `T_odom_base`
    fix_stamps_ns: IntArray  # stamps of the fixes, shape (M,) [ns]
    fixes: FloatArray  # latitude, longitude and ellipsoidal height, shape (M, 3) [deg, deg, m]
    loop_stamps_ns: IntArray  # of the earlier and later pose of loop closures, shape (L, 2) [ns]
    loop_poses: FloatArray  # measured later pose in the earlier one, shape (L, 3) [m, m, rad]
    fix_is_wrong: BoolArray  # whether a fix is a reflected one, shape (M,)
    loop_is_false: BoolArray  # whether a loop closure ties two different places, shape (L,)
    rate_stamps_ns: IntArray  # of the gyroscope, shape (R,) [ns]; none without one
    rates: FloatArray  # its yaw rates, shape (R,) [rad/s]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of this tool."""
    parser.add_argument('out', type=Path, help='folder of the rosbag2')
    parser.add_argument('--seed', type=int, default=1, help='(default: %(default)s)')
    parser.add_argument('--gyro', action='store_true', help='with a gyroscope on /imu/data')
    parser.add_argument('--heading-drift', metavar='RAD_PER_M', type=float, default=0.0,
                        help='drift of the heading by the wheels [rad/m] (default: %(default)s)')


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    write_drive(simulate_drive(options.seed, gyro=options.gyro,
                               heading_drift=options.heading_drift), options.out)
    print(f'written: {options.out}')
    return 0


def simulate_drive(
    seed: int = 1, duration_s: float = 440.0, *, gyro: bool = False, heading_drift: float = 0.0,
) -> SimulatedDrive:
    """
    Return a simulated drive; equal arguments give equal drives.

    Parameters
    ----------
    seed : int
        Seed of the sensor errors, the position within the lane and the waits at traffic lights.
    duration_s : float
        Length of the recording, 10 s or more [s]; the second lap begins after about 310 s.
    gyro : bool, whether with a gyroscope; all else is the same without
    heading_drift : float, what the heading by the wheels drifts by, per distance [rad/m]

    """
    generator = np.random.default_rng(seed)
    motion = drive_circuit(generator, duration_s)
    truth = Trajectory(START_NS + np.round(motion.time * 1e9).astype(np.int64), motion.poses)

    odometry = _odometry(generator, truth, heading_drift)
    fix_stamps, fix_positions = _fixes(generator, truth, motion.lap_time)
    loop_stamps, loop_poses = _loop_closures(generator, truth, motion.distance)

    wrong = _reflect(generator, fix_stamps, fix_positions)
    false_stamps, false_poses = _false_loop_closures(generator, truth, motion.distance)
    order = np.argsort(np.append(loop_stamps[:, 1], false_stamps[:, 1]), kind='stable')
    is_false = order >= len(loop_stamps)

    fixes = CITY.to_geodetic(fix_positions)
    rates = _rates(seed, motion.poses[:, 2]) if gyro else np.empty(0)
    truth_stamps = _jittered_stamps(generator, truth, ODOMETRY_PERIOD_S)
    poses = truth.at(truth_stamps)
    plane = TangentPlane(*fixes[0].tolist())
    poses[:, :2] = plane.to_map(*CITY.to_geodetic(poses[:, :2]).T)
    return SimulatedDrive(
        truth=Trajectory(truth_stamps, poses), odometry=odometry,
        fix_stamps_ns=fix_stamps, fixes=fixes, fix_is_wrong=wrong, loop_is_false=is_false,
        loop_stamps_ns=np.concatenate((loop_stamps, false_stamps))[order],
        loop_poses=np.concatenate((loop_poses, false_poses))[order],
        rate_stamps_ns=truth.stamps_ns[:len(rates)], rates=rates)


def write_drive(drive: SimulatedDrive, folder: str | Path, *, overwrite: bool = False) -> None:
    """
    Write a drive as a rosbag2 with `/odom`, `/gps/fix`, `/loop_closure` and `/ground_truth`.

    With a gyroscope it has `/imu/data` as well.

    Parameters
    ----------
    overwrite : bool, whether to replace an existing bag; otherwise one raises `BagError`

    """
    messages = (
        *odometry_messages('/odom', 'odom', drive.odometry, ODOMETRY_VARIANCES),
        *odometry_messages('/ground_truth', 'map', drive.truth, (0.0,) * 6),
        *rate_messages('/imu/data', drive.rate_stamps_ns, drive.rates,
                       GYRO_SIGMA / np.sqrt(PERIOD_S)),
        *fix_messages('/gps/fix', drive.fix_stamps_ns, drive.fixes, FIX_SIGMA),
        *loop_closure_messages('/loop_closure', drive.loop_stamps_ns, drive.loop_poses,
                               np.diag(np.square(LOOP_SIGMAS))))
    write_bag(folder, ((topic, type_name, stamp_ns + LATENCIES_NS[topic], message)
                       for topic, type_name, stamp_ns, message in messages), overwrite=overwrite)


def _jittered_stamps(
    generator: np.random.Generator, truth: Trajectory, period_s: float,
) -> IntArray:
    """Return stamps of a sensor during the truth, with random phase and jitter [ns]."""
    span = truth.stamps_ns[-1] - truth.stamps_ns[0]
    ticks = np.arange(generator.uniform(0.2, 0.8), span * 1e-9 / period_s - 0.2)
    ticks += np.clip(generator.normal(0.0, 0.01, len(ticks)), -0.1, 0.1)
    stamps: IntArray = truth.stamps_ns[0] + np.round(ticks * period_s * 1e9).astype(np.int64)
    return stamps


def _rates(seed: int, heading: FloatArray) -> FloatArray:
    """Return the yaw rates of a gyroscope at all true headings, which are not wrapped, (R,)."""
    generator, n = np.random.default_rng((seed, 1)), len(heading)
    walk = np.cumsum(generator.normal(0.0, GYRO_BIAS_WALK * np.sqrt(PERIOD_S), n))
    bias = generator.normal(0.0, GYRO_BIAS) + walk
    noise = generator.normal(0.0, GYRO_SIGMA / np.sqrt(PERIOD_S), n)
    return np.asarray(np.gradient(heading, PERIOD_S) + bias + noise)


def _odometry(
    generator: np.random.Generator, truth: Trajectory, heading_drift: float,
) -> Trajectory:
    """Return `T_odom_base`, integrated from simulated measurements of the wheels."""
    steps = se2.between(truth.poses[:-1], truth.poses[1:])
    forward, turn = np.hypot(steps[:, 0], steps[:, 1]), steps[:, 2]
    left = WHEEL_SCALE[0] * (forward - 0.5 * TRACK_WIDTH * turn)
    right = WHEEL_SCALE[1] * (forward + 0.5 * TRACK_WIDTH * turn)

    # the inner wheel skids slightly in turns, and sometimes a wheel spins for half a second
    turning = np.abs(turn) / PERIOD_S
    left *= 1.0 + np.where(turn > 0.0, 0.02, 0.005) * turning
    right *= 1.0 + np.where(turn < 0.0, 0.02, 0.005) * turning
    impulses = generator.random((2, len(steps))) < SLIP_EVENTS_PER_S * PERIOD_S
    spin = gaussian_filter1d(impulses / PERIOD_S, 0.2 / PERIOD_S)
    left *= 1.0 + SLIP_S * spin[0]
    right *= 1.0 + SLIP_S * spin[1]

    wander = gauss_markov(generator, len(steps), HEADING_WANDER, PERIOD_S / WANDER_TIME_S)
    forward = 0.5 * (left + right) + generator.normal(0.0, 3e-4, len(steps)) * (forward > 1e-4)
    turn = (right - left) / (TRACK_SCALE * TRACK_WIDTH) + np.where(
        forward > 1e-4, wander * PERIOD_S, 0.0) + heading_drift * forward

    start = se2.wrap(truth.poses[0, 2] - 2.0)
    heading = start + np.concatenate(([0.0], np.cumsum(turn)))
    middle = 0.5 * (heading[1:] + heading[:-1])
    moves = forward[:, None] * np.column_stack((np.cos(middle), np.sin(middle)))
    positions = np.array([3.2, -1.4]) + np.concatenate(([[0.0, 0.0]], np.cumsum(moves, axis=0)))
    dense = Trajectory(truth.stamps_ns, np.column_stack((positions, se2.wrap(heading))))
    stamps = _jittered_stamps(generator, truth, ODOMETRY_PERIOD_S)
    return Trajectory(stamps, dense.at(stamps))


def _fixes(
    generator: np.random.Generator, truth: Trajectory, lap_time: float,
) -> tuple[IntArray, FloatArray]:
    """Return stamps and positions (M, 2) of the fixes in the frame of the city [m]."""
    stamps = _jittered_stamps(generator, truth, FIX_PERIOD_S)
    errors = np.column_stack([
        gauss_markov(generator, len(stamps), FIX_SIGMA_SLOW, FIX_PERIOD_S / FIX_CORRELATION_S)
        + generator.normal(0.0, FIX_SIGMA_WHITE, len(stamps)) for _ in range(2)])
    time = (stamps - truth.stamps_ns[0]) * 1e-9 - lap_time
    received = (time < OUTAGE_S[0]) | (time > OUTAGE_S[1])
    return stamps[received], (truth.at(stamps)[:, :2] + errors)[received]


def _reflect(
    generator: np.random.Generator, stamps_ns: IntArray, positions: FloatArray,
) -> BoolArray:
    """Move the fixes of a stretch to one side, in place; return which ones."""
    time = (stamps_ns - START_NS) * 1e-9
    wrong: BoolArray = (time > MULTIPATH_S[0]) & (time < MULTIPATH_S[1])
    positions[wrong] += MULTIPATH_OFFSET + generator.normal(
        0.0, MULTIPATH_SIGMA, (int(np.sum(wrong)), 2))
    return wrong


def _false_loop_closures(
    generator: np.random.Generator, truth: Trajectory, distance: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """Return stamps (L, 2) and measured poses (L, 3) of loop closures between two places."""
    begin = int(np.searchsorted(truth.stamps_ns, START_NS + round(FALSE_FROM_S * 1e9)))
    stretch = FALSE_GROUP * FALSE_SPACING
    last = int(np.searchsorted(distance, distance[-1] - stretch))
    pairs: list[tuple[int, int]] = []
    for _ in range(FALSE_TRIES if last > begin else 0):
        if len(pairs) == FALSE_SINGLE + FALSE_GROUP:
            break
        new = int(generator.integers(begin, last))
        old = int(generator.integers(0, new))
        along = FALSE_SPACING * np.arange(FALSE_GROUP if len(pairs) == 0 else 1)
        at = np.searchsorted(distance, distance[[old, new]][:, None] + along)
        places = truth.poses[at]
        away = np.hypot(*(places[1] - places[0])[:, :2].T)
        alike = np.abs(se2.wrap(places[1, :, 2] - places[0, :, 2])) < LOOP_ANGLE
        if np.all(away > FALSE_MIN_DISTANCE) and np.all(alike) and at[0, -1] < at[1, 0]:
            pairs += list(zip(*at.tolist(), strict=True))
    ends = truth.stamps_ns[np.array(pairs, dtype=np.int64).reshape(-1, 2)]
    poses = generator.normal(0.0, (1.0, 0.5, 0.05), (len(pairs), 3))
    return ends, poses


def _loop_closures(
    generator: np.random.Generator, truth: Trajectory, distance: FloatArray,
) -> tuple[IntArray, FloatArray]:
    """Return stamps (L, 2) and measured poses (L, 3) of loop closures at revisited places."""
    # a place every half metre of the path, so that a car at rest is at one place only
    places = np.unique(np.searchsorted(distance, np.arange(0.0, distance[-1], 0.5)))
    poses, stamps = truth.poses[places], truth.stamps_ns[places]
    pairs = KDTree(poses[:, :2]).query_pairs(LOOP_RADIUS, output_type='ndarray')
    old, new = np.sort(pairs, axis=1).T
    good = (
        (stamps[new] - stamps[old] > LOOP_MIN_TIME_S * 1e9)
        & (distance[places[new]] - distance[places[old]] > LOOP_MIN_DISTANCE)
        & (np.abs(se2.wrap(poses[new, 2] - poses[old, 2])) < LOOP_ANGLE))
    old, new = old[good], new[good]
    # one random pair of each stretch of the path
    order = generator.permutation(len(new))
    _, first = np.unique(distance[places[new[order]]] // LOOP_SPACING, return_index=True)
    old, new = old[order[first]], new[order[first]]
    # stamps of a camera, which is not synchronised with the other sensors
    pairs_ns = np.column_stack((stamps[old], stamps[new]))
    pairs_ns += generator.integers(1, round(PERIOD_S * 1e9), pairs_ns.shape)
    pairs_ns = np.minimum(pairs_ns, truth.stamps_ns[-1])
    ends = truth.at(pairs_ns)
    noise = generator.normal(0.0, LOOP_SIGMAS, (len(new), 3))
    return pairs_ns, se2.compose(se2.between(ends[:, 0], ends[:, 1]), noise)
