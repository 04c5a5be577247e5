# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated drives with wrong loop closures, from seeds, and wrong ones for recordings."""

from dataclasses import replace

import numpy as np

from benchmark.recordings import claimed_twist, closures, Recording, SECOND
from benchmark.worlds import World
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.offline.simulation.recording import course, graph_of, odometry_edges
from pose_graph_ros.offline.simulation.settings import (
    ClaimedSigma,
    CLOSURES,
    FalseClosures,
    Setup,
)
from pose_graph_ros.offline.simulation.worlds import path_length, WORLDS

LEAST_WRONG = 3.5
"""Smallest error of a closure that is meant to be wrong [m]."""
COMB = np.array(((0, 0), (200, 0), (200, 40), (40, 40), (40, 80), (200, 80), (200, 120),
                 (0, 120)), dtype=np.float64)
"""Corners of a closed street whose parts lie 40 m apart [m]."""
AROUND, STEP, LAPS = 960.0, 0.4, 1.4
"""Its length, and the distance of samples along it [m]; how often it is driven."""
GATE_SIGMAS = 0.5, 0.5, 0.04


def of_world(world: World) -> Recording:
    """Return a world with odometry and closures as a recording, a pose in every second."""
    chain, loops = (world.edges.rows(world.edges.kind == kind)
                    for kind in (FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE))
    stamps = SECOND * np.arange(1, world.n_nodes + 1)
    assert world.truth is not None
    return Recording(world.name, stamps, chain, Trajectory(stamps, world.truth),
                     claimed_twist(chain)).closing(loops)


def simulated(
    world: str, duration_s: float, seed: int, *, distance: float = 1.0, claimed: float = 1.0,
    false: FalseClosures | None = None,
) -> Recording:
    """
    Simulate a drive whose odometry is as good as its noise model says, and its loop closures.

    Parameters
    ----------
    world : str, of `WORLDS`
    duration_s : float
    seed : int
    distance : float, between samples of odometry [m]
    claimed : float, ratio of the sigmas that come with closures to the scatter of right ones
    false : FalseClosures, optional, what is changed of the usual false ones of the world

    """
    def change(usual: Setup) -> Setup:
        assert usual.closures is not None
        wrong = usual.closures.false if false is None else replace(
            usual.closures.false, groups=false.groups, size=false.size, singles=false.singles,
            loose=false.loose)
        return replace(usual, fixes=None, outages=(), jumps=(),
                       closures=replace(usual.closures, false=wrong),
                       claims=(ClaimedSigma(CLOSURES, claimed),))
    graph = graph_of(course(WORLDS[world], seed, duration_s, change), distance)
    chain = graph.edges.rows(graph.edges.kind == FactorKind.ODOMETRY)
    return Recording(world, graph.truth.stamps_ns, chain, graph.truth).closing(graph.loops)


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
    corners = np.vstack([COMB] * (int(LAPS) + 1) + [COMB[:1]])
    at, along = np.arange(0.0, LAPS * AROUND, STEP), path_length(corners)
    points = np.column_stack([np.interp(at, along, corners[:, axis]) for axis in (0, 1)])
    moves = np.diff(points, axis=0)
    truth = np.column_stack((points[:-1], np.arctan2(moves[:, 1], moves[:, 0])))
    n = len(truth)
    # at 1.2 m/s and at most 1 rad/s
    turns = np.abs(se2.wrap(np.diff(truth[:, 2])))
    time = np.concatenate(([0.0], np.cumsum(np.maximum(STEP / 1.2, turns))))
    stamps = SECOND + np.round((time + 1e-3 * np.arange(n)) * SECOND).astype(np.int64)
    chain = odometry_edges(rng, Trajectory(stamps, truth))
    lap = round(AROUND / STEP)
    j = np.sort(rng.choice(np.arange(round(0.65 * lap), lap, 60), lone, replace=False))
    i = rng.integers(0, round(0.2 * lap), lone)
    angle, far = rng.uniform(-np.pi, np.pi, lone), rng.uniform(10.0, 25.0, lone)
    poses = se2.compose(se2.between(truth[i], truth[j]), np.column_stack((
        far * np.cos(angle), far * np.sin(angle), rng.normal(0.0, 0.15, lone))))
    later = np.sort(rng.choice(np.arange(lap + 20, n - 5), right, replace=False))
    true = se2.compose(se2.between(truth[later - lap], truth[later]),
                       rng.normal(size=(right, 3)) * GATE_SIGMAS)
    return Recording('wide gates', stamps, chain, Trajectory(stamps, truth)).closing(closures(
        np.concatenate((i, later - lap)), np.concatenate((j, later)), np.vstack((poses, true)),
        np.diag(np.power(GATE_SIGMAS, -2.0))))


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
    typical = recording.loops().information[rng.integers(0, right, len(i))]
    return recording.closing(closures(np.array(i), np.array(j), np.array(poses), typical))
