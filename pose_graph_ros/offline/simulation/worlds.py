# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Worlds: where a vehicle moves, how, and what sensors it usually has there.

A vehicle follows ways through streets and aisles with limits of speed, lateral and longitudinal
acceleration; it wanders and stops. Curvatures of paths begin and end at zero, because `ramp`, by
which headings turn, has a derivative that does.

- `drive`: a car laps some city blocks twice, with fixes that fail at the beginning of the second
  lap and are reflected for a while, loop closures, and false ones. It keeps to the right lane of
  the streets, which are slightly curved, and stops at traffic lights.
- `hall`: a robot drives through the aisles of a hall in any order, for as long as asked, and
  stops where it picks something up; parallel aisles look alike.
- `grid`: a walk at random through the streets of a small Manhattan, as in the data set M3500 of
  E. Olson; it crosses its path all the time.
"""

from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from scipy.ndimage import gaussian_filter1d

from pose_graph_ros.core.geometry import se2, trajectory
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray, Points
from pose_graph_ros.core.quantities import Metres
from pose_graph_ros.offline.simulation import settings
from pose_graph_ros.offline.simulation.settings import Closures, FalseClosures, FIXES, Setup

PERIOD_S = 0.01  # sample period of the motion [s]
MARGIN_S = 5.0  # by which paths last longer than the motion, whose end is smoothed [s]
# Four directions of a crossing's streets, counter-clockwise.
DIRECTIONS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
TURN_POINTS = 1000  # at which a turn is tabulated


class Motion(NamedTuple):
    """True poses of a vehicle in the frame of the world, and how far it has driven."""

    truth: trajectory.Trajectory  # headings need not be wrapped
    distance: FloatArray  # driven up to each pose, shape (N,) [m]
    lap_time: float = np.inf  # when the second lap begins [s]; never if there are no laps


class Limits(NamedTuple):
    """What the vehicle can do."""

    speed: float  # [m/s]
    acceleration: float  # along the path [m/s^2]
    lateral_acceleration: float  # and across it [m/s^2]


def follow(path: FloatArray, stops: IntArray, waits: FloatArray, limits: Limits,
           duration_s: float) -> tuple[Motion, FloatArray]:
    """
    Return the motion along a path every 10 ms, and when each point is reached, shape (P,) [s].

    The path, shape (P, 3), has poses that are close to each other, with headings that are not
    wrapped; it is `MARGIN_S` longer than the motion. The vehicle waits at the first pose, where it
    starts at rest, and at the stops, which are indices of poses.
    """
    length = path_length(path)
    speed_limit = np.minimum(limits.speed, np.sqrt(
        limits.lateral_acceleration / np.maximum(np.abs(np.gradient(path[:, 2], length)), 1e-6)))
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
    stamps: IntArray = settings.START_NS + np.round(time * 1e9).astype(np.int64)
    return Motion(trajectory.Trajectory(stamps, poses), distance), arrival


def path_length(path: FloatArray) -> FloatArray:
    """Return the length of a path up to each of its points, shape (P,) [m]."""
    return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))))


def wandering(generator: Generator, points: Points, step: Metres, sigma: Metres) -> FloatArray:
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


def gauss_markov(generator: Generator, count: int, sigma: float, step: float) -> FloatArray:
    """
    Return samples of a stationary first-order Gauss-Markov process, shape (count,).

    Sigma is that of each sample, the step a part of the time constant.
    """
    decay = np.exp(-step)
    noise = generator.normal(0.0, sigma * np.sqrt(1.0 - decay**2), count)
    noise[:1] = generator.normal(0.0, sigma)
    return np.array(list(accumulate(noise.tolist(), lambda last, new: new + decay * last)))


def street_corners(rng: Generator, length: float, spacing: FloatArray, *,
                   fresh: float) -> FloatArray:
    """
    Return the crossings of a random drive through a grid of streets, shape (K, 2) [m].

    It begins in the middle, eastwards. It goes straight on with a probability of 3/5 where it can,
    turns otherwise, and practically never goes back at once. Distances of the streets are those of
    both axes, of the second in reverse; a `fresh` street is so much likelier than one driven
    before.
    """
    streets = np.concatenate(([0.0], np.cumsum(spacing)))
    avenues = np.concatenate(([0.0], np.cumsum(spacing[::-1])))
    cell, facing = np.array([len(streets) // 2, len(avenues) // 2]), 0
    corners, visited = [cell], set[tuple[int, int, int]]()
    driven = 0.0
    while driven <= length:
        weights = np.zeros(4)
        for turn, likely in ((0, 3.0), (1, 1.0), (3, 1.0), (2, 1e-9)):
            way = (facing + turn) % 4
            end = cell + DIRECTIONS[way]
            if np.all(end >= 0) and end[0] < len(streets) and end[1] < len(avenues):
                # the sum names the street between two crossings, in either direction
                seen = (*(cell + end).tolist(), way % 2) in visited
                weights[way] = likely * (1.0 if seen else fresh)
        facing = int(rng.choice(4, p=weights / weights.sum()))
        end = cell + DIRECTIONS[facing]
        visited.add((*(cell + end).tolist(), facing % 2))
        driven += abs(streets[end[0]] - streets[cell[0]]) + abs(avenues[end[1]] - avenues[cell[1]])
        cell = end
        corners.append(cell)
    nodes = np.array(corners)
    return np.column_stack((streets[nodes[:, 0]], avenues[nodes[:, 1]]))


def rounded(corners: FloatArray, turn: float, step: float) -> tuple[FloatArray, FloatArray]:
    """
    Return points along straight lines with right-angled turns, and where the corners are on it.

    Given are the ends of the lines, which run along the axes and are longer than a turn; the way
    begins and ends in the middle of the first and the last one. `turn` is the arc length of a turn
    and `step` the distance of the points [m]. The middle of each line is given by its distance
    along the path, shape (L,) [m].
    """
    ways = np.diff(corners, axis=0)
    turns = np.any(np.sign(ways[1:]) != np.sign(ways[:-1]), axis=1)
    corners = corners[np.concatenate(([True], turns, [True]))]    # where lines go on straight
    ways = np.diff(corners, axis=0)
    lengths = np.hypot(*ways.T)
    ways /= lengths[:, None]

    # a turn to the left, from the origin eastwards; it ends at (reach, reach)
    u = (np.arange(TURN_POINTS) + 0.5) / TURN_POINTS
    heading = 0.5 * np.pi * ramp(u)
    along = turn * np.concatenate(([0.0], u + 0.5 / TURN_POINTS))
    ahead, left = (turn / TURN_POINTS * np.concatenate(([0.0], np.cumsum(each)))
                   for each in (np.cos(heading), np.sin(heading)))
    reach = float(ahead[-1])
    assert np.all(lengths > 2.0 * reach)

    # pieces: half of a line, a turn, the straight part of the next line, a turn, and so on
    half = 0.5 * lengths
    begins = np.cumsum(np.concatenate(([0.0], half[:-1] + half[1:] - 2.0 * reach + turn)))
    s = np.arange(0.0, begins[-1], step)
    line = np.searchsorted(begins, s, side='right') - 1
    # from the middle of line k to that of line k + 1
    rest = s - begins[line]
    start, after = half[line] - reach, np.minimum(line + 1, len(ways) - 1)
    bend, straight = np.clip(rest - start, 0.0, turn), np.minimum(rest, start)
    beyond = np.maximum(rest - start - turn, 0.0)
    forward = (straight + np.interp(bend, along, ahead))[:, None]
    sideways = (np.interp(bend, along, left) + beyond)[:, None]
    middle = 0.5 * (corners[:-1] + corners[1:])
    return middle[line] + forward * ways[line] + sideways * ways[after], begins


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
REFLECTED = settings.Jump(FIXES, 150.0, (14.0, -9.0, 0.0), 25.0, 1.5)


class World(NamedTuple):
    """A place, and what moves there."""

    drive: Callable[[Generator, float], Motion]
    """Return the motion of some length [s]."""
    setup: Callable[[Motion], Setup]
    """Return the usual sensors and disturbances."""
    one_stream: bool = False
    """Whether its usual sensors draw from one stream of random numbers, one after the other."""


def drive_circuit(generator: Generator, duration_s: float) -> Motion:
    """Return a drive along the circuit, at random within the lane, with random waits at lights."""
    heading, stops, lap_length = _circuit(duration_s)
    # on straight streets, and then along bent ones
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = CIRCUIT_STEP * np.column_stack((np.cos(middle), np.sin(middle)))
    grid = np.concatenate(([[0.0, 0.0]], np.cumsum(steps, axis=0)))
    bent = grid + np.column_stack((7.0 * np.sin(2.0 * np.pi * grid[:, 1] / 310.0),
                                   9.0 * np.sin(2.0 * np.pi * grid[:, 0] / 360.0 + 0.6)))
    path = wandering(generator, bent @ se2.rotation(STREET_BEARING).T, CIRCUIT_STEP, LANE_SIGMA)
    waits = np.append(3.0, generator.uniform(8.0, 20.0, len(stops)))
    motion, arrival = follow(path, stops, waits, CAR, duration_s)
    lap = round(lap_length / CIRCUIT_STEP)
    return motion._replace(lap_time=float(arrival[lap]) if lap < len(arrival) else np.inf)


def _circuit(duration_s: float) -> tuple[FloatArray, IntArray, float]:
    """Return headings every `CIRCUIT_STEP` [rad], indices of the stops and length of a lap [m]."""
    corners = np.array(CORNERS, dtype=np.float64)
    incoming = corners - np.roll(corners, 1, axis=0)
    incoming /= np.linalg.norm(incoming, axis=1, keepdims=True)
    outgoing = np.roll(incoming, -1, axis=0)
    right = np.array([[0.0, -1.0], [1.0, 0.0]])
    lane = corners + LANE_OFFSET * (incoming + outgoing) @ right
    turns = np.arctan2(incoming[:, 0] * outgoing[:, 1] - incoming[:, 1] * outgoing[:, 0],
                       np.sum(incoming * outgoing, axis=1))

    # distance from the corner to the ends of a turn: the integral of the cosine of its heading
    reach = TURN_LENGTH * np.mean(np.cos(0.5 * np.pi * ramp((np.arange(1000) + 0.5) / 1000)))
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


def _hall(generator: Generator, duration_s: float) -> Motion:
    """
    Return a drive through the aisles of a hall in random order.

    Aisle k leads from (k spacing, 0) to (k spacing, depth). At both ends a lane joins all aisles.
    The robot drives each aisle from end to end and then changes to any other.
    """
    length = (duration_s + MARGIN_S) * FORKLIFT.speed + 2.0 * AISLE_DEPTH
    aisle, y, driven = int(generator.integers(AISLES)), 0.0, 0.0
    corners = [(aisle * AISLE_SPACING, y)]
    while driven <= length:
        y = AISLE_DEPTH - y
        corners.append((aisle * AISLE_SPACING, y))
        other = (aisle + int(generator.integers(1, AISLES))) % AISLES
        driven += AISLE_DEPTH + AISLE_SPACING * abs(other - aisle)
        aisle = other
        corners.append((aisle * AISLE_SPACING, y))
    points, middles = rounded(np.array(corners), ROBOT_TURN, PATH_STEP)
    path = wandering(generator, points, PATH_STEP, ASIDE)
    picks = middles[1:-1][generator.random(len(middles) - 2) < PICKS]
    stops = np.unique(np.round(picks / PATH_STEP).astype(np.int64))
    waits = np.append(REST_S, generator.uniform(*PICK_S, len(stops)))
    return follow(path, stops, waits, FORKLIFT, duration_s)[0]


def _grid(generator: Generator, duration_s: float) -> Motion:
    length = (duration_s + MARGIN_S) * CART.speed
    corners = street_corners(
        generator, length + 2.0 * BLOCK * BLOCKS, np.full(BLOCKS, BLOCK), fresh=1.0)
    points, _ = rounded(corners, CART_TURN, PATH_STEP)
    path = wandering(generator, points, PATH_STEP, ASIDE)
    path[:, :2] = path[:, :2] @ se2.rotation(STREET_BEARING).T
    path[:, 2] += STREET_BEARING
    return follow(path, np.empty(0, dtype=np.int64), np.array([REST_S]), CART, duration_s)[0]


WORLDS = {
    'drive': World(drive_circuit, lambda motion: Setup(
        wheels=settings.Wheels(start=(3.2, -1.4, -2.0)), fixes=settings.Fixes(),
        closures=Closures(false=FalseClosures(groups=1, size=4, singles=4, loose=True)),
        outages=(settings.Outage(FIXES, *(motion.lap_time + np.array(OUTAGE_S)).tolist()),)
        if np.isfinite(motion.lap_time) else (), jumps=(REFLECTED,)), one_stream=True),
    'hall': World(_hall, lambda _: Setup(
        wheels=settings.Wheels(track_width=0.6, slip_events_per_s=1.0 / 120.0),
        closures=Closures(
            sigmas=(0.05, 0.05, 0.01), spacing=5.0, radius=1.0, min_distance=20.0,
            place_distance=1.0, first_s=REST_S,
            false=FalseClosures(min_distance=3.0, spacing=1.0, from_s=60.0)))),
    'grid': World(_grid, lambda _: Setup(
        wheels=settings.Wheels(track_width=0.8), closures=Closures(
            rate=0.5, sigmas=(0.1, 0.1, 0.02), spacing=1.0, radius=1.5, min_distance=10.0,
            first_s=REST_S, false=FalseClosures(min_distance=8.0, spacing=1.0, from_s=60.0))))}
