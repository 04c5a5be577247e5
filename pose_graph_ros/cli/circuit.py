# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Simulate the motion of a car that drives laps around some city blocks.

The car keeps to the right lane of the streets, which are slightly curved. The curvature of a turn
begins and ends at zero. The speed obeys limits of speed, lateral and longitudinal acceleration,
and is zero at traffic lights.
"""

from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray

# Intersections at which the circuit turns by 90 degrees, in driving order [m].
CORNERS = ((310, 0), (310, 180), (105, 180), (105, 0), (200, 0), (200, 260), (0, 260), (0, 0))
STOP_CORNERS = (1, 4, 6)  # indices of the corners with a traffic light before them
LANE_OFFSET = 1.8  # offset of the lane to the right of the middle of the street [m]
STREET_BEARING = 0.35  # angle of the first street, from east to north [rad]
TURN_LENGTH = 18.0  # arc length of a turn [m]; its smallest radius is this divided by pi
PATH_STEP = 0.1  # distance of the points of the path [m]
MAX_SPEED = 7.2  # largest speed [m/s]
MAX_ACCELERATION = 1.4  # largest acceleration along the path [m/s^2]
MAX_LATERAL_ACCELERATION = 2.0  # and across it [m/s^2]
PERIOD_S = 0.01  # sample period of the motion [s]


@dataclass(frozen=True, slots=True)
class Motion:
    """Poses of the car, every 10 ms."""

    time: FloatArray  # time since the start, shape (N,) [s]
    distance: FloatArray  # distance driven since the start, shape (N,) [m]
    poses: FloatArray  # in the frame of the city, shape (N, 3) [m, m, rad]; not wrapped
    lap_time: float  # when the second lap begins [s]; after the end, or infinite, if there is none


def drive_circuit(generator: np.random.Generator, duration_s: float) -> Motion:
    """
    Return a drive along the circuit.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of the random position within the lane and of the random waits at lights.
    duration_s : float, length of the drive [s]

    """
    heading, stops, lap_length = _circuit(duration_s)
    path = _streets(generator, heading)
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))))
    curvature = np.gradient(path[:, 2], length)

    speed_limit = np.minimum(
        MAX_SPEED, np.sqrt(MAX_LATERAL_ACCELERATION / np.maximum(np.abs(curvature), 1e-6)))
    speed_limit[[0, *stops]] = 0.0
    # v^2 changes by at most 2 a per metre: take the lower envelope of cones over the limits
    slope = 2.0 * MAX_ACCELERATION * length
    forward = slope + np.minimum.accumulate(speed_limit**2 - slope)
    backward = np.minimum.accumulate((speed_limit**2 + slope)[::-1])[::-1] - slope
    speed = np.sqrt(np.maximum(np.minimum(forward, backward), 0.0))

    wait = np.zeros(len(length))
    wait[0] = 3.0
    wait[stops] = generator.uniform(8.0, 20.0, len(stops))
    travel = 2.0 * np.diff(length) / (speed[1:] + speed[:-1])
    arrival = np.concatenate(([0.0], np.cumsum(travel + wait[:-1])))
    knots = np.column_stack((arrival, arrival + wait)).ravel()
    time = np.arange(0.0, duration_s + 5.0, PERIOD_S)
    # smoothing over half a second removes jumps of the acceleration, but distorts the last samples
    distance = gaussian_filter1d(np.interp(time, knots, np.repeat(length, 2)), 0.25 / PERIOD_S)
    time, distance = time[time <= duration_s], distance[time <= duration_s]
    poses = np.column_stack([np.interp(distance, length, column) for column in path.T])
    lap = round(lap_length / PATH_STEP)
    lap_time = float(arrival[lap]) if lap < len(arrival) else np.inf
    return Motion(time, distance, poses, lap_time)


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
    noise[0] = generator.normal(0.0, sigma)
    return np.array(list(accumulate(noise.tolist(), lambda last, new: new + decay * last)))


def _circuit(duration_s: float) -> tuple[FloatArray, IntArray, float]:
    """Return headings every `PATH_STEP` [rad], indices of the stops and length of a lap [m]."""
    corners = np.array(CORNERS, dtype=np.float64)
    incoming = corners - np.roll(corners, 1, axis=0)
    incoming /= np.linalg.norm(incoming, axis=1, keepdims=True)
    outgoing = np.roll(incoming, -1, axis=0)
    right = np.array([[0.0, -1.0], [1.0, 0.0]])
    lane = corners + LANE_OFFSET * (incoming + outgoing) @ right
    turns = np.arctan2(
        incoming[:, 0] * outgoing[:, 1] - incoming[:, 1] * outgoing[:, 0],
        np.sum(incoming * outgoing, axis=1))

    # distance from the corner to the ends of a turn: the integral of the cosine of its heading
    turn = (np.arange(1000) + 0.5) / 1000
    reach = TURN_LENGTH * np.mean(np.cos(0.5 * np.pi * _ramp(turn)))
    straights = np.linalg.norm(lane - np.roll(lane, 1, axis=0), axis=1) - 2.0 * reach
    begins = np.cumsum(straights + TURN_LENGTH) - TURN_LENGTH
    lap_length = float(begins[-1] + TURN_LENGTH)

    laps = 1 + int((duration_s + 5.0) * MAX_SPEED / lap_length)
    begins = np.concatenate([begins + k * lap_length for k in range(laps)])
    along = np.arange(0.0, laps * lap_length, PATH_STEP)
    heading = np.zeros(len(along))
    for begin, angle in zip(begins, np.tile(turns, laps), strict=True):
        heading += angle * _ramp((along - begin) / TURN_LENGTH)
    stops = begins.reshape(laps, -1)[:, STOP_CORNERS].ravel() - 4.0
    return heading, np.round(stops / PATH_STEP).astype(np.int64), lap_length


def _ramp(u: FloatArray) -> FloatArray:
    """Return a ramp from 0 to 1 on [0, 1] whose derivative begins and ends at 0."""
    u = np.clip(u, 0.0, 1.0)
    return u - np.sin(2.0 * np.pi * u) / (2.0 * np.pi)


def _streets(generator: np.random.Generator, heading: FloatArray) -> FloatArray:
    """Return the path along bent streets with a random position in the lane, shape (N, 3)."""
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = PATH_STEP * np.column_stack((np.cos(middle), np.sin(middle)))
    grid = np.concatenate(([[0.0, 0.0]], np.cumsum(steps, axis=0)))
    bent = grid + np.column_stack((
        7.0 * np.sin(2.0 * np.pi * grid[:, 1] / 310.0),
        9.0 * np.sin(2.0 * np.pi * grid[:, 0] / 360.0 + 0.6)))
    city = bent @ se2.rotation(STREET_BEARING).T

    direction = np.gradient(city, axis=0) / PATH_STEP
    normal = np.column_stack((-direction[:, 1], direction[:, 0]))
    wander = gaussian_filter1d(
        gauss_markov(generator, len(city), 0.35, PATH_STEP / 60.0), 8.0 / PATH_STEP)
    path = city + wander[:, None] * normal
    direction = np.gradient(path, axis=0)
    return np.column_stack((path, np.unwrap(np.arctan2(direction[:, 1], direction[:, 0]))))
