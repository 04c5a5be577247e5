# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Odometry by stamp, compared with a slow walk from sample to sample."""

from fractions import Fraction
from itertools import pairwise

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_graphs import matrix, random_poses, vector

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.odometry.timeline import next_row, OdometryTimeline

SECOND = 1_000_000_000
# Sums of tens of lengths of some 10 m.
ROUNDING = 1e-11
# The Unix time of 2026 in nanoseconds: a double does not hold it.
EPOCH = 1_767_225_600_000_000_001

stamp_lists = st.lists(st.integers(0, 3_000_000_000), min_size=1, max_size=12, unique=True).map(
    lambda stamps: [EPOCH + stamp for stamp in sorted(stamps)])


def append(timeline: OdometryTimeline, stamp: int, pose: FloatArray) -> None:
    timeline.append(next_row(timeline._last, stamp, tuple(pose.tolist())))


def filled(stamps: list[int], poses: FloatArray) -> OdometryTimeline:
    timeline = OdometryTimeline()
    for stamp, pose in zip(stamps, poses, strict=True):
        append(timeline, stamp, pose)
    return timeline


def slow_pose(stamps: list[int], poses: FloatArray, at: int) -> FloatArray:
    for k, stamp in enumerate(stamps):
        if stamp == at:
            return poses[k]
        if stamp > at:
            fraction = float(Fraction(at - stamps[k - 1], stamp - stamps[k - 1]))
            turn = np.angle(np.exp(1j * (poses[k, 2] - poses[k - 1, 2])))
            pose = poses[k - 1] + fraction * (poses[k] - poses[k - 1])
            pose[2] = poses[k - 1, 2] + fraction * turn
            return pose
    raise AssertionError


def slow_travel(stamps: list[int], poses: FloatArray, start: int, end: int) -> tuple:
    """Walk through all samples in between."""
    at = [start, *(s for s in stamps if start < s < end), end]
    walk = [slow_pose(stamps, poses, stamp) for stamp in at]
    distance = turn = 0.0
    for a, b in pairwise(walk):
        distance += np.hypot(*(b - a)[:2])
        turn += abs(np.angle(np.exp(1j * (b[2] - a[2]))))
    return distance, turn


@given(st.data())
def test_motion_is_that_of_a_slow_walk(data: st.DataObject) -> None:
    stamps = data.draw(stamp_lists)
    poses = random_poses(np.random.default_rng(data.draw(st.integers(0, 999))), len(stamps))
    timeline = filled(stamps, poses)
    start, end = sorted(data.draw(st.tuples(*2 * (st.integers(stamps[0], stamps[-1]),))))
    motion = timeline.motion(start, end)
    a, b = (slow_pose(stamps, poses, stamp) for stamp in (start, end))
    expected = vector(np.linalg.inv(matrix(a)) @ matrix(b))
    np.testing.assert_allclose(motion.increment[:2], expected[:2], atol=ROUNDING)
    assert abs(se2.wrap(motion.increment[2] - expected[2])) < ROUNDING
    distance, turn = slow_travel(stamps, poses, start, end)
    assert motion.distance == pytest.approx(distance, abs=ROUNDING)
    assert motion.turn == pytest.approx(turn, abs=ROUNDING)
    np.testing.assert_allclose(timeline.pose(end)[:2], b[:2], atol=ROUNDING)


def test_instants_that_are_not_covered_are_rejected() -> None:
    timeline = OdometryTimeline()
    assert len(timeline) == 0
    assert not timeline.covers(5)
    timeline = filled([10, 20], np.zeros((2, 3)))
    assert [timeline.covers(stamp) for stamp in (9, 10, 15, 20, 21)] == [
        False, True, True, True, False]
    for stamp in (9, 21):
        with pytest.raises(ValueError, match=str(stamp)):
            timeline.pose(stamp)
    with pytest.raises(ValueError, match='start <= end, got 20 and 10'):
        timeline.motion(20, 10)


def test_jitter_at_rest_is_no_path() -> None:
    rng = np.random.default_rng(1)
    n = 30_000     # ten minutes at 50 Hz, 2 mm and 2 mrad
    poses = np.clip(rng.normal(0.0, 0.002, (n, 3)), -0.004, 0.004)
    timeline = filled([20_000_000 * (k + 1) for k in range(n)], poses)
    motion = timeline.motion(20_000_000, 20_000_000 * n)
    assert motion.distance < 0.02
    assert motion.turn < 0.02


# --- Variances, gaps and rest ----------------------------------------------------------------

