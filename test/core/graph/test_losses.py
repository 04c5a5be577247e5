# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The formulas of robust losses."""

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.config import Loss
from pose_graph_ros.core.graph import losses

LOSSES = (Loss.NONE, Loss.HUBER, Loss.CAUCHY)
ROBUST = (Loss.HUBER, Loss.CAUCHY)


@pytest.mark.parametrize('loss', LOSSES)
@given(st.floats(1e-3, 1e4), st.floats(0.1, 10.0))
def test_weights_are_the_derivatives_of_the_costs(
    loss: Loss, energy: float, threshold: float,
) -> None:
    step = 1e-4 * energy
    low, high = losses.costs(loss, np.array([energy - step, energy + step]), threshold)
    weight = losses.weights(loss, np.array([energy]), threshold)[0]
    assert weight == pytest.approx((high - low) / (2.0 * step), rel=1e-3)
    assert 0.0 < weight <= 1.0


@pytest.mark.parametrize('loss', ROBUST)
def test_small_errors_count_in_full_and_large_ones_less_and_less(loss: Loss) -> None:
    energy = np.geomspace(1e-12, 1e12, 200)
    weight, cost = losses.weights(loss, energy, 3.0), losses.costs(loss, energy, 3.0)
    assert weight[0] == pytest.approx(1.0)
    assert cost[0] == pytest.approx(energy[0], rel=1e-6)
    assert np.all(np.diff(weight) <= 0.0)
    assert np.all(np.diff(cost) > 0.0)
    # no jump at the threshold
    around = np.array([8.999999, 9.000001])
    assert np.ptp(losses.weights(loss, around, 3.0)) < 1e-6
    assert np.ptp(losses.costs(loss, around, 3.0)) < 3e-6


@pytest.mark.parametrize('loss', LOSSES)
def test_no_energy_gives_a_weight_that_is_no_number(loss: Loss) -> None:
    energy = np.array([0.0, -1e-20, 1e-300, 1e300])
    with np.errstate(all='raise', under='ignore'):
        weight = losses.weights(loss, energy, 1e-3)
    assert np.all(np.isfinite(weight))
    assert np.all(weight > 0.0)
    assert np.all(np.isfinite(losses.costs(loss, energy, 1e-3)))
