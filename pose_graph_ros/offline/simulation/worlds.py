# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Worlds: where a vehicle moves, how, and what sensors it usually has there.

- `drive`: a car laps some city blocks twice, with fixes that fail at the beginning of the second
  lap and are reflected for a while, loop closures, and false ones. It keeps to the right lane of
  the streets, which are slightly curved, and stops at traffic lights.
- `hall`: a robot drives through the aisles of a hall in any order, for as long as asked, and
  stops where it picks something up; parallel aisles look alike.
- `grid`: a walk at random through the streets of a small Manhattan, as in the data set M3500 of
  E. Olson; it crosses its path all the time.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.offline.simulation.motion import (
    aisle_corners,
    follow,
    Limits,
    MARGIN_S,
    Motion,
    ramp,
    rounded,
    street_corners,
    wandering,
)
from pose_graph_ros.offline.simulation.settings import (
    Closures,
    FalseClosures,
    FIXES,
    Fixes,
    Jump,
    Outage,
    Setup,
    Wheels,
)

PATH_STEP = 0.05  # distance of the points of paths [m]
AISLES, AISLE_SPACING, AISLE_DEPTH = 8, 4.0, 30.0  # of the hall; distances [m]
PICKS, PICK_S = 0.7, (4.0, 12.0)  # share of the lines with a stop, and how long it takes [s]
FORKLIFT, ROBOT_TURN = Limits(1.4, 0.7, 0.8), 2.4  # what moves in the hall; length of turns [m]
BLOCKS, BLOCK = 10, 10.0  # of the grid, along each axis, and their size [m]
CART, CART_TURN = Limits(2.0, 0.8, 1.0), 4.0  # what moves in the grid
ASIDE = 0.1  # standard deviation of the distance from the middle of a lane [m]
REST_S = 3.0  # before the start [s]

# Intersections at which the circuit turns by 90 degrees, in driving order [m].
CORNERS = ((310, 0), (310, 180), (105, 180), (105, 0), (200, 0), (200, 260), (0, 260), (0, 0))
STOP_CORNERS = (1, 4, 6)  # indices of the corners with a traffic light before them
LANE_OFFSET = 1.8  # offset of the lane to the right of the middle of the street [m]
LANE_SIGMA = 0.35  # standard deviation of the position within the lane [m]
STREET_BEARING = 0.35  # angle of the first street, from east to north [rad]
TURN_LENGTH = 18.0  # arc length of a turn [m]; its smallest radius is this divided by pi
CIRCUIT_STEP = 0.1  # distance of the points of its path [m]
CAR = Limits(speed=7.2, acceleration=1.4, lateral_acceleration=2.0)

# Of the drive: the outage of fixes, from the second lap on [s], and reflected signals (multipath).
OUTAGE_S = (-40.0, 30.0)
REFLECTED = Jump(FIXES, 150.0, (14.0, -9.0, 0.0), 25.0, 1.5)


@dataclass(frozen=True, slots=True)
class World:
    """A place, and what moves there."""

    drive: Callable[[np.random.Generator, float], Motion]
    """Return the motion of some length [s]."""
    setup: Callable[[Motion], Setup]
    """Return the usual sensors and disturbances."""
    one_stream: bool = False
    """Whether its usual sensors draw from one stream of random numbers, one after the other."""


def drive_circuit(generator: np.random.Generator, duration_s: float) -> Motion:
    """Return a drive along the circuit, at random within the lane, with random waits at lights."""
    heading, stops, lap_length = _circuit(duration_s)
    path = wandering(generator, _streets(heading), CIRCUIT_STEP, LANE_SIGMA)
    waits = np.append(3.0, generator.uniform(8.0, 20.0, len(stops)))
    motion, arrival = follow(path, stops, waits, CAR, duration_s)
    lap = round(lap_length / CIRCUIT_STEP)
    return replace(motion, lap_time=float(arrival[lap]) if lap < len(arrival) else np.inf)


