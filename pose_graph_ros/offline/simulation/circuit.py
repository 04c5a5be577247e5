# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The motion of a car that drives laps around some city blocks.

The car keeps to the right lane of the streets, which are slightly curved, and stops at traffic
lights.
"""

from dataclasses import replace

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.offline.simulation.motion import (
    follow,
    Limits,
    MARGIN_S,
    Motion,
    ramp,
    wandering,
)

# Intersections at which the circuit turns by 90 degrees, in driving order [m].
CORNERS = ((310, 0), (310, 180), (105, 180), (105, 0), (200, 0), (200, 260), (0, 260), (0, 0))
STOP_CORNERS = (1, 4, 6)  # indices of the corners with a traffic light before them
LANE_OFFSET = 1.8  # offset of the lane to the right of the middle of the street [m]
LANE_SIGMA = 0.35  # standard deviation of the position within the lane [m]
STREET_BEARING = 0.35  # angle of the first street, from east to north [rad]
TURN_LENGTH = 18.0  # arc length of a turn [m]; its smallest radius is this divided by pi
PATH_STEP = 0.1  # distance of the points of the path [m]
CAR = Limits(speed=7.2, acceleration=1.4, lateral_acceleration=2.0)


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
    path = wandering(generator, _streets(heading), PATH_STEP, LANE_SIGMA)
    waits = np.append(3.0, generator.uniform(8.0, 20.0, len(stops)))
    motion, arrival = follow(path, stops, waits, CAR, duration_s)
    lap = round(lap_length / PATH_STEP)
    return replace(motion, lap_time=float(arrival[lap]) if lap < len(arrival) else np.inf)


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
    reach = TURN_LENGTH * np.mean(np.cos(0.5 * np.pi * ramp(turn)))
    straights = np.linalg.norm(lane - np.roll(lane, 1, axis=0), axis=1) - 2.0 * reach
    begins = np.cumsum(straights + TURN_LENGTH) - TURN_LENGTH
    lap_length = float(begins[-1] + TURN_LENGTH)

    laps = 1 + int((duration_s + MARGIN_S) * CAR.speed / lap_length)
    begins = np.concatenate([begins + k * lap_length for k in range(laps)])
    along = np.arange(0.0, laps * lap_length, PATH_STEP)
    heading = np.zeros(len(along))
    for begin, angle in zip(begins, np.tile(turns, laps), strict=True):
        # before a turn it adds nothing, and behind it the whole angle
        first, last = np.searchsorted(along, (begin, begin + TURN_LENGTH + PATH_STEP))
        heading[first:last] += angle * ramp((along[first:last] - begin) / TURN_LENGTH)
        heading[last:] += angle
    stops = begins.reshape(laps, -1)[:, STOP_CORNERS].ravel() - 4.0
    return heading, np.round(stops / PATH_STEP).astype(np.int64), lap_length


def _streets(heading: FloatArray) -> FloatArray:
    """Return the path along bent streets, shape (N, 2), with headings on straight ones."""
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = PATH_STEP * np.column_stack((np.cos(middle), np.sin(middle)))
    grid = np.concatenate(([[0.0, 0.0]], np.cumsum(steps, axis=0)))
    bent = grid + np.column_stack((
        7.0 * np.sin(2.0 * np.pi * grid[:, 1] / 310.0),
        9.0 * np.sin(2.0 * np.pi * grid[:, 0] / 360.0 + 0.6)))
    return np.asarray(bent @ se2.rotation(STREET_BEARING).T)
