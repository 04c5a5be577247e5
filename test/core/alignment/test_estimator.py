# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The angle between odometry and map from positions, and its sigma."""

from dataclasses import dataclass, replace

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.alignment.consensus import Given
from pose_graph_ros.core.alignment.estimator import (
    find_alignment,
    GraphAlignment,
    recheck,
)
from pose_graph_ros.core.config import AlignmentPolicy, OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors

# Weighted sums of squares of some 100 m.
EXACT = 1e-9

POLICY = AlignmentPolicy()
NOISE = OdometryNoise()
PERFECT = OdometryNoise(
    sigma_distance=0.0, sigma_lateral=0.0, sigma_heading_distance=0.0, sigma_heading_turn=0.0)

seeds = st.integers(0, 2**32 - 1)


# --- Drives ----------------------------------------------------------------------------------

@dataclass(frozen=True)
class Drive:
    """A winding drive with drifting odometry, and what was observed on the way."""

    truth: FloatArray
    odometry: FloatArray
    node: IntArray
    """Hidden nodes with a position, shape (K,)."""
    xy: FloatArray
    """Observed positions, shape (K, 2)."""
    stamp: FloatArray
    """Of the positions [s]."""
    sigma: float

    @property
    def observed(self) -> Factors:
        return observed_nodes(self.node, self.xy, self.sigma)

    def moved(self, rows: slice | IntArray, shift: FloatArray) -> 'Drive':
        xy = self.xy.copy()
        xy[rows] += shift
        return replace(self, xy=xy)

    def error(self, turn: GraphAlignment) -> float:
        """Return the error of the angle at the node of the alignment [rad]."""
        assert turn.T_map_graph is not None
        true = self.truth[turn.node, 2] - self.odometry[turn.node, 2]
        return abs(float(se2.wrap(turn.T_map_graph[2] - true)))


def observed_nodes(node: IntArray, xy: FloatArray, sigma: float) -> Factors:
    information = np.zeros((len(node), 3, 3))
    information[:, 0, 0] = information[:, 1, 1] = sigma**-2
    return Factors.on(node, None, np.column_stack((xy, np.zeros(len(node)))), information,
                         np.full(len(node), FactorKind.POSITION))


def drive(
    seed: int, n: int, gap: float, *, speed: float = 1.0, sigma: float = 1.0,
    curvature: float = 0.05, time: float = 0.0, noise: OdometryNoise = NOISE,
) -> Drive:
    """
    Simulate n positions at equal distances along the path [m, m/s, m, 1/m, s].

    With a correlation time the errors of the positions are correlated.
    """
    rng = np.random.default_rng(seed)
    per_gap = max(1, round(gap / max(1.0, 0.2 * speed)))
    steps, fine = (n - 1) * per_gap, 8
    d = gap / per_gap / fine
    bend = np.repeat(curvature * np.sin(np.cumsum(0.2 * rng.standard_normal(steps))), fine)
    wrong = rng.standard_normal((4, steps * fine)) * np.sqrt(d)
    heading = np.append(0.0, np.cumsum(bend * d))
    drifted = heading + np.append(0.0, np.cumsum(
        noise.sigma_heading_distance * wrong[0]
        + noise.sigma_heading_turn * np.sqrt(np.abs(bend)) * wrong[1]))
    T_map_start = np.array([*rng.uniform(-500.0, 500.0, 2), rng.uniform(-np.pi, np.pi)])
    truth = se2.compose(T_map_start, integrated(heading, d * np.ones(steps * fine)))[::fine]
    odometry = integrated(
        drifted, d + noise.sigma_distance * wrong[2] + 1j * noise.sigma_lateral * wrong[3])
    node = np.arange(n) * per_gap
    stamp = node * (gap / per_gap / speed)
    error = sigma * rng.standard_normal((n, 2))
    if time > 0.0:
        for k in range(1, n):
            kept = np.exp((stamp[k - 1] - stamp[k]) / time)
            error[k] = kept * error[k - 1] + np.sqrt(1.0 - kept**2) * error[k]
    return Drive(truth, se2.wrapped(odometry[::fine]), node, truth[node, :2] + error, stamp, sigma)


