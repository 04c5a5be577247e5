# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Simulated drives with wrong loop closures, from seeds: data on which nothing was tuned.

Place recognition is wrong in two ways. Sometimes a single image looks like one of anywhere. And
places that look alike, such as the floors or the parallel corridors of an office, give a group of
closures that agree with one another: a stretch of one corridor is taken for that of another.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from benchmark.robust_closures import closing, Recording, SECOND
from benchmark.worlds import integrate, World
from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.constraints import EdgeKind
from pose_graph_ros.offline.simulation.streets import street_path

LEAST_WRONG = 3.5
"""Smallest error of a closure that is meant to be wrong [m]."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where the robot drives, and how well its sensors work there."""

    name: str
    spacing: tuple[float, float]
    """Smallest and largest distance of parallel corridors or streets [m]."""
    streets: int
    step: float
    """Distance of the samples of odometry [m]."""
    n: int
    speed: float
    """[m/s]"""
    noise: float
    """Of odometry, as a factor on the sigmas of its model."""
    sigma: tuple[float, float, float]
    """True scatter of a right closure [m, m, rad]; its tails are those of Student's t, 4."""
    radius: float
    """Within which a place is recognised [m]."""


@dataclass(frozen=True, slots=True)
class Recogniser:
    """What the front end finds."""

    name: str
    right: int
    single: int
    """Wrong closures that have nothing to do with one another."""
    groups: int
    """Groups of 4 to 12 wrong closures that agree with one another."""


OFFICE = Place('office', (9.0, 20.0), 4, 0.2, 4000, 0.5, 1.0, (0.15, 0.15, 0.03), 1.5)
OUTDOORS = Place('outdoors', (40.0, 110.0), 3, 0.5, 4500, 1.2, 0.8, (0.5, 0.5, 0.04), 3.0)
LOOSE = Recogniser('loose', 230, 60, 8)
MEDIUM = Recogniser('medium', 150, 20, 3)
STRICT = Recogniser('strict', 40, 0, 0)


def place_recognition(
    place: Place, recogniser: Recogniser, over_confidence: float, seed: int,
) -> Recording:
    """
    Simulate a drive whose odometry is as good as its noise model says, and its loop closures.

    Parameters
    ----------
    place : Place
    recogniser : Recogniser
    over_confidence : float
        Ratio of the scatter of right closures to the sigmas that come with all closures.
    seed : int

    """
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(*place.spacing, place.streets)
    truth = street_path(rng, place.n, place.step, gaps, fresh=1.0,
                        rounding=max(round(1.5 / place.step), 1))
    recording = driven(
        f'{place.name}, {recogniser.name}, {over_confidence:g}x', truth, place, rng)
    sigma = np.array(place.sigma)
    i, j = _revisits(truth, place, rng, recogniser.right)
    scatter = rng.standard_t(4, (len(i), 3)) / np.sqrt(2.0)
    poses = se2.compose(se2.between(truth[i], truth[j]), scatter * sigma)
    for p, q in [_single(truth, rng) for _ in range(recogniser.single)] + [
            pair for _ in range(recogniser.groups) for pair in _group(truth, place, rng)]:
        i, j = np.append(i, p), np.append(j, q)
        looks = rng.normal(0.0, (0.5 * place.radius, 0.5 * place.radius, 0.1))
        poses = np.vstack((poses, looks))
    claimed = np.diag((sigma / over_confidence)**2)
    return closing(recording, i, j, poses, np.tile(claimed, (len(i), 1, 1)))


def driven(name: str, truth: FloatArray, place: Place, rng: np.random.Generator) -> Recording:
    """
    Return a drive along true poses, without closures.

    Parameters
    ----------
    name : str
    truth : ndarray, shape (N, 3)
    place : Place
    rng : Generator

    """
    model, steps = OdometryNoise(), se2.between(truth[:-1], truth[1:])
    distance, turn = np.hypot(steps[:, 0], steps[:, 1]), np.abs(steps[:, 2])
    sigma = np.column_stack((
        model.sigma_distance * np.sqrt(distance), model.sigma_lateral * np.sqrt(distance),
        np.sqrt(model.sigma_heading_distance**2 * distance + model.sigma_heading_turn**2 * turn)))
    noise = place.noise * rng.normal(size=steps.shape) * sigma
    time = np.concatenate(([0.0], np.cumsum(np.maximum(distance / place.speed, turn))))
    stamps = SECOND + np.round((time + 1e-3 * np.arange(len(time))) * SECOND).astype(np.int64)
    odometry = integrate(np.zeros(3), se2.compose(steps, noise))
    return Recording(name, stamps, odometry, Trajectory(stamps, truth),
                     np.empty((0, 2), dtype=np.int64), np.empty((0, 3)), np.empty((0, 3, 3)),
                     np.empty(0, dtype=np.int64))


