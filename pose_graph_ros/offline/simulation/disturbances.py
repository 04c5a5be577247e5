# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What disturbs sensors: jumps, outages, delays, disorder and messages that come twice."""

from collections.abc import Iterable

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.offline.simulation.settings import (
    Jump,
    LATENCY_S,
    ODOMETRY,
    Outage,
    Setup,
    START_NS,
)

AGAIN_S = 1.0  # within which a message that comes twice comes again


def jumped(odometry: Trajectory, setup: Setup) -> Trajectory:
    """Return odometry with its jumps, in the order of their times."""
    poses = odometry.poses.copy()
    for jump in sorted(setup.jumps_of(ODOMETRY), key=lambda each: each.at_s):
        k = int(np.searchsorted(odometry.stamps_ns, START_NS + round(jump.at_s * 1e9)))
        if k == len(poses):
            continue
        # where it is, moved in the frame of the robot, or the origin
        there = np.zeros(3) if jump.step is None else se2.compose(poses[k], np.array(jump.step))
        poses[k:] = se2.compose(there, se2.between(poses[k], poses[k:]))
    return Trajectory(odometry.stamps_ns, poses)


def moved(
    generator: np.random.Generator, stamps_ns: IntArray, values: FloatArray, jumps: list[Jump],
) -> tuple[FloatArray, BoolArray]:
    """
    Return fixes or global poses with jumps, shape (M, 2 or 3), and which of them are moved, (M,).
    """
    time = (stamps_ns - START_NS) * 1e-9
    values, wrong = values.copy(), np.zeros(len(values), dtype=bool)
    for jump in jumps:
        assert jump.step is not None
        now = (time >= jump.at_s) & (time < jump.at_s + jump.seconds)
        values[now] += jump.step[:values.shape[1]]
        values[now, :2] += generator.normal(0.0, jump.sigma, (int(np.sum(now)), 2))
        wrong |= now
    return values, wrong


def heard(stamps_ns: IntArray, topic: str, outages: Iterable[Outage]) -> BoolArray:
    """Return which measurements of a topic are in no outage, shape (M,)."""
    time = (stamps_ns - START_NS) * 1e-9
    kept = np.ones(len(stamps_ns), dtype=bool)
    for outage in outages:
        if outage.topic == topic:
            kept &= (time < outage.begin_s) | (time >= outage.end_s)
    return kept


def arrivals(
    generator: np.random.Generator, topic: str, stamps_ns: IntArray, setup: Setup,
) -> tuple[IntArray, IntArray]:
    """
    Return which messages of a topic are recorded, and when [ns], shape (K,) each, by that time.
    """
    n = len(stamps_ns)
    late, again = generator.random(n), generator.random((2, n))
    seconds = np.full(n, LATENCY_S[topic])
    for delay in setup.delays:
        if delay.topic == topic:
            seconds = delay.seconds + delay.jitter_s * late
    recorded = stamps_ns + np.round(seconds * 1e9).astype(np.int64)
    index = np.arange(n)
    for twice in setup.duplicates:
        if twice.topic == topic:
            chosen = np.flatnonzero(again[0] < twice.share)
            index = np.append(index, chosen)
            recorded = np.append(recorded, recorded[chosen] + np.round(
                AGAIN_S * 1e9 * again[1, chosen]).astype(np.int64))
    order = np.argsort(recorded, kind='stable')
    return index[order], recorded[order]