def integrated(heading: FloatArray, step: np.ndarray) -> FloatArray:
    path = np.append(0.0, np.cumsum(step * np.exp(0.5j * (heading[1:] + heading[:-1]))))
    return np.column_stack((path.real, path.imag, heading))


def lasting(
    table: Factors, stamps: FloatArray, times: float | FloatArray,
) -> Given:
    return Given(table, stamps, np.broadcast_to(times, stamps.shape), POLICY, NOISE)


def white(table: Factors) -> Given:
    return lasting(table, np.zeros(len(table)), 0.0)


def by(odometry: FloatArray, table: Factors) -> GraphAlignment:
    """Return what observed nodes with white noise say."""
    return find_alignment(odometry, white(table))


def found(drive: Drive, times: float | FloatArray | None = None) -> GraphAlignment:
    """Return what all positions of a drive say, whose errors last for some time."""
    if times is None:
        return by(drive.odometry, drive.observed)
    return find_alignment(drive.odometry, lasting(drive.observed, drive.stamp, times))


def checked(
    solved: FloatArray, odometry: FloatArray, table: Factors, sigma: float = 0.0,
) -> GraphAlignment | None:
    return recheck(solved, odometry, white(table), sigma)


@given(seeds, st.integers(2, 40), st.floats(0.5, 30.0))
def test_exact_positions_give_the_exact_motion_from_two_on(
    seed: int, n: int, gap: float,
) -> None:
    exact = drive(seed, n, gap, sigma=0.01, noise=PERFECT)
    exact = replace(exact, xy=exact.truth[exact.node, :2])
    turn = found(exact)
    if (n - 1) * gap < 2.0:
        return  # may be too short
    assert exact.error(turn) < 1e-9
    np.testing.assert_allclose(
        se2.compose(turn.T_map_graph, exact.odometry)[:, :2], exact.truth[:, :2], atol=1e-8)


@given(seeds, st.integers(2, 130), st.sampled_from([0.0, 0.3, 0.5]))
def test_the_order_of_the_rows_changes_nothing(seed: int, n: int, fraction: float) -> None:
    rng = np.random.default_rng(seed)
    some = drive(seed, n, 3.0)
    bad = rng.permutation(n)[:int(fraction * n)]
    some = some.moved(bad, 40.0 * rng.standard_normal((len(bad), 2)))
    order = rng.permutation(n)
    turn = found(some, 30.0)
    other = find_alignment(
        some.odometry, lasting(some.observed.rows(order), some.stamp[order], 30.0))
    assert (turn.sigma, turn.node) == (other.sigma, other.node)
    np.testing.assert_array_equal(turn.T_map_graph, other.T_map_graph)