def _circuit(duration_s: float) -> tuple[FloatArray, IntArray, float]:
    """Return headings every `CIRCUIT_STEP` [rad], indices of the stops and length of a lap [m]."""
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
    along = np.arange(0.0, laps * lap_length, CIRCUIT_STEP)
    heading = np.zeros(len(along))
    for begin, angle in zip(begins, np.tile(turns, laps), strict=True):
        # before a turn it adds nothing, and behind it the whole angle
        first, last = np.searchsorted(along, (begin, begin + TURN_LENGTH + CIRCUIT_STEP))
        heading[first:last] += angle * ramp((along[first:last] - begin) / TURN_LENGTH)
        heading[last:] += angle
    stops = begins.reshape(laps, -1)[:, STOP_CORNERS].ravel() - 4.0
    return heading, np.round(stops / CIRCUIT_STEP).astype(np.int64), lap_length


def _streets(heading: FloatArray) -> FloatArray:
    """Return the path along bent streets, shape (N, 2), with headings on straight ones."""
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = CIRCUIT_STEP * np.column_stack((np.cos(middle), np.sin(middle)))
    grid = np.concatenate(([[0.0, 0.0]], np.cumsum(steps, axis=0)))
    bent = grid + np.column_stack((
        7.0 * np.sin(2.0 * np.pi * grid[:, 1] / 310.0),
        9.0 * np.sin(2.0 * np.pi * grid[:, 0] / 360.0 + 0.6)))
    return np.asarray(bent @ se2.rotation(STREET_BEARING).T)


def _drive_setup(motion: Motion) -> Setup:
    outage = (motion.lap_time + OUTAGE_S[0], motion.lap_time + OUTAGE_S[1])
    return Setup(
        wheels=Wheels(start=(3.2, -1.4, -2.0)), fixes=Fixes(),
        closures=Closures(false=FalseClosures(groups=1, size=4, singles=4, loose=True)),
        outages=(Outage(FIXES, *outage),) if np.isfinite(motion.lap_time) else (),
        jumps=(REFLECTED,))


def _hall(generator: np.random.Generator, duration_s: float) -> Motion:
    length = (duration_s + MARGIN_S) * FORKLIFT.speed
    corners = aisle_corners(generator, length + 2.0 * AISLE_DEPTH, AISLES, AISLE_SPACING,
                            AISLE_DEPTH)
    points, middles = rounded(corners, ROBOT_TURN, PATH_STEP)
    path = wandering(generator, points, PATH_STEP, ASIDE)
    picks = middles[1:-1][generator.random(len(middles) - 2) < PICKS]
    stops = np.unique(np.round(picks / PATH_STEP).astype(np.int64))
    waits = np.append(REST_S, generator.uniform(*PICK_S, len(stops)))
    return follow(path, stops, waits, FORKLIFT, duration_s)[0]


def _hall_setup(_motion: Motion) -> Setup:
    return Setup(
        wheels=Wheels(track_width=0.6, slip_events_per_s=1.0 / 120.0),
        closures=Closures(
            sigmas=(0.05, 0.05, 0.01), spacing=5.0, radius=1.0, min_distance=20.0,
            place_distance=1.0, first_s=REST_S,
            false=FalseClosures(min_distance=3.0, spacing=1.0, from_s=60.0)))


def _grid(generator: np.random.Generator, duration_s: float) -> Motion:
    length = (duration_s + MARGIN_S) * CART.speed
    corners = street_corners(
        generator, length + 2.0 * BLOCK * BLOCKS, np.full(BLOCKS, BLOCK), fresh=1.0)
    points, _ = rounded(corners, CART_TURN, PATH_STEP)
    path = wandering(generator, points, PATH_STEP, ASIDE)
    path[:, :2] = path[:, :2] @ se2.rotation(STREET_BEARING).T
    path[:, 2] += STREET_BEARING
    stops = np.empty(0, dtype=np.int64)
    return follow(path, stops, np.array([REST_S]), CART, duration_s)[0]


def _grid_setup(_motion: Motion) -> Setup:
    return Setup(
        wheels=Wheels(track_width=0.8),
        closures=Closures(
            rate=0.5, sigmas=(0.1, 0.1, 0.02), spacing=1.0, radius=1.5, min_distance=10.0,
            first_s=REST_S,
            false=FalseClosures(min_distance=8.0, spacing=1.0, from_s=60.0)))


WORLDS = {
    'drive': World(drive_circuit, _drive_setup, one_stream=True),
    'hall': World(_hall, _hall_setup),
    'grid': World(_grid, _grid_setup),
}
