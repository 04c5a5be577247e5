# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""One source of odometry: samples sorted by stamp, jumps removed, noise."""

from collections.abc import Callable
import math

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.config import Integrate, NoiseFrom, OdometryNoise, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import AnswerStatus, OdometrySample
from pose_graph_ros.core.odometry.motion import JUMP_SIGMA
from pose_graph_ros.core.odometry.stream import MANY_BEHIND, OdometryStream

SECOND = 1_000_000_000
# The Unix time of 2026 in nanoseconds: a double does not hold it.
EPOCH = 1_767_225_600_000_000_001
# Sums of tens of lengths of some 10 m.
ROUNDING = 1e-11

Speeds = Callable[[FloatArray], FloatArray]


def drive(
    times: FloatArray, speed: Speeds, turn_rate: Speeds = np.zeros_like,
) -> list[OdometrySample]:
    """Integrate a speed [m/s] and a turn rate [rad/s] finely; sample it at times [s]."""
    fine = np.linspace(times[0], times[-1], 20_000)
    dt = np.diff(fine, prepend=fine[0])
    theta = np.cumsum(turn_rate(fine) * dt)
    x, y = np.cumsum(speed(fine) * np.cos(theta) * dt), np.cumsum(speed(fine) * np.sin(theta) * dt)
    poses = np.column_stack([np.interp(times, fine, values) for values in (x, y, theta)])
    return [OdometrySample(EPOCH + round(t * 1e9), pose)
            for t, pose in zip(times.tolist(), poses, strict=True)]


def steady(value: float) -> Speeds:
    return lambda times: np.full_like(times, value)


def settled(samples: list[OdometrySample], **settings_: object) -> OdometryStream:
    stream = OdometryStream(OdometrySource(**settings_))
    for sample in samples:
        assert stream.add(sample).status is AnswerStatus.ACCEPTED
        for _ in stream.settle():
            pass
    for _ in stream.settle(stream.newest_ns):
        pass
    assert stream.settled_ns == stream.newest_ns == max(sample.stamp_ns for sample in samples)
    return stream


def contents(stream: OdometryStream) -> tuple[bytes, ...]:
    timeline = stream.timeline
    return (timeline.stamps_ns.tobytes(), timeline.poses.tobytes(),
            timeline._samples.values.tobytes(), timeline._dense.values.tobytes())


# --- Order of arrival ------------------------------------------------------------------------

WIGGLE = drive(np.arange(120) * 0.05, steady(2.0), lambda t: 0.4 * np.sin(t))
WIGGLE[60:] = [OdometrySample(one.stamp_ns, one.pose - WIGGLE[60].pose) for one in WIGGLE[60:]]


