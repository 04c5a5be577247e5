# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives with wheels whose heading drifts, a gyroscope with a bias, and an outage of the fixes."""

from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, GyroSource, MeasurementSource, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import Measurement, OdometrySample, Position, YawRate

SECOND = 1_000_000_000
EPOCH = 1_767_225_600_000_000_001
GYRO = GyroSource(sigma_rate=5e-4, sigma_bias=0.02, sigma_bias_walk=2e-5, sigma_turn=1e-3)
SPEED, WHEEL_DRIFT, SIGMA_FIX = 2.0, 2e-3, 0.5
"""Of the robot [m/s], of the heading by its wheels [rad/m], of the fixes [m]."""


@dataclass(frozen=True)
class Drive:
    """What the sensors say, by stamp, and where the robot was."""

    events: list[tuple[str, OdometrySample | Measurement]]
    times: FloatArray
    truth: FloatArray
    outage: tuple[float, float]

    def heading(self, stamp_ns: int) -> float:
        """Return the true heading at a stamp [rad]."""
        return float(np.interp((stamp_ns - EPOCH) * 1e-9, self.times, self.truth[:, 2]))


def simulate(
    seed: int, *, duration: float = 170.0, outage: tuple[float, float] = (100.0, 160.0),
    rest: tuple[float, float] = (0.0, 8.0), drift: float = WHEEL_DRIFT,
) -> Drive:
    """Simulate a drive with a rest at the beginning; the noise of the gyroscope is `GYRO`'s."""
    rng = np.random.default_rng(seed)
    step = 0.02
    times = np.arange(0.0, duration, step)
    moving = (times < rest[0]) | (times > rest[1])
    speed = SPEED * np.clip(np.minimum(np.abs(times - rest[0]), np.abs(times - rest[1])),
                            0.0, 1.0) * moving
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    rate = (0.15 * np.sin(0.17 * times + phase[0]) + 0.08 * np.sin(0.5 * times + phase[1])) * (
        speed / SPEED)
    truth = np.zeros((len(times), 3))
    wheels = np.zeros((len(times), 3))
    truth[0, 2] = rng.uniform(-3.0, 3.0)
    forward, turn = 0.5 * (speed[1:] + speed[:-1]) * step, 0.5 * (rate[1:] + rate[:-1]) * step
    distance = np.abs(forward)
    noise = rng.standard_normal((len(forward), 3)) * np.sqrt(distance)[:, None] * (
        0.01, 0.005, 0.003)
    off = drift * rng.choice((-1.0, 1.0)) * distance + noise[:, 2]
    wheel_steps = np.column_stack((forward + noise[:, 0], noise[:, 1], turn + off))
    for k, (along, by) in enumerate(zip(forward, turn, strict=True)):
        middle = truth[k, 2] + 0.5 * by
        truth[k + 1] = truth[k] + (along * np.cos(middle), along * np.sin(middle), by)
        wheels[k + 1] = se2.compose(wheels[k], wheel_steps[k])
    stamps = EPOCH + np.round(times * 1e9).astype(np.int64)
    bias = rng.normal(0.0, 0.01) + np.cumsum(
        rng.normal(0.0, GYRO.sigma_bias_walk * np.sqrt(step), len(times)))
    rates = rate + bias + rng.normal(0.0, GYRO.sigma_rate / np.sqrt(step), len(times))
    events: list[tuple[str, OdometrySample | Measurement]] = [
        ('odom', OdometrySample(int(stamp), pose))
        for stamp, pose in zip(stamps[::5], wheels[::5], strict=True)]
    events += [('gyro', YawRate(int(stamp), float(value)))
               for stamp, value in zip(stamps, rates, strict=True)]
    for at in range(25, len(times), 50):
        if not outage[0] <= times[at] <= outage[1]:
            place = truth[at, :2] + rng.normal(0.0, SIGMA_FIX, 2)
            events.append(('fix', Position(
                int(stamps[at]), place, SIGMA_FIX**2 * np.eye(2), np.zeros(2))))
    events.sort(key=lambda event: event[1].stamp_ns)
    return Drive(events, times, truth, outage)


def settings(gyro: GyroSource = GYRO, odometry: OdometrySource | None = None) -> BackendConfig:
    """Return settings for these drives; the fixes have white errors, and are known to."""
    return BackendConfig(
        odometry={'odom': odometry or OdometrySource()},
        measurements={'fix': MeasurementSource()}, gyros={'gyro': gyro})


def run(drive: Drive, *, gyro: bool, config: BackendConfig | None = None) -> tuple[
        PoseGraphBackend, FloatArray]:
    """
    Return the engine, and error and sigma of the newest node's heading in the outage [rad].

    They are those after each update, one a second, shape (U, 2).
    """
    backend = PoseGraphBackend(config or settings())
    errors, due = [], 0
    begin, end = (EPOCH + round(time * 1e9) for time in drive.outage)
    for source, event in drive.events:
        if isinstance(event, OdometrySample):
            backend.add_odometry(event, source)
            if event.stamp_ns < due:
                continue
            due = event.stamp_ns + SECOND
            backend.update()
            if len(backend.node_stamps_ns) == 0:
                continue
            newest_ns, node = int(backend.node_stamps_ns[-1]), backend.graph.newest_pose
            if begin <= newest_ns <= end:
                heading = backend.graph.poses_of(np.array([node]))[0, 2]
                covariance = backend._smoother.newest_covariance()
                errors.append((float(se2.wrap(heading - drive.heading(newest_ns))),
                               float(np.sqrt(covariance[2, 2]))))
        elif gyro or not isinstance(event, YawRate):
            backend.add_measurement(event, source)
    return backend, np.array(errors)
