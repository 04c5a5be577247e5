# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Covariances: what is one, how they turn, how the noise of odometry adds up."""

from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest

from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.odometry.motion import Motion, odometry_covariance

ROUNDING = 1e-12

seeds = st.integers(0, 2**32 - 1)


def random_covariance(seed: int, size: int = 3) -> FloatArray:
    rng = np.random.default_rng(seed)
    root = rng.uniform(-1.0, 1.0, (size, size)) + np.eye(size)
    root *= 10.0 ** rng.uniform(-4.0, 3.0, (size, 1))
    return root @ root.T + 1e-3 * np.diag(np.diagonal(root @ root.T))


# --- defects ---------------------------------------------------------------------------------


@given(arrays(np.float64, (3, 3), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_no_matrix_brings_the_check_down(matrix: FloatArray) -> None:
    if covariance.defect(matrix) is None:
        np.linalg.cholesky(0.5 * (matrix + matrix.T))


@given(arrays(np.float64, (3, 3), elements=st.floats(-2.0, 2.0, width=16)))
def test_what_passes_is_positive_definite_and_what_is_clearly_so_passes(
    matrix: FloatArray,
) -> None:
    for candidate in (matrix, matrix @ matrix.T, matrix @ matrix.T + np.eye(3)):
        word = covariance.defect(candidate)
        smallest = np.min(np.linalg.eigvalsh(0.5 * (candidate + candidate.T)))
        if word is None:
            assert smallest > 0.0
        if smallest > 1e-3 and np.array_equal(candidate, candidate.T):
            assert word is None


@given(seeds)
def test_a_covariance_has_no_defect_in_any_units(seed: int) -> None:
    for size in (2, 3):
        cov = random_covariance(seed, size)
        assert covariance.defect(cov) is None
        units = np.diag(10.0 ** np.arange(0, -3 * size, -3.0))
        assert covariance.defect(units @ cov @ units) is None


@given(seeds, st.floats(0.0, 1e3))
def test_floors_raise_what_lies_below_and_nothing_else(seed: int, floor: float) -> None:
    cov = random_covariance(seed)
    floors = np.array([floor, 0.0, 1e-6])
    result = covariance.floored(cov, floors)
    np.testing.assert_allclose(
        np.diagonal(result), np.maximum(np.diagonal(cov), floors), rtol=ROUNDING)
    off_diagonal = ~np.eye(3, dtype=bool)
    np.testing.assert_allclose(result[off_diagonal], cov[off_diagonal], rtol=ROUNDING)
    np.testing.assert_array_equal(result, result.T)
    assert np.min(np.linalg.eigvalsh(result)) > 0.0


@given(seeds)
def test_information_is_the_symmetric_inverse(seed: int) -> None:
    cov = random_covariance(seed)
    information = covariance.information(cov)
    np.testing.assert_array_equal(information, information.T)
    np.testing.assert_allclose(information @ cov, np.eye(3), atol=1e-6)


# --- turning ---------------------------------------------------------------------------------

@pytest.mark.parametrize('size', [2, 3])
def test_turning_expresses_the_same_errors_in_other_axes(size: int) -> None:
    rng = np.random.default_rng(3)
    cov, theta = random_covariance(3, size), 0.7
    errors = rng.standard_normal((1000, size))
    # an error e in the parent's axes is R^T e in axes turned by theta
    seen = errors.copy()
    seen[:, :2] = errors[:, :2] @ se2.rotation(theta)
    expected = np.einsum('ni,ij,nj->n', errors, np.linalg.inv(cov), errors)
    turned = covariance.turned(cov, theta)
    np.testing.assert_allclose(
        np.einsum('ni,ij,nj->n', seen, np.linalg.inv(turned), seen), expected, rtol=1e-6)


# --- odometry --------------------------------------------------------------------------------

NOISE = OdometryNoise(sigma_distance=0.05, sigma_lateral=0.03, sigma_heading_distance=0.02,
                      sigma_heading_turn=0.05, sigma_floor_position=0.01,
                      sigma_floor_heading=0.001)


def odometry(
    increment: FloatArray, distance: float, turn: float, noise: OdometryNoise = NOISE,
    **options: bool,
) -> FloatArray:
    return odometry_covariance(noise, Motion(increment, distance, turn), **options)


def composed(first: FloatArray, second: FloatArray, increment: FloatArray) -> FloatArray:
    """Return the covariance at the end of two increments, in the frame there."""
    propagate = se2.adjoint(se2.inverse(increment))
    return propagate @ first @ propagate.T + second


@given(st.floats(0.0, 20.0), st.integers(1, 9))
def test_the_parts_of_a_straight_increment_compose_to_the_whole(
    distance: float, parts: int,
) -> None:
    step = distance / parts
    part = odometry(np.array([step, 0.0, 0.0]), step, 0.0, floor=False)
    total = np.zeros((3, 3))
    for _ in range(parts):
        total = composed(total, part, np.array([step, 0.0, 0.0]))
    whole = odometry(np.array([distance, 0.0, 0.0]), distance, 0.0, floor=False)
    np.testing.assert_allclose(total, whole, rtol=1e-9, atol=1e-15)


# --- propagation -----------------------------------------------------------------------------

@given(seeds)
def test_propagation_follows_the_numeric_jacobians(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose, increment = rng.uniform(-3.0, 3.0, (2, 3))
    cov, noise = (root @ root.T for root in rng.uniform(-1.0, 1.0, (2, 3, 3)))
    step, end = 1e-6, se2.compose(pose, increment)
    by_pose, by_noise = np.zeros((2, 3, 3))
    for k, axis in enumerate(np.eye(3)):
        moved = se2.compose(pose + step * axis, increment) - end
        shaken = se2.compose(end, step * axis) - end
        for column, difference in ((by_pose, moved), (by_noise, shaken)):
            difference[2] = se2.wrap(difference[2])
            column[:, k] = difference / step
    expected = by_pose @ cov @ by_pose.T + by_noise @ noise @ by_noise.T
    np.testing.assert_allclose(
        covariance.propagated(pose, cov, increment, noise), expected, atol=1e-3)
