# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Noise of a made drive is found again, and what is written is never surer than it proves."""

from collections.abc import Sequence
from dataclasses import replace

from helpers.noisy_drive import made
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, POSITIONS, Robust
from pose_graph_ros.core.measurements import OdometrySample, Position
from pose_graph_ros.offline.noise import Noise, noise_of, proven_odometry

GOOD = 0.002, 0.001, 2e-5, 2e-5
# of the engine, by way and by turn
DEFAULTS = 0.05, 0.03, 0.01, 0.05


def found(
    odometry: Sequence[OdometrySample], fixes: Sequence[Position], without: Sequence[int] = (),
) -> Noise:
    backend = PoseGraphBackend(BackendConfig(
        measurements={'fix': replace(POSITIONS, robust=Robust.NONE)}))
    for each in odometry:
        backend.add_odometry(each)
    for each in fixes:
        backend.add_measurement(each, 'fix')
    backend.update()
    noise = noise_of(backend.parts, 'fix', without)
    assert noise is not None
    return noise


@pytest.mark.parametrize('claimed', [1.0, 0.03, 5.0])
def test_white_errors_are_found_whatever_is_claimed(claimed: float) -> None:
    size = found(*made(3, 300, claimed=claimed)).size
    assert size.low * claimed**2 < 1.0 < size.high * claimed**2
    assert size.kept == (claimed == 1.0)
    assert size.high < 1.7 * size.low


def test_correlated_errors_are_found() -> None:
    noise = found(*made(3, 600, white=0.2, slow=1.0, tau=15.0, claimed=1.0))
    assert noise.tau is not None
    assert noise.tau.low < 15.0 < noise.tau.high
    assert noise.size.low < 1.04 < noise.size.high


@pytest.mark.parametrize(('way', 'turn'), [(6.0, 5.0), (1.0, 5.0), (1.0, 1.0)])
def test_noise_of_odometry_is_found(way: float, turn: float) -> None:
    factors = np.array((way, way, turn, turn))
    noise = found(*made(2, 400, tuple(factors * DEFAULTS), white=0.3, claimed=0.3))
    for true, each in ((way, noise.way), (turn, noise.turn)):
        assert 0.6 * true < np.sqrt(each.value) < 1.6 * true
        assert each.kept == (true == 1.0)


def test_the_same_measurements_give_the_same_noise_and_others_can_be_left_out() -> None:
    odometry, fixes = made(5, 120)
    likely = found(odometry, fixes)
    assert found(odometry, fixes[::-1]) == likely
    wrong = [replace(each, position=each.position + 9.0) for each in fixes[::7]]
    moved = {each.stamp_ns: each for each in wrong}
    worse = [moved.get(each.stamp_ns, each) for each in fixes]
    stamps = [each.stamp_ns for each in wrong]
    assert found(odometry, worse, stamps) == found(odometry, fixes, stamps)


@pytest.mark.parametrize('fixes', [
    {'white': 0.003}, {'white': 0.003, 'slow': 0.3, 'tau': 100.0}])
def test_a_minute_of_smooth_fixes_does_not_prove_millimetres(fixes: dict[str, float]) -> None:
    likely = found(*made(3, 60, GOOD, **fixes))
    assert likely.size.value < 0.05
    assert likely.proven.kept


def test_a_source_that_keeps_more_than_was_found_is_not_outweighed_by_odometry() -> None:
    likely = found(*made(3, 60, GOOD, white=0.003))
    excess = likely.proven.value / likely.size.value
    assert excess > 10.0
    for written, each in zip(proven_odometry([likely]), (likely.way, likely.turn), strict=True):
        assert written.value >= min(1.0, each.value * excess)


def test_good_odometry_proves_in_a_long_drive_that_fixes_claim_too_much() -> None:
    likely = found(*made(3, 3000, GOOD, white=0.5, claimed=5.0))
    size = likely.proven.value
    assert likely.size.value < size < 0.1
    assert size * 5.0**2 > 0.5**2


def test_noise_of_odometry_is_lowered_to_the_end_of_its_interval() -> None:
    likely = found(*made(3, 300, GOOD, white=1.0))
    lowered = [(each, written) for each, written in zip(
        (likely.way, likely.turn), proven_odometry([likely]), strict=True) if not written.kept]
    assert len(lowered) > 0
    assert all(each.value < each.high <= written.value < 1.0 for each, written in lowered)
