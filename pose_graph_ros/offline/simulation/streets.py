# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random ways through a grid of streets, and through the aisles of a hall; paths along them."""

import numpy as np
from scipy.ndimage import uniform_filter1d

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.quantities import Metres
from pose_graph_ros.offline.simulation.motion import ramp

# Four directions of a crossing's streets, counter-clockwise.
DIRECTIONS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
TURN_POINTS = 1000  # at which a turn is tabulated


def street_corners(
    rng: np.random.Generator, length: float, spacing: FloatArray, *, fresh: float,
) -> FloatArray:
    """
    Return the crossings of a random drive through a grid of streets, shape (K, 2) [m].

    It begins in the middle, eastwards. It goes straight on with a probability of 3/5 where it can,
    turns otherwise, and practically never goes back at once.

    Parameters
    ----------
    rng : numpy.random.Generator
    length : float, of the drive at least [m]
    spacing : ndarray, shape (S,)
        Distances of the streets [m], for both axes; the second in reverse.
    fresh : float
        How much likelier than one driven before a new street is chosen.

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
                seen = (*_middle(cell, end), way % 2) in visited
                weights[way] = likely * (1.0 if seen else fresh)
        facing = int(rng.choice(4, p=weights / weights.sum()))
        end = cell + DIRECTIONS[facing]
        visited.add((*_middle(cell, end), facing % 2))
        driven += abs(streets[end[0]] - streets[cell[0]]) + abs(avenues[end[1]] - avenues[cell[1]])
        cell = end
        corners.append(cell)
    nodes = np.array(corners)
    return np.column_stack((streets[nodes[:, 0]], avenues[nodes[:, 1]]))


def _middle(a: IntArray, b: IntArray) -> tuple[int, int]:
    """Return what names the street between two crossings, in either direction."""
    return int(a[0] + b[0]), int(a[1] + b[1])


def street_path(
    rng: np.random.Generator, n: int, step: float, spacing: FloatArray, *, fresh: float,
    rounding: int = 0,
) -> FloatArray:
    """
    Return poses, shape (N, 3), at equal steps along a random drive through a grid of streets.

    Parameters
    ----------
    rng : numpy.random.Generator
    n : int
    step : float
        Distance of the poses [m].
    spacing, fresh
        As of `street_corners`.
    rounding : int
        Corners are cut over this many steps to each side; with 0 a corner is a turn on the spot.

    """
    points = street_corners(rng, (n + 1) * step, spacing, fresh=fresh)
    along = np.concatenate(([0.0], np.cumsum(np.sum(np.abs(np.diff(points, axis=0)), axis=1))))
    at = step * np.arange(n + 1)
    path = np.column_stack([np.interp(at, along, points[:, axis]) for axis in (0, 1)])
    if rounding > 0:
        path = uniform_filter1d(path, 2 * rounding + 1, axis=0, mode='nearest')
    moves = np.diff(path, axis=0)
    return np.column_stack((path[:-1], np.arctan2(moves[:, 1], moves[:, 0])))


def aisle_corners(
    rng: np.random.Generator, length: Metres, aisles: int, spacing: Metres, depth: Metres,
) -> FloatArray:
    """
    Return the corners of a way through the aisles of a hall in random order, shape (K, 2) [m].

    Aisle k leads from (k spacing, 0) to (k spacing, depth). At both ends a lane joins all aisles.
    The robot drives each aisle from end to end and then changes to any other.
    """
    aisle, y, driven = int(rng.integers(aisles)), 0.0, 0.0
    corners = [(aisle * spacing, y)]
    while driven <= length:
        y = depth - y
        corners.append((aisle * spacing, y))
        other = (aisle + int(rng.integers(1, aisles))) % aisles
        driven += depth + spacing * abs(other - aisle)
        aisle = other
        corners.append((aisle * spacing, y))
    return np.array(corners)


def rounded(corners: FloatArray, turn: float, step: float) -> tuple[FloatArray, FloatArray]:
    """
    Return points along straight lines with right-angled turns, and where the corners are on it.

    Parameters
    ----------
    corners : ndarray, shape (K, 2)
        Ends of the lines, which run along the axes and are longer than a turn [m]; the way begins
        and ends in the middle of the first and the last one.
    turn : float, arc length of a turn [m]
    step : float, distance of the points along the path [m]

    Returns
    -------
    points : ndarray, shape (P, 2) [m]
    middles : ndarray, shape (L,)
        Distance along the path at which the middle of each line is [m], between turns.

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
    bend = np.clip(rest - start, 0.0, turn)
    straight = np.minimum(rest, start)
    beyond = np.maximum(rest - start - turn, 0.0)
    forward = (straight + np.interp(bend, along, ahead))[:, None]
    sideways = (np.interp(bend, along, left) + beyond)[:, None]
    middle = 0.5 * (corners[:-1] + corners[1:])
    return middle[line] + forward * ways[line] + sideways * ways[after], begins
