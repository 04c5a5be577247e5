# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Time constants of correlated errors, and the absence of one for white errors."""

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.sources.settings import SOURCES
from pose_graph_ros.core.sources.source_report import estimate

SECOND = 1_000_000_000


def errors(
    rng: np.random.Generator, n: int, period: float, tau: float, white: float,
) -> np.ndarray:
    """Return the sum of a first-order Gauss-Markov process and white noise, of variance 1."""
    slow = rng.standard_normal((n, 2))
    phi = np.exp(-period / tau)
    for k in range(1, n):
        slow[k] = phi * slow[k - 1] + np.sqrt(1.0 - phi**2) * slow[k]
    return np.sqrt(1.0 - white) * slow + np.sqrt(white) * rng.standard_normal((n, 2))


def stamps(n: int, period: float) -> np.ndarray:
    return SECOND + np.round(np.arange(n) * period * SECOND).astype(np.int64)


@pytest.mark.parametrize(('tau', 'period', 'n', 'white'), [
    (5.0, 0.1, 5000, 0.0), (60.0, 0.5, 5000, 0.1), (2.0, 1.0, 2000, 0.3), (60.0, 1.0, 3000, 0.5)])
def test_tau_and_the_sigma_are_found(tau: float, period: float, n: int, white: float) -> None:
    found = [estimate(stamps(n, period),
                      errors(np.random.default_rng(seed), n, period, tau, white))
             for seed in range(10)]
    assert all(one.significant for one in found)
    assert np.median([one.tau for one in found]) == pytest.approx(tau, rel=0.3)
    assert np.median([one.sigma_correlated for one in found]) == pytest.approx(
        np.sqrt(1.0 - white), abs=0.12)


@settings(max_examples=50)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 600), period=st.sampled_from((0.1, 1.0)))
def test_white_errors_are_not_called_correlated(seed: int, n: int, period: float) -> None:
    residuals = np.random.default_rng(seed).standard_normal((n, 2))
    assert not estimate(stamps(n, period), residuals).significant


@pytest.mark.parametrize('residuals', [
    np.zeros((100, 2)), np.ones((100, 2)), np.ones((SOURCES.least_residuals - 1, 2)),
    np.zeros((0, 2))])
def test_degenerate_residuals_give_finite_numbers(residuals: np.ndarray) -> None:
    found = estimate(stamps(len(residuals), 1.0), residuals)
    assert np.all(np.isfinite(found))
    same = estimate(np.full(len(residuals), SECOND), residuals)
    assert np.all(np.isfinite(same))