@given(seeds, st.integers(3, 60), st.floats(-3.1, 3.1), st.floats(-1e5, 1e5))
def test_a_motion_of_the_map_moves_the_result(
    seed: int, n: int, theta: float, shift: float,
) -> None:
    some = drive(seed, n, 8.0)
    some = some.moved(slice(0, n // 4), [30.0, 20.0])
    motion = np.array([shift, -shift, theta])
    turn = found(some)
    other = found(replace(some, xy=se2.transform(motion, some.xy)))
    assert (turn.T_map_graph is None) == (other.T_map_graph is None)
    assert other.sigma == pytest.approx(turn.sigma, rel=1e-6)
    if turn.T_map_graph is not None:
        expected = se2.compose(motion, turn.T_map_graph)
        np.testing.assert_allclose(other.T_map_graph[:2], expected[:2], atol=1e-6)
        assert abs(se2.wrap(other.T_map_graph[2] - expected[2])) < 1e-8


# --- Honest sigmas ---------------------------------------------------------------------------

def normalised_errors(
    n: int, gap: float, *, correlated: bool = False, **arguments: float,
) -> FloatArray:
    """Return (error / sigma)^2 of 150 drives."""
    squares = []
    for seed in range(150):
        some = drive(seed, n, gap, **arguments)
        turn = found(some, arguments['time'] if correlated else 0.0)
        if turn.T_map_graph is not None:
            squares.append((some.error(turn) / turn.sigma)**2)
    assert len(squares) > 140
    return np.array(squares)


@pytest.mark.parametrize(('n', 'gap', 'arguments'), [
    (20, 1.0, {}), (200, 1.0, {}),
    (10, 15.0, {'speed': 15.0}), (60, 15.0, {'speed': 15.0, 'curvature': 0.01}),
    (20, 30.0, {'speed': 30.0, 'sigma': 2.0, 'curvature': 0.002}),
    (12, 1.0, {'sigma': 0.02}),
], ids=['robot_20', 'robot_200', 'car_10', 'car_60', 'fast_car', 'rtk_12'])
def test_the_sigma_is_honest_for_white_errors(n: int, gap: float, arguments: dict) -> None:
    # 150 draws of chi2: 0.12 one sigma
    assert 0.7 < np.mean(normalised_errors(n, gap, **arguments)) < 1.4


@pytest.mark.parametrize(('n', 'gap', 'arguments'), [
    (20, 1.0, {}), (300, 1.0, {}), (60, 15.0, {'speed': 15.0, 'curvature': 0.01})])
def test_the_sigma_is_no_smaller_than_errors_with_a_correlation_time_of_a_minute(
    n: int, gap: float, arguments: dict,
) -> None:
    assert np.mean(normalised_errors(n, gap, correlated=True, time=60.0, **arguments)) < 1.5


def test_correlated_errors_have_a_larger_sigma() -> None:
    some = drive(0, 300, 1.0)
    white = found(some).sigma
    assert found(some, 0.0).sigma == white
    assert found(some, 30.0).sigma > white
    # errors of different receivers are independent
    times = np.where(np.arange(300) % 2 == 0, 30.0, 30.1)
    both = found(some, times).sigma
    assert white < both < found(some, 30.0).sigma


# --- Wrong positions -------------------------------------------------------------------------

def wrong(kind: str, some: Drive, rng: np.random.Generator, m: int) -> Drive:
    """Make m positions wrong."""
    n, direction = len(some.node), rng.standard_normal(2)
    shift = 30.0 * direction / np.hypot(*direction)
    if kind == 'scattered':
        far = rng.standard_normal((m, 2))
        far *= (10.0**rng.uniform(1.0, 2.5, m) / np.hypot(*far.T))[:, None]
        return some.moved(rng.permutation(n)[:m], far)
    if kind == 'first':
        return some.moved(slice(0, m), shift)
    if kind == 'last':
        return some.moved(slice(n - m, n), shift)
    start = int(rng.integers(0, n - m + 1))
    rows = slice(start, start + m)
    return some.moved(rows, some.xy[0] + shift - some.xy[rows])     # frozen


@pytest.mark.parametrize('kind', ['scattered', 'first', 'last', 'frozen'])
@pytest.mark.parametrize(('n', 'm', 'gap', 'arguments'), [
    (4, 1, 10.0, {}), (8, 3, 5.0, {}), (10, 4, 5.0, {}), (30, 12, 4.0, {}), (100, 40, 1.5, {}),
    (20, 8, 1.0, {'sigma': 0.02}),
    (20, 8, 30.0, {'speed': 30.0, 'sigma': 2.0, 'curvature': 0.002}),
], ids=['4', '8', '10', '30', '100', 'rtk', 'car'])
def test_two_fifths_may_be_wrong(
    kind: str, n: int, m: int, gap: float, arguments: dict,
) -> None:
    aligned = 0
    for seed in range(20):
        some = wrong(kind, drive(seed, n, gap, **arguments), np.random.default_rng(seed), m)
        turn = found(some)
        if turn.T_map_graph is not None:
            aligned += 1
            assert some.error(turn) < max(0.2, 5.0 * turn.sigma), seed
    assert aligned >= 17


def test_with_most_of_them_wrong_no_wrong_angle_is_found() -> None:
    aligned = 0
    for seed in range(20):
        some = wrong('scattered', drive(seed, 40, 2.0), np.random.default_rng(seed), 24)
        turn = found(some)
        if turn.T_map_graph is not None:
            aligned += 1
            assert some.error(turn) < 5.0 * turn.sigma
    assert aligned < 5


# --- Positions that give no angle ------------------------------------------------------------

@pytest.mark.parametrize('sigma', [0.02, 1.0])
@pytest.mark.parametrize('kind', ['stands', 'frozen', 'crawls', 'mirrored'])
@pytest.mark.parametrize(('n', 'gap'), [(2, 20.0), (20, 3.0), (100, 3.0), (200, 20.0)])
def test_what_does_not_follow_the_robot_never_aligns(
    kind: str, n: int, gap: float, sigma: float,
) -> None:
    if kind == 'mirrored' and n == 2:
        return  # no two positions show it
    for seed in range(10):
        some = drive(seed, n, gap, sigma=sigma)
        if kind == 'mirrored' and np.ptp(np.unwrap(some.truth[:, 2])) < 0.7:
            continue    # nor does a straight drive
        noise = some.xy - some.truth[some.node, :2]
        true = some.truth[some.node, :2]
        if kind == 'stands':
            jitter = 0.003 * np.random.default_rng(seed).standard_normal(some.odometry.shape)
            some = replace(some, odometry=jitter)
        elif kind == 'frozen':
            some = replace(some, xy=true[0] + noise)
        elif kind == 'crawls':
            some = replace(some, xy=true[0] + 0.1 * (true - true[0]) + noise)
        else:
            some = replace(some, xy=true * [-1.0, 1.0] + noise)
        assert found(some).T_map_graph is None, seed


def test_a_long_standstill_does_not_dominate_the_drive() -> None:
    some = drive(0, 12, 3.0)
    rng = np.random.default_rng(0)
    # a receiver that converges while the robot stands
    still = some.truth[0, :2] + [40.0, 10.0] + rng.standard_normal((200, 2))
    some = replace(some, node=np.append(np.zeros(200, dtype=np.int64), some.node),
                   xy=np.vstack((still, some.xy)))
    assert some.error(found(some)) < 0.3


# --- Drift -----------------------------------------------------------------------------------

@pytest.mark.parametrize('factor', [1.0, 2.0])
def test_positions_after_a_drive_that_drifted_by_radians_align(factor: float) -> None:
    worse = OdometryNoise(*(factor * getattr(NOISE, name) for name in (
        'sigma_distance', 'sigma_lateral', 'sigma_heading_distance', 'sigma_heading_turn')))
    for seed in range(10):
        some = drive(seed, 1000, 30.0, speed=15.0, curvature=0.01, noise=worse)
        drift = some.odometry[:, 2] - some.truth[:, 2]
        late = replace(some, node=some.node[-12:], xy=some.xy[-12:])
        assert np.ptp(se2.wrap(drift - drift[0])) > 0.5
        assert late.error(found(late)) < 0.3
        # and all of them at once, after the drive
        assert some.error(found(some)) < 0.4
        # or one in two kilometres
        if factor == 1.0:
            sparse = replace(some, node=some.node[::70], xy=some.xy[::70])
            turn = found(sparse)
            assert turn.T_map_graph is None or sparse.error(turn) < 5.0 * turn.sigma


# --- Global poses and checking again ---------------------------------------------------------

def test_one_global_pose_gives_the_angle() -> None:
    some = drive(0, 6, 3.0, sigma=5.0)
    table = some.observed
    table.kind[4] = FactorKind.GLOBAL_POSE
    table.mean[4] = some.truth[some.node[4]]
    table.information[4] = np.diag([1.0, 1.0, 100.0])
    turn = by(some.odometry, table)
    assert turn.node == some.node[4]
    assert turn.sigma == pytest.approx(0.1)
    np.testing.assert_allclose(
        se2.compose(turn.T_map_graph, some.odometry[turn.node]), table.mean[4], atol=EXACT)
    # unless its heading is poor
    table.information[4] = np.diag([1.0, 1.0, 1.0])
    assert by(some.odometry, table).T_map_graph is None


def test_an_angle_that_is_right_stays() -> None:
    for seed in range(50):
        some = drive(seed, 60, 2.0)
        turn = by(some.odometry, some.observed.rows(slice(0, 12)))
        solved = se2.compose(turn.T_map_graph, some.odometry)
        for k in (24, 48, 60):
            assert checked(
                solved, some.odometry, some.observed.rows(slice(0, k)), turn.sigma) is None
        # drift that the graph has corrected is no reason either
        assert checked(some.truth, some.odometry, some.observed) is None
