# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Worlds of a simulation: how vehicles move, and the graphs along their ways."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.offline.simulation.recording import course, graph_of, SimulatedGraph
from pose_graph_ros.offline.simulation.settings import (
    Fixes,
    GlobalPoses,
    Jump,
    Outage,
    Setup,
    START_NS,
)
from pose_graph_ros.offline.simulation.worlds import (
    AISLE_DEPTH,
    AISLE_SPACING,
    AISLES,
    CART,
    FORKLIFT,
    WORLDS,
)

LIMITS = {'hall': FORKLIFT, 'grid': CART}


@pytest.mark.parametrize('world', LIMITS)
def test_a_robot_moves_like_a_robot(world: str) -> None:
    motion = course(WORLDS[world], 1, 900.0).motion
    poses, stamps = motion.truth.poses, motion.truth.stamps_ns
    steps = se2.between(poses[:-1], poses[1:]) / 0.01
    limits, speed, turn = LIMITS[world], steps[:, 0], steps[:, 2]
    assert (stamps[-1] - stamps[0]) * 1e-9 == pytest.approx(900.0)
    assert speed.min() > -1e-6
    assert speed.max() < 1.01 * limits.speed
    assert np.abs(steps[:, 1]).max() < 0.03    # not sideways
    assert np.abs(np.diff(speed)).max() / 0.01 < 2.0 * limits.acceleration
    assert np.abs(speed * turn).max() < 1.3 * limits.lateral_acceleration
    assert np.all(np.diff(motion.distance) >= 0.0)
    assert 0.3 * limits.speed < motion.distance[-1] / 900.0 < limits.speed


def test_the_robot_stays_in_the_aisles_of_the_hall_for_hours() -> None:
    motion = course(WORLDS['hall'], 2, 4.0 * 3600.0).motion
    x, y, heading = motion.truth.poses[::100].T
    in_aisle = np.abs(x / AISLE_SPACING - np.round(x / AISLE_SPACING)) * AISLE_SPACING < 0.6
    in_lane = np.minimum(np.abs(y), np.abs(y - AISLE_DEPTH)) < 2.0
    assert np.all(in_aisle | in_lane)
    assert x.min() > -0.6
    assert x.max() < (AISLES - 1) * AISLE_SPACING + 0.6
    # each aisle again and again, in both directions
    middle = np.abs(y - 0.5 * AISLE_DEPTH) < 1.0
    visits = np.round(x[middle] / AISLE_SPACING).astype(int) * 2 + (np.sin(heading[middle]) > 0.0)
    assert np.bincount(visits, minlength=2 * AISLES).min() > 10
    assert np.mean(np.diff(motion.distance) < 1e-6) > 0.1    # it stops to pick up


def simulated(world: str, seed: int = 1, **changes: object) -> SimulatedGraph:
    """Return a graph without what a world usually has false in it."""
    def change(usual: Setup) -> Setup:
        assert usual.closures is not None
        return replace(usual, outages=(), jumps=(), closures=replace(
            usual.closures, false=replace(
                usual.closures.false, singles=0, groups=0, loose=False)), **changes)
    return graph_of(course(WORLDS[world], seed, 400.0, change), 1.0)


@pytest.mark.parametrize('world', WORLDS)
def test_chi2_at_the_truth_is_distributed_as_chi_square(world: str) -> None:
    for seed in (1, 2):
        found = simulated(world, seed, fixes=Fixes(correlated=0.0), poses=GlobalPoses())
        numbers = 3 * len(found.edges) + int(np.sum(
            np.diagonal(found.observed.information, 0, 1, 2) > 0.0))
        value = found.graph(found.truth.poses).energies().chi2
        assert 1e-4 < chi2.cdf(value, numbers) < 1.0 - 1e-4


def test_the_edges_of_a_graph_lead_along_the_path_and_to_where_it_was_before() -> None:
    found = simulated('grid', fixes=None)
    n = len(found.truth)
    odometry = found.edges.rows(found.edges.kind == FactorKind.ODOMETRY)
    np.testing.assert_array_equal(odometry.j, np.arange(1, n))
    np.testing.assert_array_equal(odometry.i, np.arange(n - 1))
    loops = found.edges.rows(found.edges.kind == FactorKind.LOOP_CLOSURE)
    assert len(loops) > 20
    assert np.all(found.group == -1)
    there = found.truth.poses[loops.i] - found.truth.poses[loops.j]
    assert np.max(np.hypot(*there[:, :2].T)) <= 1.5
    # it begins at the true start, which is fixed, and odometry leads to the start poses
    np.testing.assert_allclose(found.truth.poses[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(
        se2.between(found.start[:-1], found.start[1:]), odometry.mean, atol=1e-9)


def test_disturbances_of_a_graph() -> None:
    usual = simulated('grid', fixes=Fixes())
    changes = {'outages': (Outage('/gps/fix', 50.0, 100.0), Outage('/loop_closure', 0.0, 200.0)),
               'jumps': (Jump('/odom', 150.0, (4.0, 0.0, 0.5)),
                         Jump('/gps/fix', 200.0, (20.0, 0.0, 0.0), 30.0))}

    def change(setup: Setup) -> Setup:
        return replace(setup, fixes=Fixes(), **changes)
    found = graph_of(course(WORLDS['grid'], 1, 400.0, change), 1.0)
    time = (found.truth.stamps_ns - START_NS) * 1e-9
    seen = time[found.observed.i]
    assert np.sum((seen > 50.5) & (seen < 99.5)) == 0
    assert np.sum((seen > 20.0) & (seen < 50.0)) > 20
    assert np.all((time[found.observed.i[found.wrong]] > 199.0)
                  & (time[found.observed.i[found.wrong]] < 231.0))
    loops = found.edges.rows(found.edges.kind == FactorKind.LOOP_CLOSURE)
    assert np.all(time[loops.j] >= 199.9)
    steps = se2.between(usual.edges.mean[:len(time) - 1], found.edges.mean[:len(time) - 1])
    at, = np.flatnonzero(np.abs(steps).max(axis=1) > 1e-9)
    np.testing.assert_allclose(steps[at], (4.0, 0.0, 0.5), atol=1e-9)
    assert time[at] < 150.0 <= time[at + 1]
