# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How the odometry frame lies in the map: found when it is known, from whatever is wrong."""

from dataclasses import dataclass, replace
from typing import NamedTuple

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, OdometryNoise, POSITIONS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.measurements import (
    Absolute,
    GlobalPose,
    HeadingOnly,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.sources.kinds import attach, observed
from pose_graph_ros.core.sources.queued import Queued
from pose_graph_ros.core.sources.settings import SOURCES

SECOND = 1_000_000_000
NOISE = OdometryNoise()
seeds = st.integers(0, 2**32 - 1)


# --- Drives ----------------------------------------------------------------------------------

@dataclass(frozen=True)
class Drive:
    """A winding drive with drifting odometry, and what was observed on the way."""

    truth: FloatArray
    odometry: FloatArray
    node: IntArray
    """Places on the path with a position, shape (K,)."""
    xy: FloatArray
    """Observed positions, shape (K, 2)."""
    seconds: float
    """From one place to the next."""
    sigma: float

    def moved(self, rows: slice | IntArray, shift: FloatArray) -> 'Drive':
        xy = self.xy.copy()
        xy[rows] += shift
        return replace(self, xy=xy)

    def stamp_ns(self, node: int) -> int:
        return SECOND + round(node * self.seconds * SECOND)

    @property
    def positions(self) -> list[Position]:
        return [Position(self.stamp_ns(node), xy, self.sigma**2 * np.eye(2), np.zeros(2))
                for node, xy in zip(self.node.tolist(), self.xy, strict=True)]


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
    node, seconds = np.arange(n) * per_gap, gap / per_gap / speed
    error = sigma * rng.standard_normal((n, 2))
    if time > 0.0:
        kept = np.exp(-per_gap * seconds / time)
        for k in range(1, n):
            error[k] = kept * error[k - 1] + np.sqrt(1.0 - kept**2) * error[k]
    return Drive(truth, se2.wrapped(odometry[::fine]), node, truth[node, :2] + error, seconds,
                 sigma)


def integrated(heading: FloatArray, step: np.ndarray) -> FloatArray:
    path = np.append(0.0, np.cumsum(step * np.exp(0.5j * (heading[1:] + heading[:-1]))))
    return np.column_stack((path.real, path.imag, heading))


class Driven:
    """The engine after the odometry of a drive, and what is measured on its nodes."""

    def __init__(self, some: Drive, time: float = -1.0) -> None:
        self.backend = PoseGraphBackend(BackendConfig(
            measurements={'fix': replace(POSITIONS, correlation_time=time)}))
        for node, pose in enumerate(some.odometry):
            self.backend.add_odometry(OdometrySample(some.stamp_ns(node), pose))
        self.backend.finish()
        self.alignment, self.graph = self.backend.parts.alignment, self.backend.parts.graph

    def queued(self, *measured: Absolute, source: str = 'fix') -> list[Queued]:
        nodes = self.backend.parts.nodes
        return [observed(source, each, attach(nodes, each.stamp_ns)) for each in measured]

    def find(self, queue: list[Queued]) -> FloatArray | None:
        return self.alignment.find(self.graph, queue)


class Found(NamedTuple):
    """What all positions of a drive say."""

    motion: FloatArray | None
    sigma: float
    error: float
    """Of the heading where the last position was measured [rad]."""


def found(some: Drive, time: float = -1.0) -> Found:
    driven = Driven(some, time)
    motion, error = driven.find(driven.queued(*some.positions)), 0.0
    if motion is not None:
        last = some.node[-1]
        error = float(se2.wrap(
            motion[2] + some.odometry[last, 2] - some.odometry[0, 2] - (
                driven.graph.poses[0, 2] + some.truth[last, 2] - some.odometry[0, 2])))
    return Found(motion, driven.alignment.sigma, abs(error))


@settings(max_examples=8)
@given(seeds, st.integers(2, 40), st.sampled_from([0.0, 0.3, 0.5]))
def test_the_order_of_arrival_changes_nothing(seed: int, n: int, fraction: float) -> None:
    rng = np.random.default_rng(seed)
    some = drive(seed, n, 3.0)
    bad = rng.permutation(n)[:int(fraction * n)]
    some = some.moved(bad, 40.0 * rng.standard_normal((len(bad), 2)))
    one, other = Driven(some), Driven(some)
    queue = one.queued(*some.positions)
    expected = one.find(queue)
    shuffled = [queue[k] for k in rng.permutation(n)]
    for end in range(1, n + 1):     # as they come, one by one
        motion = other.find(shuffled[:end])
        if motion is not None and end < n:
            return  # known before the last one has come
    assert other.alignment.sigma == pytest.approx(one.alignment.sigma, rel=1e-9)
    assert (motion is None) == (expected is None)
    if motion is not None:
        np.testing.assert_allclose(motion, expected, atol=1e-9)


@settings(max_examples=8)
@given(seeds, st.integers(4, 40), st.floats(-3.1, 3.1), st.floats(-1e5, 1e5))
def test_a_motion_of_the_map_moves_the_result(
    seed: int, n: int, theta: float, shift: float,
) -> None:
    some = drive(seed, n, 8.0)
    motion = np.array([shift, -shift, theta])
    one, other = found(some), found(replace(some, xy=se2.transform(motion, some.xy)))
    if one.motion is not None and other.motion is not None:
        off = float(se2.wrap(other.motion[2] - one.motion[2] - theta))
        assert abs(off) < 3.0 * max(one.sigma, other.sigma)


# --- Honest sigmas ---------------------------------------------------------------------------

@pytest.mark.parametrize(('n', 'gap', 'arguments'), [
    (20, 1.0, {}), (60, 1.0, {}), (10, 15.0, {'speed': 15.0}),
    (20, 30.0, {'speed': 30.0, 'sigma': 2.0, 'curvature': 0.002}),
    (12, 1.0, {'sigma': 0.02}),
    (40, 15.0, {'speed': 15.0, 'curvature': 0.01, 'time': 60.0}),
], ids=['robot_20', 'robot_60', 'car', 'fast_car', 'rtk', 'slow_errors'])
def test_the_sigma_is_honest(n: int, gap: float, arguments: dict) -> None:
    squares = []
    for seed in range(25):
        result = found(drive(seed, n, gap, **arguments), arguments.get('time', 0.0))
        if result.motion is not None:
            squares.append((result.error / result.sigma)**2)
    assert len(squares) > 21
    # 25 draws of chi2: 0.28 one sigma; with sigmas of at least 0.3 m RTK is better than that
    assert np.mean(squares) < 1.8
    assert np.mean(squares) > (0.0 if 'time' in arguments or 'sigma' in arguments else 0.3)


def test_correlated_errors_have_a_larger_sigma() -> None:
    some = drive(0, 100, 1.0)
    assert found(some, 30.0).sigma > found(some, 0.0).sigma


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
def test_two_fifths_may_be_wrong(kind: str, n: int, m: int, gap: float, arguments: dict) -> None:
    aligned = 0
    for seed in range(4):
        result = found(wrong(kind, drive(seed, n, gap, **arguments),
                             np.random.default_rng(seed), m))
        if result.motion is not None:
            aligned += 1
            assert result.error < max(0.2, 5.0 * result.sigma), seed
    assert aligned >= 3


def test_with_most_of_them_wrong_no_wrong_angle_is_found() -> None:
    for seed in range(5):
        some = wrong('scattered', drive(seed, 40, 2.0), np.random.default_rng(seed), 24)
        result = found(some)
        assert result.motion is None or result.error < 5.0 * result.sigma


# --- Positions that give no angle ------------------------------------------------------------

@pytest.mark.parametrize('sigma', [0.02, 1.0])
@pytest.mark.parametrize('kind', ['stands', 'frozen', 'crawls', 'mirrored'])
@pytest.mark.parametrize(('n', 'gap'), [(2, 20.0), (20, 3.0), (100, 3.0)])
def test_what_does_not_follow_the_robot_never_aligns(
    kind: str, n: int, gap: float, sigma: float,
) -> None:
    for seed in range(3):
        some = drive(seed, n, gap, sigma=sigma)
        if kind == 'mirrored' and np.ptp(np.unwrap(some.truth[:, 2])) < 2.0:
            continue    # so straight a drive does not show it
        true = some.truth[some.node, :2]
        noise = some.xy - true
        if kind == 'stands':
            jitter = 0.003 * np.random.default_rng(seed).standard_normal(some.odometry.shape)
            some = replace(some, odometry=jitter)
        elif kind == 'frozen':
            some = replace(some, xy=true[0] + noise)
        elif kind == 'crawls':
            some = replace(some, xy=true[0] + 0.1 * (true - true[0]) + noise)
        else:
            some = replace(some, xy=true * [-1.0, 1.0] + noise)
        assert found(some).motion is None, seed


def test_a_long_standstill_does_not_dominate_the_drive() -> None:
    some = drive(0, 12, 3.0)
    rng = np.random.default_rng(0)
    # a receiver that converges while the robot stands
    still = np.arange(60)
    xy = some.truth[0, :2] + [40.0, 10.0] + rng.standard_normal((60, 2))
    some = replace(
        some, truth=np.vstack((some.truth[0] + np.zeros((60, 3)), some.truth)),
        odometry=np.vstack((some.odometry[0] + np.zeros((60, 3)), some.odometry)),
        node=np.append(still, 60 + some.node), xy=np.vstack((xy, some.xy)))
    assert found(some).error < 0.3


@pytest.mark.parametrize('factor', [1.0, 2.0])
def test_positions_after_a_drive_that_drifted_by_radians_align(factor: float) -> None:
    worse = OdometryNoise(*(factor * getattr(NOISE, name) for name in (
        'sigma_distance', 'sigma_lateral', 'sigma_heading_distance', 'sigma_heading_turn')))
    for seed in range(2):
        some = drive(seed, 200, 30.0, speed=15.0, curvature=0.01, noise=worse)
        late = replace(some, node=some.node[-12:], xy=some.xy[-12:])
        # also all of them at once, after the drive
        for result in (found(late), found(some)):
            assert result.motion is not None
            assert result.error < 0.4


@pytest.mark.parametrize('scale', [0.8, 1.2])
@pytest.mark.parametrize('sigma', [0.1, 2.0])
def test_odometry_with_a_wrong_scale_aligns(scale: float, sigma: float) -> None:
    for seed in range(3):
        some = drive(seed, 20, 10.0, speed=10.0, sigma=sigma, curvature=0.01)
        steps = se2.between(some.odometry[:-1], some.odometry[1:]) * (scale, scale, 1.0)
        some = replace(some, odometry=np.vstack((
            some.odometry[:1], se2.composed(some.odometry[0], steps)[-len(steps):])))
        driven = Driven(some)
        queue = driven.queued(*some.positions)
        last, motion = next((end - 1, motion) for end in range(1, 21)   # as they come
                            if (motion := driven.find(queue[:end])) is not None)
        heading = motion[2] + driven.graph.poses_of(queue[last].nodes[0])[2]
        off = float(se2.wrap(heading - some.truth[some.node[last], 2]))
        assert abs(off) < max(0.2, 5.0 * driven.alignment.sigma)


def test_fixes_with_errors_eight_times_as_large_as_claimed_align() -> None:
    for seed in range(3):
        some = replace(drive(seed, 100, 2.0, sigma=4.0), sigma=0.5)
        result = found(some)
        assert result.motion is not None
        assert result.error < max(0.2, 5.0 * result.sigma)


# --- Headings --------------------------------------------------------------------------------

def test_one_global_pose_gives_the_angle_unless_its_heading_is_poor() -> None:
    some = drive(0, 6, 3.0, sigma=5.0)
    at = int(some.node[4])
    for sigma, is_known in ((0.1, True), (1.0, False)):
        driven = Driven(some)
        pose = GlobalPose(some.stamp_ns(at), some.truth[at], np.diag((1.0, 1.0, sigma**2)))
        motion = driven.find(driven.queued(pose, source='global_pose'))
        assert (motion is not None) is is_known
        if motion is not None:
            assert driven.alignment.sigma == pytest.approx(0.1)
            placed, = driven.queued(pose)
            np.testing.assert_allclose(se2.compose(se2.compose(
                motion, driven.graph.poses_of(placed.nodes[0])), placed.factor.offset[0]),
                some.truth[at], atol=1e-9)


@pytest.mark.parametrize('at', [0, 3])
def test_a_certain_heading_and_one_position_are_enough(at: int) -> None:
    some = drive(1, 6, 3.0, sigma=0.01)
    driven = Driven(some)
    compass = [HeadingOnly(some.stamp_ns(at), float(some.truth[at, 2]), variance)
               for variance in (1e-4, 4e-4)]
    queue = driven.queued(*compass, source='compass') + driven.queued(some.positions[0])
    motion = driven.find(queue)
    assert driven.alignment.sigma == pytest.approx(0.01)    # of the better one
    first = se2.compose(motion, driven.graph.poses[0])
    np.testing.assert_allclose(first[:2], some.truth[0, :2], atol=0.1)


# --- In the engine ---------------------------------------------------------------------------

def test_the_state_goes_from_local_over_unaligned_to_aligned_once() -> None:
    some = drive(0, 20, 2.0)
    driven = Driven(some)
    queue, alignment = driven.queued(*some.positions), driven.alignment
    assert (alignment.state, alignment.sigma) == (AlignmentState.LOCAL, np.inf)
    assert driven.find([]) is None
    assert alignment.state is AlignmentState.LOCAL
    assert driven.find(queue[:1]) is None
    assert alignment.state is AlignmentState.UNALIGNED
    # nodes that have left are no reason to begin anew
    alignment.forget()
    assert driven.find(queue) is not None
    assert alignment.is_aligned
    assert 0.0 < alignment.sigma < 0.3
    assert driven.find(queue) is None


def test_what_waits_is_looked_at_once_although_an_update_tries_parts_of_it() -> None:
    some = drive(0, 8, 0.5)
    driven = Driven(some)
    queue = driven.queued(*some.positions)
    for part in (queue, queue[:4], queue[4:], queue):
        assert driven.find(part) is None
    assert {len(bank) for bank in driven.alignment._banks.values()} == {len(queue)}


@pytest.mark.parametrize('n_wrong', [0, 12])
def test_an_angle_that_the_first_fixes_told_stays_unless_they_were_wrong(n_wrong: int) -> None:
    done_over = 0
    for seed in range(4):
        some = drive(seed, 60, 3.0, sigma=0.3)
        # as if the robot had started elsewhere, in another direction
        turned = se2.compose(some.truth[0] + [20.0, 5.0, 2.0], se2.between(
            some.truth[0], some.truth))[:, :2]
        xy = np.where(np.arange(60)[:, None] < n_wrong, turned[some.node], some.xy)
        backend, fixes = PoseGraphBackend(), replace(some, xy=xy).positions
        for node, pose in enumerate(some.odometry):
            backend.add_odometry(OdometrySample(some.stamp_ns(node), pose))
            while fixes and fixes[0].stamp_ns <= some.stamp_ns(node):
                backend.add_measurement(fixes.pop(0), 'fix')
                assert backend.update().reason == ''
        newest = backend.estimate()
        assert abs(se2.wrap(newest.T_map_base[2] - some.truth[-1, 2])) < 0.3
        assert np.hypot(*(newest.T_map_base - some.truth[-1])[:2]) < 3.0
        done_over += backend.counts['alignment', 'done_over']
    assert done_over == 0 or n_wrong > 0


def test_a_saved_graph_that_is_not_aligned_is_aligned_by_what_has_waited() -> None:
    some = drive(3, 20, 3.0)
    backend = PoseGraphBackend()
    for node, pose in enumerate(some.odometry):
        backend.add_odometry(OdometrySample(some.stamp_ns(node), pose))
    for fix in some.positions[:3]:
        backend.add_measurement(fix, 'fix')
        backend.update()
    assert backend.estimate().alignment is AlignmentState.UNALIGNED
    again = PoseGraphBackend.restored(None, backend.saved())
    for each in (backend, again):
        for fix in some.positions[3:-1]:
            each.add_measurement(fix, 'fix')
        each.update()
        assert each.estimate().alignment is AlignmentState.ALIGNED
    np.testing.assert_allclose(again.graph.poses, backend.graph.poses, atol=1e-6)


def test_what_waits_for_days_takes_no_more_memory_than_what_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr('pose_graph_ros.core.alignment.SOURCES', SOURCES._replace(
        most_unaligned=100))
    some = drive(0, 400, 1.0)
    xy = np.where(np.arange(400)[:, None] < 250, some.xy[0], some.xy)   # frozen at first
    driven = Driven(some)
    queue = driven.queued(*replace(some, xy=xy).positions)
    ends = range(1, 401, 9)
    motions = [driven.find(queue[max(end - 100, 0):end]) for end in ends]
    assert all(len(bank) < 200 for bank in driven.alignment._banks.values())
    assert len(driven.alignment._seen) <= 100
    # until the receiver follows the robot
    known = [end for end, motion in zip(ends, motions, strict=True) if motion is not None]
    assert 250 < known[0] < 370
