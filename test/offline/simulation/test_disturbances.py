# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Disturbances: outages are empty, jumps are as asked, delays keep the stamps."""

from dataclasses import replace

import numpy as np
import pytest

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.offline.simulation import sensors
from pose_graph_ros.offline.simulation.recording import course, record, Recording
from pose_graph_ros.offline.simulation.settings import (
    Delay,
    Fixes,
    GlobalPoses,
    Gyro,
    Jump,
    Outage,
    Setup,
    START_NS,
    TOPICS,
)
from pose_graph_ros.offline.simulation.worlds import WORLDS


def drive(**changes: object) -> Recording:
    """Return a drive in the hall, with all sensors."""
    return record(course(WORLDS['hall'], 4, 400.0, lambda usual: replace(
        usual, gyro=Gyro(), fixes=Fixes(), poses=GlobalPoses(), **changes)))


def stamps_of(recording: Recording) -> dict[str, np.ndarray]:
    return {topic: each.later_ns for topic, each in recording.measured.items()}


def test_outages_are_empty_and_nothing_else_is_missing() -> None:
    usual = stamps_of(drive())
    spans = [(topic, 90.0 + 10.0 * k, 330.0) for k, topic in enumerate(TOPICS)]
    other = drive(outages=tuple(Outage(*span) for span in spans))
    for (topic, begin, end), left_out in zip(spans, other.silenced, strict=True):
        time = (usual[topic] - START_NS) * 1e-9
        kept = (time < begin) | (time >= end)
        np.testing.assert_array_equal(stamps_of(other)[topic], usual[topic][kept])
        assert left_out == np.sum(~kept) > 0


def test_odometry_goes_on_from_where_it_jumped_to() -> None:
    usual, step = drive().odometry, (3.0, -1.0, 0.4)
    jumped = drive(jumps=(Jump('/odom', 200.0, step), Jump('/odom', 300.0, None))).odometry
    np.testing.assert_array_equal(usual.stamps_ns, jumped.stamps_ns)
    motions = se2.between(
        se2.between(usual.poses[:-1], usual.poses[1:]),
        se2.between(jumped.poses[:-1], jumped.poses[1:]))
    first, second = np.flatnonzero(np.abs(motions).max(axis=1) > 1e-9)
    assert usual.stamps_ns[first] < START_NS + 200 * 10**9 <= usual.stamps_ns[first + 1]
    assert usual.stamps_ns[second] < START_NS + 300 * 10**9 <= usual.stamps_ns[second + 1]
    np.testing.assert_allclose(motions[first], step, atol=1e-9)
    np.testing.assert_allclose(jumped.poses[second + 1], 0.0, atol=1e-12)


def test_delays_keep_stamps_and_shift_when_messages_are_recorded() -> None:
    stamps = np.arange(1000) * 50_000_000
    for delay, least, most in ((Delay('/odom', 2.0), 2.0, 2.0), (Delay('/odom', 0.5, 3.0), 0.5,
                                                                 3.5)):
        index, recorded = sensors.arrivals(
            np.random.default_rng(1), '/odom', stamps, Setup(delays=(delay,)))
        late = (recorded - stamps[index]) * 1e-9
        assert np.array_equal(np.sort(index), np.arange(1000))
        assert np.all(np.diff(recorded) >= 0)
        assert least - 1e-9 <= late.min() <= late.max() <= most + 1e-9
        assert np.ptp(late) == pytest.approx(most - least, rel=0.05, abs=1e-6)
        # more jitter than a period puts them out of order
        assert np.any(np.diff(index) < 0) == (most > least)
    usual, late = drive(), drive(delays=tuple(Delay(topic, 1.0, 2.0) for topic in TOPICS))
    for topic, found in stamps_of(late).items():
        np.testing.assert_array_equal(found, stamps_of(usual)[topic])
