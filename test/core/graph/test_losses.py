# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robust losses: what all members of the enumeration have in common, and what each is."""

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.config import Loss
from pose_graph_ros.core.graph.losses import costs_and_weights

ROBUST = [loss for loss in Loss if loss is not Loss.NONE]


@pytest.mark.parametrize('loss', Loss)
@given(st.floats(1e-3, 1e4), st.floats(0.1, 10.0))
def test_weights_are_the_derivatives_of_the_costs(
    loss: Loss, energy: float, threshold: float,
) -> None:
    step = 1e-4 * energy
    (low, _, high), (_, weight, _) = costs_and_weights(
        loss, np.array([energy - step, energy, energy + step]), threshold)
    assert weight == pytest.approx((high - low) / (2.0 * step), rel=1e-3)
    assert 0.0 < weight <= 1.0


@pytest.mark.parametrize('loss', ROBUST)
def test_small_errors_count_in_full_and_large_ones_less_and_less(loss: Loss) -> None:
    energy = np.geomspace(1e-12, 1e12, 200)
    cost, weight = costs_and_weights(loss, energy, 3.0)
    assert weight[0] == pytest.approx(1.0)
    assert cost[0] == pytest.approx(energy[0], rel=1e-6)
    assert np.all(np.diff(weight) <= 0.0)
    assert np.all(np.diff(cost) > 0.0)
    assert weight[-1] < 1e-3    # a loss without a case of its own would not be robust
    # no jump at the threshold
    cost, weight = costs_and_weights(loss, np.array([8.999999, 9.000001]), 3.0)
    assert np.ptp(weight) < 1e-6
    assert np.ptp(cost) < 3e-6


@pytest.mark.parametrize('loss', Loss)
def test_no_energy_gives_a_weight_that_is_no_number(loss: Loss) -> None:
    with np.errstate(all='raise', under='ignore'):
        cost, weight = costs_and_weights(loss, np.array([0.0, -1e-20, 1e-300, 1e300]), 1e-3)
    assert np.all(np.isfinite(weight))
    assert np.all(weight > 0.0)
    assert np.all(np.isfinite(cost))


@pytest.mark.parametrize(('loss', 'cost', 'weight'), [
    (Loss.NONE, 36.0, 1.0), (Loss.HUBER, 2.0 * 2.0 * 6.0 - 4.0, 2.0 / 6.0),
    (Loss.CAUCHY, 4.0 * np.log(10.0), 0.1)])
def test_six_sigmas_with_a_threshold_of_two(loss: Loss, cost: float, weight: float) -> None:
    found = costs_and_weights(loss, np.array([36.0]), 2.0)
    assert np.ravel(found) == pytest.approx([cost, weight])


@pytest.mark.parametrize('loss', ['huber', 1, None])
def test_what_is_no_loss_is_not_taken_for_least_squares(loss: object) -> None:
    with pytest.raises(AssertionError, match='unreachable'):
        costs_and_weights(loss, np.ones(1), 3.0)
