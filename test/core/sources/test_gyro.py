# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Yaw rates by stamp, and their integral against a fine numerical one."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.config import GyroSource, RateNoise
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.measurements import AnswerStatus, YawRate
from pose_graph_ros.core.sources.gyro import GyroStream, UNIFORM_WITHIN

SECOND = 1_000_000_000
EPOCH = 1_767_225_600_000_000_001
QUIET = GyroSource(sigma_rate=1e-3, sigma_turn=1e-12)


def samples(times: FloatArray, rates: FloatArray, variance: float = 0.0) -> list[YawRate]:
    return [YawRate(EPOCH + round(time * 1e9), rate, variance)
            for time, rate in zip(times.tolist(), rates.tolist(), strict=True)]


def filled(given_: list[YawRate], source: GyroSource = QUIET) -> GyroStream:
    stream = GyroStream(source)
    for sample in given_:
        assert stream.add(sample).status is AnswerStatus.ACCEPTED
    stream.settle()
    return stream


@given(st.lists(st.tuples(st.floats(0.002, 0.24), st.floats(-3.0, 3.0)), min_size=3, max_size=30),
       st.floats(0.0, 0.45), st.floats(0.55, 1.0))
@settings(max_examples=60, deadline=None)
def test_the_integral_is_that_of_the_polygon(
    steps: list[tuple[float, float]], begin: float, end: float,
) -> None:
    times = np.cumsum([step for step, _ in steps])
    rates = np.array([rate for _, rate in steps])
    start, stop = (times[0] + share * (times[-1] - times[0]) for share in (begin, end))
    start_ns, stop_ns = EPOCH + round(start * 1e9), EPOCH + round(stop * 1e9)
    integral = filled(samples(times, rates)).integral(start_ns, stop_ns)
    assert integral is not None
    fine = np.union1d(np.linspace(start, stop, 20_001), times[(times > start) & (times < stop)])
    expected = np.trapezoid(np.interp(fine, times, rates), fine)
    rotation = integral.between(start_ns, stop_ns)
    assert rotation.angle == pytest.approx(expected, abs=1e-7)
    assert rotation.seconds == pytest.approx(stop - start, abs=1e-8)


def test_a_smooth_rate_is_integrated_within_its_sigma_of_interpolation() -> None:
    times = np.arange(0.0, 10.0, 0.2)
    rates = 0.4 * np.sin(1.1 * times)
    integral = filled(samples(times, rates), GyroSource(sigma_rate=1e-9, sigma_turn=0.0)).integral(
        EPOCH + 300_000_001, EPOCH + 9_000_000_000)
    assert integral is not None
    rotation = integral.between(EPOCH + 300_000_001, EPOCH + 9_000_000_000)
    truth = 0.4 / 1.1 * (math.cos(1.1 * 0.3) - math.cos(1.1 * 9.0))
    assert abs(rotation.angle - truth) < 3.0 * math.sqrt(rotation.variance)
    assert math.sqrt(rotation.variance) < UNIFORM_WITHIN * 0.2**2 / 12.0 * math.sqrt(44)


def test_the_noise_is_that_of_independent_samples_or_of_the_model() -> None:
    generator = np.random.default_rng(3)
    times, sigma = np.arange(0.0, 2.0, 0.01), 0.02
    ends = EPOCH + 3_000_000, EPOCH + 1_500_000_000
    angles = []
    for _ in range(400):
        noise = generator.normal(0.0, sigma, len(times))
        integral = filled(samples(times, noise, sigma**2), QUIET).integral(*ends)
        assert integral is not None
        rotation = integral.between(*ends)
        angles.append(rotation.angle / math.sqrt(rotation.variance))
    assert np.std(angles) == pytest.approx(1.0, abs=0.12)
    by_model = GyroSource(sigma_rate=0.002, noise_from=RateNoise.MODEL, sigma_turn=0.0)
    for source, of_message in ((by_model, sigma**2), (QUIET, 0.0)):
        integral = filled(samples(times, 0.0 * times, of_message), source).integral(*ends)
        assert integral is not None
        assert integral.between(*ends).variance == pytest.approx(source.sigma_rate**2 * 1.497)


def test_a_gap_breaks_the_integral() -> None:
    times = np.concatenate((np.arange(0.0, 1.0, 0.01), np.arange(1.3, 2.0, 0.01)))
    stream = filled(samples(times, 0.0 * times))
    assert stream.integral(EPOCH + 10, EPOCH + 900_000_000) is not None
    assert stream.integral(EPOCH + 1_400_000_000, EPOCH + 1_900_000_000) is not None
    assert stream.integral(EPOCH + 900_000_000, EPOCH + 1_400_000_000) is None
    assert stream.integral(EPOCH - 10, EPOCH + 900_000_000) is None
    assert stream.integral(EPOCH + 1_400_000_000, EPOCH + 2_100_000_000) is None


@pytest.mark.parametrize(('sample', 'reason'), [
    (YawRate(EPOCH, math.nan), 'not_finite'), (YawRate(EPOCH, math.inf), 'too_large'),
    (YawRate(EPOCH, -2000.0), 'too_large'), (YawRate(0, 0.1), 'zero_stamp'),
    (YawRate(2**62 + 1, 0.1), 'no_stamp'), (YawRate(EPOCH + SECOND, 0.1), 'duplicate_stamp'),
    (YawRate(EPOCH + SECOND // 2 + 1, 0.1), 'out_of_order'),
])
def test_what_cannot_be_used_is_rejected(sample: YawRate, reason: str) -> None:
    stream = GyroStream(QUIET)
    for k in range(101):
        stream.add(YawRate(EPOCH + k * SECOND // 100, 0.0))
    answer = stream.add(sample)
    assert answer.status is AnswerStatus.REJECTED
    assert answer.reason == reason
