# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated drives whose noise is exactly what the engine is told, and how they are fed to it."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, GyroSource, MeasurementSource, OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.measurements import Measurement, OdometrySample, Position, YawRate

SECOND = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Kind:
    """What is simulated."""

    name: str
    speed: float = 1.0
    """[m/s]"""
    duration: float = 120.0
    """[s]"""
    odometry_rate: float = 10.0
    """[Hz]"""
    period: float = 1.0
    """Of the fixes [s]."""
    sigma: float = 1.0
    """Of a coordinate of a fix [m]."""
    tau: float = 0.0
    """Time constant of the errors of the fixes [s]; 0: white."""
    white_share: float = 0.0
    """Of the variance of the fixes, if they are correlated."""
    outliers: float = 0.0
    """Share of the fixes that are tens of metres off."""
    rest: float = 0.0
    """At the beginning [s]."""
    drift: float = 0.0
    """Of the heading by odometry, which is not told [rad/m]."""


@dataclass(frozen=True, slots=True)
class Drive:
    """A simulated drive."""

    stamps_ns: IntArray
    truth: FloatArray
    """`T_map_base`, shape (N, 3)."""
    odometry: FloatArray
    """`T_odom_base`, shape (N, 3)."""
    fix_stamps_ns: IntArray
    fixes: FloatArray
    """Shape (M, 2) [m]."""
    sigma: float
    rates: FloatArray | None = None
    """Of a gyroscope in the middle between two stamps, shape (N - 1,) [rad/s]."""

    def events(self) -> list[OdometrySample | Measurement]:
        """Return all that the sensors say, by stamp."""
        samples: list[OdometrySample | Measurement] = [
            OdometrySample(int(stamp), pose)
            for stamp, pose in zip(self.stamps_ns, self.odometry, strict=True)]
        samples += [
            Position(int(stamp), position, self.sigma**2 * np.eye(2), np.zeros(2))
            for stamp, position in zip(self.fix_stamps_ns, self.fixes, strict=True)]
        if self.rates is not None:
            middles = self.stamps_ns[:-1] + np.diff(self.stamps_ns) // 2
            samples += [YawRate(int(stamp), float(rate))
                        for stamp, rate in zip(middles, self.rates, strict=True)]
        return sorted(samples, key=lambda sample: sample.stamp_ns)


def simulate(kind: Kind, seed: int, noise: OdometryNoise) -> Drive:
    """Simulate a winding drive from an unknown heading, with odometry noise as in `core`."""
    rng = np.random.default_rng(seed)
    step = 1.0 / kind.odometry_rate
    time = np.arange(0.0, kind.duration, step)
    rate = 0.1 * np.sin(2.0 * np.pi * time / 37.0) + 0.05 * np.sin(2.0 * np.pi * time / 11.0)
    moving = np.clip(time - kind.rest, 0.0, 1.0) if kind.rest > 0.0 else np.ones(len(time))
    distance, turns = kind.speed * step * moving, rate * step * moving
    heading_variance = (noise.sigma_heading_distance**2 * distance
                        + noise.sigma_heading_turn**2 * np.abs(turns))
    errors = rng.standard_normal((len(time), 3)) * np.column_stack((
        noise.sigma_distance * np.sqrt(distance), noise.sigma_lateral * np.sqrt(distance),
        np.sqrt(heading_variance)))
    errors[:, 2] += kind.drift * distance
    truth = np.zeros((len(time), 3))
    odometry = np.zeros((len(time), 3))
    odometry[0] = (5.0, -3.0, rng.uniform(-np.pi, np.pi))
    for k in range(1, len(time)):
        increment = np.array((distance[k], 0.0, turns[k]))
        truth[k] = se2.compose(truth[k - 1], increment)
        odometry[k] = se2.compose(odometry[k - 1], se2.compose(increment, errors[k]))
    seen = np.arange(3, len(time), max(round(kind.period / step), 1))
    shape = (len(seen), 2)
    off = rng.standard_normal(shape)
    if kind.tau > 0.0:
        phi = np.exp(-kind.period / kind.tau)
        drive = np.sqrt(1.0 - phi**2) * rng.standard_normal(shape)
        drive[0] = rng.standard_normal(2)
        slow = lfilter([1.0], [1.0, -phi], drive, axis=0)
        off = np.sqrt(1.0 - kind.white_share) * slow + np.sqrt(kind.white_share) * off
    wrong = rng.random(len(seen)) < kind.outliers
    off = kind.sigma * off + np.where(wrong[:, None], rng.uniform(-50.0, 50.0, shape), 0.0)
    stamps = SECOND + np.round(time * SECOND).astype(np.int64)
    return Drive(stamps, truth, odometry, stamps[seen], truth[seen, :2] + off, kind.sigma)


def feed(
    backend: PoseGraphBackend, events: list[OdometrySample | Measurement], update_every: float,
) -> Iterator[int]:
    """Feed events in the order given; update so often in stamps of the odometry [s], and yield."""
    due = 0
    for event in events:
        if isinstance(event, OdometrySample):
            backend.add_odometry(event)
            if event.stamp_ns >= due:
                backend.update()
                due = event.stamp_ns + round(update_every * SECOND)
                yield event.stamp_ns
        else:
            backend.add_measurement(event, 'gyro' if isinstance(event, YawRate) else 'fix')


def with_gyro(drive: Drive, noise: GyroSource, seed: int) -> Drive:
    """Return a drive with a gyroscope as well, whose errors are those of its settings."""
    rng = np.random.default_rng((seed, 1))
    steps = np.diff(drive.stamps_ns) * 1e-9
    turns = se2.wrap(np.diff(drive.truth[:, 2]))
    walk = rng.normal(0.0, noise.sigma_bias) + np.cumsum(
        noise.sigma_bias_walk * np.sqrt(steps) * rng.standard_normal(len(steps)))
    white = np.sqrt(noise.sigma_rate**2 * steps + noise.sigma_turn**2 * np.abs(turns))
    return replace(drive, rates=walk + (turns + white * rng.standard_normal(len(steps))) / steps)


def new_backend(source: MeasurementSource) -> PoseGraphBackend:
    """Return an engine that takes the fixes as a source with these settings."""
    return PoseGraphBackend(BackendConfig(measurements={'fix': source}))