def _revisits(
    truth: FloatArray, place: Place, rng: np.random.Generator, count: int,
) -> tuple[IntArray, IntArray]:
    """Return up to so many pairs of poses at one place, looking in one direction."""
    pairs = np.sort(cKDTree(truth[:, :2]).query_pairs(
        place.radius, output_type='ndarray'), axis=1)
    apart = (pairs[:, 1] - pairs[:, 0]) * place.step > 10.0 * place.radius + 15.0
    alike = np.abs(se2.wrap(truth[pairs[:, 1], 2] - truth[pairs[:, 0], 2])) < 0.5
    pairs = rng.permutation(pairs[apart & alike])
    _, first = np.unique(pairs[:, 1], return_index=True)    # one at a time
    pairs = rng.permutation(pairs[first])[:count]
    return pairs[:, 0], pairs[:, 1]


def _single(truth: FloatArray, rng: np.random.Generator) -> tuple[int, int]:
    """Return two poses that are not at one place, the later one second."""
    while True:
        i, j = sorted(rng.integers(0, len(truth), 2).tolist())
        if np.hypot(*(truth[i] - truth[j])[:2]) > LEAST_WRONG + 3.0:
            return i, j


def _group(
    truth: FloatArray, place: Place, rng: np.random.Generator,
) -> list[tuple[int, int]]:
    """Return pairs along two stretches that are not one place but run in one direction."""
    size = int(rng.integers(4, 13))
    every = max(round(rng.uniform(0.5, 2.0) / place.step), 1)
    length = size * every
    while True:
        j = int(rng.integers(len(truth) // 3, len(truth) - length))
        i = int(rng.integers(0, j - length)) if j > length else 0
        at = np.arange(size) * every
        moved = se2.between(truth[i + at], truth[j + at])
        if (np.all(np.hypot(*moved[:, :2].T) > LEAST_WRONG + 2.0 * place.radius)
                and np.all(np.abs(moved[:, 2]) < 0.2) and np.ptp(moved[:, 0]) < 1.0
                and np.ptp(moved[:, 1]) < 1.0):
            return [(i + k, j + k) for k in at.tolist()]


COMB = np.array(((0, 0), (200, 0), (200, 40), (40, 40), (40, 80), (200, 80), (200, 120),
                 (0, 120)), dtype=np.float64)
"""Corners of a closed street of 960 m whose parts lie 40 m apart [m]."""


def wide_gates(seed: int, lone: int = 5, right: int = 25) -> Recording:
    """
    Simulate a long way round before anything is seen again, and wrong lone closures first.

    The wrong ones are 10 to 25 m off, less than three sigmas of odometry when they come, and far
    apart. The right ones come on the second lap.

    Parameters
    ----------
    seed : int
    lone, right : int, numbers of wrong and of right closures

    """
    rng = np.random.default_rng(seed)
    place = replace(OUTDOORS, name='wide gates', step=0.4, noise=1.0)
    truth = _polygon(place.step, laps=1.4)
    recording = driven('wide gates', truth, place, rng)
    lap = round(960.0 / place.step)
    j = np.sort(rng.choice(np.arange(round(0.65 * lap), lap, 60), lone, replace=False))
    i = rng.integers(0, round(0.2 * lap), lone)
    angle, far = rng.uniform(-np.pi, np.pi, lone), rng.uniform(10.0, 25.0, lone)
    poses = se2.compose(se2.between(truth[i], truth[j]), np.column_stack((
        far * np.cos(angle), far * np.sin(angle), rng.normal(0.0, 0.15, lone))))
    later = np.sort(rng.choice(np.arange(lap + 20, len(truth) - 5), right, replace=False))
    true = se2.compose(se2.between(truth[later - lap], truth[later]),
                       rng.normal(size=(right, 3)) * place.sigma)
    return closing(recording, np.concatenate((i, later - lap)), np.concatenate((j, later)),
                   np.vstack((poses, true)),
                   np.tile(np.diag(np.square(place.sigma)), (lone + right, 1, 1)))


def _polygon(step: float, laps: float) -> FloatArray:
    """Return poses, shape (N, 3), at equal steps along the comb."""
    corners = np.vstack([COMB] * (int(laps) + 1) + [COMB[:1]])
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    at = np.arange(0.0, laps * 960.0, step)
    points = np.column_stack([np.interp(at, along, corners[:, axis]) for axis in (0, 1)])
    moves = np.diff(points, axis=0)
    return np.column_stack((points[:-1], np.arctan2(moves[:, 1], moves[:, 0])))


def of_world(world: World) -> Recording:
    """Return a world with odometry and closures as a recording, a pose in every second."""
    edges = world.edges
    stamps = SECOND * np.arange(1, world.n_nodes + 1)
    chain = edges.rows(edges.kind == EdgeKind.ODOMETRY)
    loops = edges.rows(edges.kind == EdgeKind.LOOP_CLOSURE)
    assert world.truth is not None
    recording = Recording(
        world.name, stamps, integrate(np.zeros(3), chain.mean), Trajectory(stamps, world.truth),
        np.empty((0, 2), dtype=np.int64), np.empty((0, 3)), np.empty((0, 3, 3)),
        np.empty(0, dtype=np.int64), np.diagonal(np.linalg.inv(chain.information[0])).copy())
    return closing(recording, loops.i, loops.j, loops.mean, np.linalg.inv(loops.information))


def with_false(recording: Recording, share: float, group: int, seed: int) -> Recording:
    """
    Add wrong closures to a recording, with covariances of its right ones.

    Parameters
    ----------
    recording : Recording
    share : float
        Of all closures then.
    group : int, at least 1
        So many agree with one another: they lead from consecutive poses to consecutive poses.
    seed : int

    """
    if group < 1:
        raise ValueError(f'with_false: expected a group of at least 1 closure, got {group}')
    rng = np.random.default_rng(seed)
    right, n = len(recording.ends), len(recording.stamps_ns)
    truth, odometry = recording.truth.at(recording.stamps_ns), recording.odometry
    extent = 0.25 * float(np.max(np.ptp(truth[:, :2], axis=0)))
    i, j, poses = list[int](), list[int](), list[FloatArray]()
    while len(i) < share / (1.0 - share) * right:
        p, q = sorted(rng.integers(0, n - group, 2).tolist())
        if q - p < group + 2:
            continue
        claim = np.array((*rng.uniform(-extent, extent, 2), rng.uniform(-np.pi, np.pi)))
        if np.hypot(*(se2.between(truth[p], truth[q]) - claim)[:2]) < 2.0 * LEAST_WRONG:
            continue
        for k in range(group):
            there = se2.between(odometry[p], odometry[p + k])
            back = se2.between(odometry[q], odometry[q + k])
            i, j = [*i, p + k], [*j, q + k]
            poses.append(se2.compose(se2.compose(se2.inverse(there), claim), back))
    typical = recording.covariances[rng.integers(0, right, len(i))]
    return closing(recording, np.array(i), np.array(j), np.array(poses), typical)


def circumstances() -> dict[str, Callable[[Recording, np.random.Generator], Recording]]:
    """Return in what other ways the closures of one drive can come, by name."""
    return {
        'as they come': lambda recording, _: recording,
        '30 s late': lambda recording, _: recording.ordered(recording.arrival_ns + 30 * SECOND),
        'up to 60 s late, in any order': lambda recording, rng: recording.ordered(
            recording.arrival_ns + rng.integers(0, 60 * SECOND, len(recording.ends))),
        'all of them at the end, in any order': lambda recording, rng: recording.ordered(
            recording.stamps_ns[-1] - rng.integers(1, SECOND, len(recording.ends))),
        'each of them twice': _twice,
        'stamps between samples': _shifted,
        'claimed sigmas a tenth': lambda recording, _: replace(
            recording, covariances=0.01 * recording.covariances),
        'claimed sigmas ten times': lambda recording, _: replace(
            recording, covariances=100.0 * recording.covariances),
        'only right ones': lambda recording, _: recording.only(recording.errors() <= LEAST_WRONG),
        'only wrong ones': lambda recording, _: recording.only(recording.errors() > LEAST_WRONG)}


def _twice(recording: Recording, rng: np.random.Generator) -> Recording:
    again = np.repeat(np.arange(len(recording.ends)), 2)
    late = rng.integers(0, 20 * SECOND, len(again)) * (np.arange(len(again)) % 2)
    return recording.only(again).ordered(recording.arrival_ns[again] + late)


def _shifted(recording: Recording, rng: np.random.Generator) -> Recording:
    """Move the ends between the stamps of odometry; what is measured moves with them."""
    odometry = Trajectory(recording.stamps_ns, recording.odometry)
    first, last = recording.stamps_ns[0], recording.stamps_ns[-1]
    ends = np.clip(recording.ends + rng.integers(0, SECOND // 3, recording.ends.shape),
                   first, last)
    there, back = (se2.between(odometry.at(recording.ends[:, k]), odometry.at(ends[:, k]))
                   for k in (0, 1))
    poses = se2.compose(se2.compose(se2.inverse(there), recording.poses), back)
    return replace(recording, ends=ends, poses=poses).ordered(
        np.maximum(recording.arrival_ns, ends.max(axis=1)))