@given(st.data())
def test_samples_shuffled_within_the_window_give_the_same_bits(data: st.DataObject) -> None:
    delays = data.draw(st.lists(
        st.integers(0, SECOND // 4 - 1), min_size=len(WIGGLE), max_size=len(WIGGLE)))
    twice = data.draw(st.sets(st.integers(0, len(WIGGLE) - 1)))
    arrivals = sorted(
        [(one.stamp_ns + delay, k) for k, (one, delay) in enumerate(
            zip(WIGGLE, delays, strict=True))]
        + [(WIGGLE[k].stamp_ns + delays[k] + 1, k) for k in twice])
    stream, duplicates = OdometryStream(OdometrySource()), 0
    for _, k in arrivals:
        answer = stream.add(WIGGLE[k])
        duplicates += answer.reason == 'duplicate_stamp'
        assert answer.reason in ('', 'duplicate_stamp')
        for _ in stream.settle():
            pass
    for _ in stream.settle(stream.newest_ns):
        pass
    in_order = settled(WIGGLE)
    assert duplicates == len(twice)
    assert stream.n_jumps == in_order.n_jumps == 1
    assert contents(stream) == contents(in_order)


def test_late_samples_and_duplicates_have_different_reasons() -> None:
    stream = settled(WIGGLE)
    assert stream.add(WIGGLE[7]).reason == 'duplicate_stamp'
    assert stream.add(OdometrySample(WIGGLE[7].stamp_ns + 1, np.zeros(3))).reason == 'out_of_order'
    assert stream.add(OdometrySample(EPOCH - 1, np.zeros(3))).reason == 'out_of_order'


def test_a_stamp_far_ahead_does_not_stop_the_source() -> None:
    stream = OdometryStream(OdometrySource())
    for k, sample in enumerate(WIGGLE[:50]):
        if k == 20:
            ahead = OdometrySample(sample.stamp_ns + 86_400 * SECOND, sample.pose)
            assert stream.add(ahead).status is AnswerStatus.ACCEPTED
        assert stream.add(sample).status is AnswerStatus.ACCEPTED
        for _ in stream.settle():
            pass
    assert stream.n_dropped == 1
    assert stream.newest_ns == WIGGLE[49].stamp_ns
    assert contents(settled(WIGGLE[:50]))[1][:30 * 24] == contents(stream)[1][:30 * 24]


@pytest.mark.parametrize('gap', [2, 600])
def test_a_pause_is_no_stamp_far_ahead(gap: int) -> None:
    samples = [OdometrySample(EPOCH + (k + (gap * 20 if k >= 30 else 0)) * SECOND // 20,
                              np.array([0.05 * k, 0.0, 0.0])) for k in range(60)]
    stream = settled(samples)
    assert len(stream.timeline) == 60
    assert stream.n_dropped == stream.n_jumps == 0
    assert MANY_BEHIND < 10     # (a source with 1 Hz is used again within seconds)


@given(st.integers(0, 119), st.integers(0, 119), st.sampled_from(NoiseFrom))
def test_the_newest_motion_is_what_settling_would_make_of_it(
    known: int, since: int, noise_from: NoiseFrom,
) -> None:
    rng = np.random.default_rng(known)
    samples = [OdometrySample(one.stamp_ns, one.pose, 0.0, rng.uniform(0.0, 0.1, 3))
               for one in WIGGLE[:known + 1]]
    stream = OdometryStream(OdometrySource(noise_from=noise_from))
    for index in rng.permutation(len(samples)):
        stream.add(samples[index])
    since = min(since, known)
    for _ in stream.settle(samples[since].stamp_ns):
        pass
    for start_ns in (samples[0].stamp_ns, (samples[0].stamp_ns + samples[since].stamp_ns) // 2):
        ahead, raw = stream.newest(start_ns)
        between_ns = (samples[-2:][0].stamp_ns + samples[-1].stamp_ns) // 2
        early = stream.motion_ahead(start_ns, between_ns)
        jumps = stream.n_jumps_seen
        for _ in stream.settle(stream.newest_ns):
            pass
        assert stream.n_jumps == stream.n_jumps_seen == jumps
        after, _ = stream.newest(start_ns)
        motion = stream.timeline.motion(start_ns, samples[-1].stamp_ns)
        pairs = [(ahead, motion), (after, motion)]
        if early is not None:
            pairs.append((early, stream.timeline.motion(start_ns, between_ns)))
        for one, motion in pairs:
            np.testing.assert_allclose(one.increment, motion.increment, atol=ROUNDING)
            assert one.distance == pytest.approx(motion.distance, abs=ROUNDING)
            assert one.turn == pytest.approx(motion.turn, abs=ROUNDING)
            np.testing.assert_allclose(one.variance, motion.variance, atol=ROUNDING)
        np.testing.assert_array_equal(raw, se2.wrapped(samples[-1].pose))


# --- Jumps -----------------------------------------------------------------------------------

def jumps(samples: list[OdometrySample]) -> int:
    return settled(samples).n_jumps


def reset(samples: list[OdometrySample], at: int) -> list[OdometrySample]:
    """Let odometry begin anew at a sample."""
    return samples[:at] + [OdometrySample(one.stamp_ns, se2.between(samples[at].pose, one.pose))
                           for one in samples[at:]]


RATES = [5, 10, 50, 200]


@pytest.mark.parametrize('rate', RATES)
@pytest.mark.parametrize('speed', [1.0, 30.0])
def test_a_reset_in_mid_drive_is_a_jump(rate: int, speed: float) -> None:
    samples = drive(np.arange(20 * rate) / rate, steady(speed), lambda t: 0.2 * np.sin(0.3 * t))
    at = 12 * rate
    whole, broken = settled(samples), settled(reset(samples, at))
    assert (whole.n_jumps, broken.n_jumps) == (0, 1)
    # only the motion of the jump itself is unknown
    start, jump, end = (samples[k].stamp_ns for k in (at - 1, at, -1))
    motion = broken.timeline.motion(jump, end)
    np.testing.assert_allclose(
        motion.increment, whole.timeline.motion(jump, end).increment, atol=1e-9)
    np.testing.assert_array_equal(motion.variance, 0.0)
    lost = broken.timeline.motion(start, jump)
    off = lost.increment - whole.timeline.motion(start, jump).increment
    sigma = np.sqrt(lost.variance)
    assert np.all(np.abs(off) < sigma)
    assert np.all(sigma >= (JUMP_SIGMA[0], JUMP_SIGMA[0], JUMP_SIGMA[1]))
    assert np.all(sigma < (1.0 + speed / rate, 1.0 + speed / rate, 0.5))


@pytest.mark.parametrize('rate', RATES)
def test_a_single_sample_that_is_off_leaves_no_trace_but_noise(rate: int) -> None:
    samples = drive(np.arange(10 * rate) / rate, steady(2.0))
    off = list(samples)
    off[5 * rate] = OdometrySample(off[5 * rate].stamp_ns, np.array([500.0, -300.0, 1.0]))
    stream = settled(off)
    assert stream.n_jumps == 2
    motion = stream.timeline.motion(samples[0].stamp_ns, samples[-1].stamp_ns)
    np.testing.assert_allclose(motion.increment, samples[-1].pose, atol=1e-6)


QUICK = {
    'full throttle': (lambda t: np.minimum(10.0 * t, 50.0), np.zeros_like),
    'full throttle after a while': (
        lambda t: np.clip(10.0 * (t - 4.0), 0.0, 40.0), np.zeros_like),
    'emergency braking': (lambda t: np.maximum(30.0 - 10.0 * t, 0.0), np.zeros_like),
    'a mower turns on the spot': (
        lambda t: 1.0 * (t % 4.0 < 2.0), lambda t: 2.0 * (t % 4.0 > 2.0)),
    'a mower turns on the spot and stops dead': (
        lambda t: 1.0 * (t % 2.0 < 1.0), lambda t: 3.0 * np.sign(np.sin(2.0 * t))),
    'shuttling': (lambda t: 2.0 * np.sign(np.sin(3.0 * t)), np.zeros_like),
    'a slalom': (steady(15.0), lambda t: 0.6 * np.sin(3.0 * t)),
    'it begins at 30 m/s': (steady(30.0), steady(0.1)),
}


@pytest.mark.parametrize('rate', RATES)
@pytest.mark.parametrize('name', QUICK)
def test_what_a_robot_can_do_is_no_jump(name: str, rate: int) -> None:
    assert jumps(drive(np.arange(8 * rate) / rate, *QUICK[name])) == 0


# --- Noise -----------------------------------------------------------------------------------

TWIST = {'noise_from': NoiseFrom.TWIST}


@given(st.integers(0, 10**6), st.floats(0.1, 10.0))
def test_the_noise_of_twists_is_the_sum_of_covariance_times_time(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 0.3, 60))
    variances = rng.uniform(1e-6, 0.1, (60, 3))
    samples = [OdometrySample(one.stamp_ns, one.pose, 2.0, variance) for one, variance in zip(
        drive(times, steady(2.0)), variances, strict=True)]
    stream = settled(samples, covariance_scale=scale, **TWIST)
    a, b = np.sort(rng.integers(0, 60, 2))
    motion = stream.timeline.motion(samples[a].stamp_ns, samples[b].stamp_ns)
    dt = np.diff([sample.stamp_ns - EPOCH for sample in samples]) * 1e-9
    expected = np.sum(variances[a + 1:b + 1] * dt[a:b, None], axis=0)
    np.testing.assert_allclose(motion.variance, expected, rtol=1e-6, atol=1e-12)
    cov = stream.covariance(motion, floor=False)
    length = motion.increment[0]
    assert cov[0, 0] == pytest.approx(scale * expected[0], rel=1e-6, abs=1e-12)
    assert cov[1, 1] == pytest.approx(
        scale * (expected[1] + expected[2] * length**2 / 3.0), rel=1e-6, abs=1e-12)
    assert cov[2, 2] == pytest.approx(scale * expected[2], rel=1e-6, abs=1e-12)


@pytest.mark.parametrize('jitter', [0.0, 0.002])
def test_a_robot_that_stands_adds_no_noise(jitter: float) -> None:
    rng = np.random.default_rng(1)
    poses = np.array([3.0, 4.0, 0.5]) + np.clip(rng.normal(0.0, jitter, (6000, 3)), -0.004, 0.004)
    samples = [OdometrySample(EPOCH + k * SECOND // 50, pose, 0.0, np.array([0.1, 0.1, 0.1]))
               for k, pose in enumerate(poses)]
    stream = settled(samples, **TWIST)
    motion = stream.timeline.motion(samples[0].stamp_ns, samples[-1].stamp_ns)
    np.testing.assert_array_equal(motion.variance, 0.0)
    # it has stood for two minutes: what begins to move is a second's worth at the most
    start = EPOCH + 6000 * SECOND // 50
    for k in range(10):
        stream.add(OdometrySample(start + k * SECOND // 50, np.array([3.0 + 0.02 * k, 4.0, 0.5]),
                                  1.0, np.array([0.1, 0.1, 0.1])))
    for _ in stream.settle(stream.newest_ns):
        pass
    motion = stream.timeline.motion(samples[0].stamp_ns, stream.settled_ns)
    assert np.all(motion.variance <= 0.1 * 1.3)
    assert np.all(motion.variance >= 0.1 * 0.15)


@pytest.mark.parametrize('broken', [0.0, -1.0, np.nan, np.inf, 1e9])
def test_an_invalid_variance_of_a_twist_is_replaced_by_the_model(broken: float) -> None:
    noise, good = OdometryNoise(sigma_lateral=0.07), np.array([0.01, broken, 0.02])
    samples = [OdometrySample(one.stamp_ns, one.pose, 2.0, good)
               for one in drive(np.arange(50) * 0.1, steady(2.0))]
    motion = settled(samples, noise=noise, **TWIST).timeline.motion(
        samples[0].stamp_ns, samples[-1].stamp_ns)
    np.testing.assert_allclose(
        motion.variance, [0.01 * 4.9, 0.07**2 * motion.distance, 0.02 * 4.9], rtol=1e-6)


# --- Memory ----------------------------------------------------------------------------------


@settings(max_examples=20)
@given(st.data())
def test_leaving_out_samples_at_rest_changes_nothing(data: st.DataObject) -> None:
    whens = data.draw(st.lists(st.booleans(), min_size=2, max_size=30))
    samples, pose = [], np.zeros(3)
    for moves in whens:
        for _ in range(7):
            pose = se2.compose(pose, np.array([0.3, 0.0, 0.1])) if moves else pose
            samples.append(OdometrySample(EPOCH + len(samples) * SECOND // 10, pose.copy()))
    stream = settled(samples)
    assert len(stream.timeline) <= 7 * sum(whens) + 2 * (len(whens) - sum(whens)) + 1
    for sample in samples:
        np.testing.assert_array_equal(stream.timeline.pose(sample.stamp_ns), sample.pose)
        assert stream.timeline.covers(sample.stamp_ns, closely=True)
        assert stream.add(sample).reason == 'duplicate_stamp'
    for _ in range(20):
        a, b = sorted(data.draw(st.tuples(*2 * (st.integers(0, len(samples) - 1),))))
        motion = stream.timeline.motion(samples[a].stamp_ns, samples[b].stamp_ns)
        walk = np.array([one.pose for one in samples[a:b + 1]])
        assert motion.distance == pytest.approx(
            np.sum(np.hypot(*np.diff(walk[:, :2], axis=0).T)), abs=ROUNDING)
        np.testing.assert_array_equal(motion.variance, 0.0)


def by_twist(times: FloatArray, twist: tuple[float, float, float]) -> list[OdometrySample]:
    """Samples of a constant twist whose poses mean nothing."""
    return [OdometrySample(EPOCH + round(t * 1e9), np.array((50.0 * (k % 2), 0.0, 0.0)),
                           twist=twist) for k, t in enumerate(times.tolist())]


def test_a_gap_between_twists_is_an_uncertain_motion() -> None:
    times = np.array([0.0, 0.5, 1.0, 3.5, 4.0])
    stream = settled(by_twist(times, (1.0, 0.0, 0.0)), integrate=Integrate.TWIST)
    assert stream.n_jumps == 1
    motion = stream.timeline.motion(EPOCH + SECOND, EPOCH + 7 * SECOND // 2)
    assert motion.variance[0] > JUMP_SIGMA[0]**2
    assert stream.timeline.motion(EPOCH, EPOCH + SECOND).variance[0] == 0.0


@pytest.mark.parametrize(('twist', 'reason'), [
    ((math.nan, 0.0, 0.0), 'not_finite'), ((0.0, 0.0, math.inf), 'not_finite'),
    ((1e5, 0.0, 0.0), 'too_large')])
def test_a_bad_twist_is_rejected(twist: tuple[float, float, float], reason: str) -> None:
    answer = OdometryStream(OdometrySource(integrate=Integrate.TWIST)).add(
        OdometrySample(EPOCH, np.zeros(3), twist=twist))
    assert answer.reason == reason


def test_a_saved_stream_of_twists_continues_bit_for_bit() -> None:
    times = np.arange(0.0, 3.0, 0.02)
    samples = [OdometrySample(EPOCH + round(t * 1e9), np.zeros(3), twist=(
        1.0, 0.0, math.sin(t))) for t in times.tolist()]
    whole = settled(samples, integrate=Integrate.TWIST)
    first = OdometryStream(OdometrySource(integrate=Integrate.TWIST))
    for sample in samples[:100]:
        first.add(sample)
    for _ in first.settle():
        pass
    second = OdometryStream(OdometrySource(integrate=Integrate.TWIST))
    second.restore(first.saved(np.array([EPOCH])))
    for sample in samples[100:]:
        second.add(sample)
    for _ in second.settle(second.newest_ns):
        pass
    assert second.timeline.poses[-1].tobytes() == whole.timeline.poses[-1].tobytes()


@given(st.floats(-3.0, 3.0), st.floats(-1.0, 1.0), st.floats(-2.0, 2.0) | st.just(0.0))
@settings(max_examples=30, deadline=None)
def test_a_constant_twist_is_integrated_exactly(vx: float, vy: float, rate: float) -> None:
    times = np.array([0.0, 0.1, 0.35, 0.4, 0.9, 1.0])
    stream = settled(by_twist(times, (vx, vy, rate)), integrate=Integrate.TWIST)
    motion = stream.timeline.motion(EPOCH, EPOCH + SECOND).increment
    # the differential equation in small steps, by the midpoint rule
    h = 1e-4
    theta = (np.arange(10_000) + 0.5) * h * rate
    expected = (np.sum(vx * np.cos(theta) - vy * np.sin(theta)) * h,
                np.sum(vx * np.sin(theta) + vy * np.cos(theta)) * h, rate)
    assert motion == pytest.approx(expected, abs=1e-8)
