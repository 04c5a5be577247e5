# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Planar poses against homogeneous matrices: near zero, near half a turn and far away."""

from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_graphs import matrix

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray

# A few roundings of numbers below 100.
ROUNDING = 1e-13
# A few roundings of numbers of 5e6, as the axes of UTM have them.
FAR_ROUNDING = 1e-8
# Batch shapes that every function takes.
SHAPES = [(), (1,), (7,), (2, 3), (0,)]


def poses(angle: st.SearchStrategy[float], length: st.SearchStrategy[float]):
    return st.tuples(length, length, angle).map(np.array)


tiny = st.floats(-1e-9, 1e-9)
half_turn = st.floats(-1e-9, 1e-9).flatmap(
    lambda d: st.sampled_from((-np.pi + abs(d), np.pi - abs(d) - 1e-15)))
angles = st.one_of(st.floats(-np.pi, np.nextafter(np.pi, 0.0)), tiny, half_turn)
lengths = st.one_of(st.floats(-50.0, 50.0), tiny)
near = poses(angles, lengths)
far = poses(angles, st.floats(-5e6, 5e6))


def assert_same(pose: FloatArray, expected: FloatArray, tolerance: float = ROUNDING) -> None:
    """Compare with a pose or a homogeneous matrix; headings to a whole turn."""
    if expected.shape == (3, 3):
        expected = np.array([expected[0, 2], expected[1, 2],
                             np.arctan2(expected[1, 0], expected[0, 0])])
    np.testing.assert_allclose(pose[:2], expected[:2], atol=tolerance, rtol=0.0)
    turn = pose[2] - expected[2]
    assert abs(turn - 2.0 * np.pi * round(turn / (2.0 * np.pi))) < ROUNDING
    assert -np.pi <= pose[2] < np.pi


# --- wrap ------------------------------------------------------------------------------------

@given(st.one_of(angles, st.floats(-1e6, 1e6)))
def test_wrapped_angles_are_in_the_half_open_interval_and_the_same_direction(angle: float) -> None:
    wrapped = float(se2.wrap(angle))
    assert -np.pi <= wrapped < np.pi
    rounding = 1e-15 * (10.0 + abs(angle))
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=rounding)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=rounding)
    assert se2.wrap(wrapped) == wrapped


@given(angles)
def test_angles_inside_the_interval_are_left_bit_for_bit(angle: float) -> None:
    assert se2.wrap(angle).tobytes() == np.float64(angle).tobytes()


@pytest.mark.parametrize(('angle', 'wrapped'), [
    (np.pi, -np.pi), (-np.pi, -np.pi), (3.0 * np.pi, -np.pi), (0.0, 0.0), (-0.0, -0.0),
    (np.nextafter(np.pi, 0.0), np.nextafter(np.pi, 0.0))])
def test_half_a_turn_is_always_minus_pi(angle: float, wrapped: float) -> None:
    assert se2.wrap(angle) == wrapped


# --- the group -------------------------------------------------------------------------------

@given(near, near)
def test_compose_inverse_and_between_are_those_of_matrices(a: FloatArray, b: FloatArray) -> None:
    assert_same(se2.compose(a, b), matrix(a) @ matrix(b))
    assert_same(se2.inverse(a), np.linalg.inv(matrix(a)))
    assert_same(se2.between(a, b), np.linalg.inv(matrix(a)) @ matrix(b))
    np.testing.assert_allclose(se2.rotation(a[2]), matrix(a)[:2, :2], atol=ROUNDING)
    np.testing.assert_allclose(
        se2.transform(a, b[:2]), (matrix(a) @ [*b[:2], 1.0])[:2], atol=ROUNDING)


@given(far, near)
def test_far_away_the_laws_hold_to_the_spacing_of_doubles(a: FloatArray, d: FloatArray) -> None:
    assert_same(se2.between(a, se2.compose(a, d)), d, FAR_ROUNDING)
    assert_same(se2.compose(a, se2.inverse(a)), np.zeros(3), FAR_ROUNDING)
    assert_same(se2.compose(a, d), matrix(a) @ matrix(d), FAR_ROUNDING)


@given(poses(tiny, tiny))
def test_near_zero_no_digit_is_lost(d: FloatArray) -> None:
    assert_same(se2.between(np.zeros(3), d), d, 1e-24)
    assert_same(se2.inverse(d), -d, 1e-17)
    assert float(se2.inverse(d)[2]) == -d[2]


# --- batches ---------------------------------------------------------------------------------

@pytest.mark.parametrize('shape', SHAPES)
def test_every_function_takes_any_batch(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    a, b = rng.uniform(-3.0, 3.0, (2, *shape, 3))
    fraction = rng.uniform(size=shape)
    one_by_one = {
        se2.compose: (a, b), se2.between: (a, b), se2.inverse: (a,), se2.adjoint: (a,),
        se2.wrapped: (a,), se2.interpolate: (a, b, fraction)}
    for function, arguments in one_by_one.items():
        together = function(*arguments)
        assert together.dtype == np.float64
        assert together.shape[:len(shape)] == shape
        for index in np.ndindex(shape):
            np.testing.assert_allclose(
                together[index], function(*(x[index] for x in arguments)), atol=1e-15)
    assert se2.transform(a, b[..., :2]).shape == (*shape, 2)
    assert se2.rotation(a[..., 2]).shape == (*shape, 2, 2)
    assert se2.wrap(a[..., 2]).shape == shape


# --- the adjoint -----------------------------------------------------------------------------

def hat(xi: FloatArray) -> FloatArray:
    return np.array([[0.0, -xi[2], xi[0]], [xi[2], 0.0, xi[1]], [0.0, 0.0, 0.0]])


@given(near, near)
def test_the_adjoint_carries_a_generator_to_the_other_side(a: FloatArray, xi: FloatArray) -> None:
    carried = matrix(a) @ hat(xi) @ np.linalg.inv(matrix(a))     # a exp(xi) a^-1 = exp(Ad xi)
    np.testing.assert_allclose(hat(se2.adjoint(a) @ xi), carried, atol=1e-11)


# --- interpolation ---------------------------------------------------------------------------

@given(near, near, st.floats(0.0, 1.0))
def test_interpolation_is_linear_with_the_shortest_turn(
    a: FloatArray, b: FloatArray, fraction: float,
) -> None:
    between = se2.interpolate(a, b, fraction)
    np.testing.assert_allclose(
        between[:2], (1.0 - fraction) * a[:2] + fraction * b[:2], atol=ROUNDING)
    whole = float(se2.wrap(b[2] - a[2]))
    assert_same(np.array([0.0, 0.0, between[2]]), np.array([0.0, 0.0, a[2] + fraction * whole]))
    assert_same(se2.interpolate(a, b, 0.0), a)
    assert_same(se2.interpolate(a, b, 1.0), b)
