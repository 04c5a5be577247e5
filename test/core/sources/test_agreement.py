# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is said of a gyroscope and odometry that differ, or are the same."""

from itertools import pairwise

import numpy as np
import pytest

from pose_graph_ros.core.sources.gyro import Agreement, Difference


def difference(
    *, early: float = 0.0, factor: float = 1.0, noise: float = 1.0, n: int = 400,
) -> Difference:
    """Compare a winding drive with a gyroscope that has faults, sigma 3 mrad a second."""
    rng, sigma = np.random.default_rng(3), 3e-3
    times = np.arange(n + 1.0)
    agreement = Agreement()
    for start, end in pairwise(times.tolist()):
        def heading(t: float) -> float:
            return float(1.5 * np.sin(0.3 * t))

        def rate(t: float) -> float:
            return float(0.45 * np.cos(0.3 * t))

        angle = factor * (heading(end + early) - heading(start + early)) + 0.004
        by_wheels = heading(end) - heading(start) + noise * sigma * rng.standard_normal()
        agreement.add(angle - by_wheels, 1.0, rate(end + early) - rate(start + early), angle,
                      sigma**2)
    found = agreement.difference()
    assert found is not None
    return found


def test_sensors_that_agree_differ_by_a_sigma() -> None:
    found = difference()
    assert found.sigmas == pytest.approx(1.0, abs=0.1)
    assert found.reason == ''


@pytest.mark.parametrize(('fault', 'words'), [
    ({'early': 0.3}, '0.30 s early'), ({'early': -0.2}, '0.20 s late'),
    ({'factor': -1.0}, 'mounting'), ({'factor': 1.25}, 'odometry turns 0.80 times'),
    ({'noise': 0.01}, 'counts twice'), ({'noise': 3.0}, '')])
def test_what_is_wrong_is_said(fault: dict[str, float], words: str) -> None:
    found = difference(**fault)
    assert words in found.reason
    assert (found.reason == '') == (words == '')
    assert (found.sigmas < 0.1) == ('twice' in words)


@pytest.mark.parametrize('rate', [0.0, 0.004, 0.02])
@pytest.mark.parametrize('noise', [0.0, 0.01])
def test_a_gyroscope_that_does_not_turn_while_odometry_does_is_recognised(
    rate: float, noise: float,
) -> None:
    rng, agreement = np.random.default_rng(1), Agreement()
    for start, end in pairwise(np.arange(0.0, 200.0).tolist()):
        by_wheels = float(1.5 * np.sin(0.3 * end) - 1.5 * np.sin(0.3 * start))
        angle = rate + noise * float(rng.standard_normal())
        agreement.add(angle - by_wheels, 1.0, 0.0, angle, 1e-4)
    found = agreement.difference()
    assert found is not None
    assert found.sigmas > 1.5
    assert 'does not turn' in found.reason