@given(st.data())
def test_variances_are_those_of_a_slow_walk(data: st.DataObject) -> None:
    stamps = data.draw(stamp_lists)
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    poses, row = random_poses(rng, len(stamps)), None
    steps, loose = rng.uniform(0.0, 1.0, (2, len(stamps), 3))
    timeline = OdometryTimeline()
    for stamp, pose, step, jump in zip(stamps, poses, steps, loose, strict=True):
        row = next_row(row, stamp, tuple(pose), tuple(step), tuple(jump))
        timeline.append(row)
    a, b = sorted(data.draw(st.tuples(*2 * (st.sampled_from(range(len(stamps))),))))
    motion = timeline.motion(stamps[a], stamps[b])
    np.testing.assert_allclose(
        motion.variance, np.sum((steps + loose)[a + 1:b + 1], axis=0), atol=ROUNDING)
    # between samples: their fraction, and the variance of interpolation
    if a < b:
        middle = (stamps[b - 1] + stamps[b]) // 2
        fraction = (middle - stamps[b - 1]) / (stamps[b] - stamps[b - 1])
        part = timeline.motion(stamps[b - 1], middle).variance - fraction * (steps + loose)[b]
        time = (stamps[b] - stamps[b - 1]) * 1e-9
        bend = 0.5 * fraction * (1.0 - fraction) * time**2
        assert np.all(part >= -ROUNDING)
        assert np.all(part <= (np.array([1.0, 1.0, 0.5]) * bend)**2 + ROUNDING)
        way = timeline.motion(stamps[b - 1], stamps[b])
        assert np.all(part <= np.array([way.distance, way.distance, way.turn])**2 + ROUNDING)


def test_the_noise_contains_the_effect_of_an_acceleration_between_samples() -> None:
    for rate in (1, 5, 20):
        times = np.arange(0.0, 4.0, 1.0 / rate)
        poses = np.column_stack((0.5 * times**2, np.zeros_like(times), np.zeros_like(times)))
        timeline = filled([EPOCH + round(t * 1e9) for t in times.tolist()], poses)
        for t in np.linspace(0.0, times[-1], 97).tolist():
            stamp = EPOCH + round(t * 1e9)
            motion = timeline.motion(EPOCH, stamp)
            off = abs(motion.increment[0] - 0.5 * t**2)
            assert off <= np.sqrt(motion.variance[0]) + 1e-3     # less is jitter


@pytest.mark.parametrize('hold', [5, 300])
def test_rest_is_covered_closely_but_not_a_gap_in_it(hold: int) -> None:
    timeline, stamps = OdometryTimeline(), [SECOND * k // 10 for k in range(1, hold)]
    gap = stamps[-1] + 3 * SECOND
    for stamp in (*stamps, gap, *(gap + stamp for stamp in stamps)):
        append(timeline, stamp, np.ones(3))
    assert len(timeline) == 4
    for stamp in stamps[1:]:
        assert timeline.covers(stamp - 7, closely=True)
        assert timeline.covers(gap + stamp - 7, closely=True)
    for stamp in (stamps[-1] + 1, gap - 1):
        assert timeline.covers(stamp)
        assert not timeline.covers(stamp, closely=True)
    assert timeline.covers(gap, closely=True)


@given(st.lists(st.tuples(st.integers(1, 2_000_000_000), st.sampled_from((0, 0, 1))),
                min_size=1, max_size=40), st.data())
def test_thinning_changes_nothing_at_the_instants_that_matter_and_after(
    steps: list[tuple[int, int]], data: st.DataObject,
) -> None:
    whole, stamp, pose, row = OdometryTimeline(), EPOCH, np.zeros(3), None
    rows = []
    for wait, moves in steps:
        stamp += wait
        pose = se2.compose(pose, moves * np.array([0.7, 0.1, 0.3]))
        row = next_row(row, stamp, tuple(pose.tolist()), (0.01, 0.02, 0.03))
        rows.append(row)
    n_before = data.draw(st.integers(1, len(rows)))
    for row in rows[:n_before]:
        whole.append(row)
    first, last = rows[0].stamp_ns, rows[n_before - 1].stamp_ns
    instants = np.array(sorted(data.draw(
        st.lists(st.integers(first, last), min_size=1, max_size=5, unique=True))))
    since = data.draw(st.integers(int(instants[-1]), last + 5))
    thinned = OdometryTimeline()
    thinned.restore(*whole.thinned(instants, since), rows[n_before - 1], resting=whole.resting)
    for row in rows[n_before:]:
        whole.append(row)
        thinned.append(row)
    assert len(thinned) <= len(whole)
    after = [stamp for stamp in whole.stamps_ns.tolist() if stamp >= since]
    exact = [*instants.tolist(), *after, *[stamp - 1 for stamp in after[1:]]]
    for start in exact:
        assert thinned.covers(start, closely=True) == whole.covers(start, closely=True)
        for end in exact:
            if start <= end:
                for one, other in zip(
                        thinned.motion(start, end), whole.motion(start, end), strict=True):
                    np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(thinned.poses[0], whole.poses[0])
