# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The motion of a vehicle along a path: sideways wandering, speed and stops.

The speed obeys limits of speed, lateral and longitudinal acceleration. Curvatures of paths begin
and end at zero, because `ramp`, by which headings turn, has a derivative that does.
"""

from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, Points
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.quantities import Metres
from pose_graph_ros.offline.simulation.settings import START_NS

PERIOD_S = 0.01  # sample period of the motion [s]
MARGIN_S = 5.0  # by which paths last longer than the motion, whose end is smoothed [s]


@dataclass(frozen=True, slots=True)
class Motion:
    """True poses of a vehicle in the frame of the world, and how far it has driven."""

    truth: Trajectory  # headings need not be wrapped
    distance: FloatArray  # driven up to each pose, shape (N,) [m]
    lap_time: float = np.inf  # when the second lap begins [s]; never if there are no laps


@dataclass(frozen=True, slots=True)
class Limits:
    """What the vehicle can do."""

    speed: float  # [m/s]
    acceleration: float  # along the path [m/s^2]
    lateral_acceleration: float  # and across it [m/s^2]


def follow(
    path: FloatArray, stops: IntArray, waits: FloatArray, limits: Limits, duration_s: float,
) -> tuple[Motion, FloatArray]:
    """
    Return the motion along a path every 10 ms, and when each point is reached, shape (P,) [s].

    Parameters
    ----------
    path : ndarray, shape (P, 3)
        Poses that are close to each other, with headings that are not wrapped [m, m, rad]; the
        vehicle starts at rest at the first one.
    stops : ndarray, shape (S,), indices of poses at which the vehicle stops
    waits : ndarray, shape (1 + S,), how long it stands at the first pose and at each stop [s]
    limits : Limits
    duration_s : float, length of the motion [s]; the path is `MARGIN_S` longer

    """
    length = path_length(path)
    curvature = np.gradient(path[:, 2], length)
    speed_limit = np.minimum(limits.speed, np.sqrt(
        limits.lateral_acceleration / np.maximum(np.abs(curvature), 1e-6)))
    speed_limit[[0, *stops]] = 0.0
    # v^2 changes by at most 2 a per metre: take the lower envelope of cones over the limits
    slope = 2.0 * limits.acceleration * length
    forward = slope + np.minimum.accumulate(speed_limit**2 - slope)
    backward = np.minimum.accumulate((speed_limit**2 + slope)[::-1])[::-1] - slope
    speed = np.sqrt(np.maximum(np.minimum(forward, backward), 0.0))

    wait = np.zeros(len(length))
    wait[[0, *stops]] = waits
    travel = 2.0 * np.diff(length) / (speed[1:] + speed[:-1])
    arrival = np.concatenate(([0.0], np.cumsum(travel + wait[:-1])))
    knots = np.column_stack((arrival, arrival + wait)).ravel()
    time = np.arange(0.0, duration_s + MARGIN_S, PERIOD_S)
    # smoothing over half a second removes jumps of the acceleration, but distorts the last samples
    distance = gaussian_filter1d(np.interp(time, knots, np.repeat(length, 2)), 0.25 / PERIOD_S)
    time, distance = time[time <= duration_s], distance[time <= duration_s]
    poses = np.column_stack([np.interp(distance, length, column) for column in path.T])
    stamps: IntArray = START_NS + np.round(time * 1e9).astype(np.int64)
    return Motion(Trajectory(stamps, poses), distance), arrival


def path_length(path: FloatArray) -> FloatArray:
    """Return the length of a path up to each of its points, shape (P,) [m]."""
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))))


def wandering(
    generator: np.random.Generator, points: Points, step: Metres, sigma: Metres,
) -> FloatArray:
    """Return poses along a line, which wander slowly to its sides, shape (P, 3), not wrapped."""
    direction = np.gradient(points, axis=0) / step
    normal = np.column_stack((-direction[:, 1], direction[:, 0]))
    aside = gaussian_filter1d(gauss_markov(generator, len(points), sigma, step / 60.0), 8.0 / step)
    path = points + aside[:, None] * normal
    direction = np.gradient(path, axis=0)
    return np.column_stack((path, np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))))


def ramp(u: FloatArray) -> FloatArray:
    """Return a ramp from 0 to 1 on [0, 1] whose derivative begins and ends at 0."""
    u = np.clip(u, 0.0, 1.0)
    return u - np.sin(2.0 * np.pi * u) / (2.0 * np.pi)


def gauss_markov(
    generator: np.random.Generator, count: int, sigma: float, step: float,
) -> FloatArray:
    """
    Return samples of a stationary first-order Gauss-Markov process, shape (count,).

    Parameters
    ----------
    generator : numpy.random.Generator
    count : int
    sigma, step : float
        Standard deviation of each sample, and sample period divided by the time constant.

    """
    decay = np.exp(-step)
    noise = generator.normal(0.0, sigma * np.sqrt(1.0 - decay**2), count)
    noise[:1] = generator.normal(0.0, sigma)
    return np.array(list(accumulate(noise.tolist(), lambda last, new: new + decay * last)))
