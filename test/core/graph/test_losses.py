# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robust losses: what all members of the enumeration have in common, and what each is."""

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.config import Loss
from pose_graph_ros.core.graph.losses import costs_and_weights

ROBUST = [loss for loss in Loss if loss is not Loss.NONE]
# Losses that give no weight at all to energies above the square of the threshold.
ENDING = (Loss.TUKEY, Loss.TRUNCATED)
# Limits of the cost for large energies, as a fraction of the square of the threshold.
BOUNDS = {Loss.GEMAN_MCCLURE: 1.0, Loss.DCS: 3.0, Loss.TUKEY: 1.0 / 3.0, Loss.TRUNCATED: 1.0}
ENERGIES, THRESHOLDS = st.floats(1e-3, 1e4), st.floats(0.1, 10.0)


@pytest.mark.parametrize('loss', Loss)
@given(ENERGIES, THRESHOLDS)
def test_weights_are_the_derivatives_of_the_costs(
    loss: Loss, energy: float, threshold: float,
) -> None:
    step = 1e-4 * energy
    square = threshold**2
    if loss is Loss.TRUNCATED and abs(energy - square) <= step:
        energy = square + 2.0 * step    # there is no derivative at the kink
    (low, _, high), (_, weight, _) = costs_and_weights(
        loss, np.array([energy - step, energy, energy + step]), threshold)
    # the difference of two costs has a rounding error
    assert weight == pytest.approx(
        (high - low) / (2.0 * step), rel=2e-3, abs=1e-7 + 1e-15 * high / step)
    assert 0.0 <= weight <= 1.0
    assert weight > 0.0 or (loss in ENDING and energy >= square)


@pytest.mark.parametrize('loss', Loss)
@given(st.lists(st.floats(0.0, 1e6), min_size=2, max_size=20), THRESHOLDS)
def test_costs_never_fall_and_weights_never_rise(
    loss: Loss, values: list[float], threshold: float,
) -> None:
    energy = np.sort(values)
    cost, weight = costs_and_weights(loss, energy, threshold)
    assert np.all(np.diff(cost) >= -1e-12 * cost[1:])
    assert np.all(np.diff(weight) <= 0.0)


@pytest.mark.parametrize('loss', Loss)
@given(ENERGIES, THRESHOLDS, st.floats(0.1, 10.0))
def test_sigmas_are_the_only_unit(
    loss: Loss, energy: float, threshold: float, factor: float,
) -> None:
    (cost,), (weight,) = costs_and_weights(loss, np.array([energy]), threshold)
    (scaled,), (same,) = costs_and_weights(
        loss, np.array([factor**2 * energy]), factor * threshold)
    assert scaled == pytest.approx(factor**2 * cost, rel=1e-9)
    if abs(energy / threshold**2 - 1.0) > 1e-9:     # else rounding decides on the side
        assert same == pytest.approx(weight, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize('loss', Loss)
@given(ENERGIES, ENERGIES, THRESHOLDS)
def test_the_weighted_energy_is_a_tangent_above_the_cost(
    loss: Loss, here: float, there: float, threshold: float,
) -> None:
    # so each reweighted least-squares solution lowers the cost
    (cost, other), (weight, _) = costs_and_weights(loss, np.array([here, there]), threshold)
    assert other <= cost + weight * (there - here) + 1e-9 * (cost + weight * there)


@pytest.mark.parametrize('loss', ROBUST)
def test_small_errors_count_in_full_and_large_ones_less_and_less(loss: Loss) -> None:
    energy = np.geomspace(1e-12, 1e12, 200)
    cost, weight = costs_and_weights(loss, energy, 3.0)
    assert weight[0] == pytest.approx(1.0)
    assert cost[0] == pytest.approx(energy[0], rel=1e-6)
    rising = energy[1:] < 9.0 if loss in ENDING else energy[1:] < 1e9
    assert np.all(np.diff(cost)[rising] > 0.0)
    assert weight[-1] < 1e-3    # a loss without a case of its own would not be robust
    if loss in BOUNDS:
        assert cost[-1] == pytest.approx(9.0 * BOUNDS[loss], rel=1e-6)
    else:
        assert cost[-1] > 90.0
    # no jump at the threshold, but where least squares are truncated
    cost, weight = costs_and_weights(loss, np.array([8.999999, 9.000001]), 3.0)
    assert np.ptp(cost) < 3e-6
    assert np.ptp(weight) < 1e-6 or (loss is Loss.TRUNCATED and weight.tolist() == [1.0, 0.0])


@pytest.mark.parametrize('loss', Loss)
def test_no_energy_gives_a_weight_that_is_no_number(loss: Loss) -> None:
    with np.errstate(all='raise', under='ignore'):
        cost, weight = costs_and_weights(loss, np.array([0.0, -1e-20, 1e-300, 1e300]), 1e-3)
    assert np.all(np.isfinite(weight))
    assert np.all(weight[:3] == 1.0)
    assert weight[3] >= 0.0
    assert np.all(np.isfinite(cost))


@pytest.mark.parametrize(('loss', 'cost', 'weight'), [
    (Loss.NONE, 36.0, 1.0), (Loss.HUBER, 2.0 * 2.0 * 6.0 - 4.0, 2.0 / 6.0),
    (Loss.CAUCHY, 4.0 * np.log(10.0), 0.1), (Loss.GEMAN_MCCLURE, 3.6, 0.01),
    (Loss.DCS, 4.0 * 2.6, 0.04), (Loss.TUKEY, 4.0 / 3.0, 0.0), (Loss.TRUNCATED, 4.0, 0.0)])
def test_six_sigmas_with_a_threshold_of_two(loss: Loss, cost: float, weight: float) -> None:
    found = costs_and_weights(loss, np.array([36.0]), 2.0)
    assert np.ravel(found) == pytest.approx([cost, weight])


@pytest.mark.parametrize(('loss', 'cost', 'weight'), [
    (Loss.HUBER, 1.0, 1.0), (Loss.CAUCHY, 4.0 * np.log(1.25), 0.8),
    (Loss.GEMAN_MCCLURE, 0.8, 0.64), (Loss.DCS, 1.0, 1.0), (Loss.TUKEY, 37.0 / 48.0, 0.5625),
    (Loss.TRUNCATED, 1.0, 1.0)])
def test_one_sigma_with_a_threshold_of_two(loss: Loss, cost: float, weight: float) -> None:
    found = costs_and_weights(loss, np.array([1.0]), 2.0)
    assert np.ravel(found) == pytest.approx([cost, weight])


@pytest.mark.parametrize('loss', ['huber', 1, None])
def test_what_is_no_loss_is_not_taken_for_least_squares(loss: object) -> None:
    with pytest.raises(AssertionError, match='unreachable'):
        costs_and_weights(loss, np.ones(1), 3.0)
