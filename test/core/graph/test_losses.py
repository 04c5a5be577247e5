# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Robust losses: what all members of the enumeration have in common, and what each is."""

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.config import Loss
from pose_graph_ros.core.graph.reweighting import costs_and_weights

# Losses that give no weight at all to energies above the square of the threshold.
ENDING = (Loss.TUKEY, Loss.TRUNCATED)
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
    # so a weighted energy is a tangent above the cost, which each reweighted solution lowers
    energy = np.sort(values)
    cost, weight = costs_and_weights(loss, energy, threshold)
    assert np.all(np.diff(cost) >= -1e-12 * cost[1:])
    assert np.all(np.diff(weight) <= 0.0)
