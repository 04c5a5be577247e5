# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Reports of sources: the energy is that of the residuals, and wrong white noise is noticed."""

import numpy as np
import pytest

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.sources.bias import CorrelatedErrors
from pose_graph_ros.core.sources.source_report import report

KNOWN = CorrelatedErrors(20.0, 1.0, 0.05)

SECOND = 1_000_000_000


def gauss_markov(n: int, tau: float, seed: int = 0) -> np.ndarray:
    """Return errors with a standard deviation of 1 and a correlation time in samples."""
    rng = np.random.default_rng(seed)
    error = rng.standard_normal((n, 2))
    kept = np.exp(-1.0 / tau)
    for k in range(1, n):
        error[k] = kept * error[k - 1] + np.sqrt(1.0 - kept**2) * error[k]
    return error


def observed(residuals: np.ndarray, sigma: float, *, turn: float = 0.0) -> Graph:
    """Return a graph whose observed nodes have these residuals in map axes [m]."""
    n, graph = len(residuals), Graph()
    information = np.zeros((n, 3, 3))
    information[:, 0, 0] = information[:, 1, 1] = sigma**-2
    graph.apply(GraphUpdate(
        hidden=np.column_stack((residuals, np.full(n, turn))), factors=Factors.on(
            np.arange(n), None, np.tile((0.0, 0.0, turn), (n, 1)), information,
            [FactorKind.POSITION] * n)))
    return graph


def in_time(n: int) -> tuple[np.ndarray, np.ndarray]:
    return SECOND * np.arange(n), np.arange(n)


@pytest.mark.parametrize('turn', [0.0, 2.0])
def test_the_energy_is_the_mean_square_of_a_coordinate_in_sigmas(turn: float) -> None:
    residuals = np.random.default_rng(1).normal(0.0, 1.0, (200, 2))
    found = report(observed(residuals, 0.5, turn=turn), *in_time(200), in_use=None)
    assert found.n == 200
    assert found.energy == pytest.approx(np.mean(residuals**2) / 0.25)
    assert not found.errors.significant
    assert not found.wrongly_white


@pytest.mark.parametrize(('white', 'sigma', 'tau', 'wrong'), [
    (True, 1.0, 20.0, True),
    (False, 1.0, 20.0, False),      # known to be correlated
    (True, 1.0, 0.01, False),       # as white as it is treated
    (True, 100.0, 20.0, False)])    # far below what its sigmas say
def test_errors_that_are_treated_as_white_but_are_not_are_noticed(
    white: bool, sigma: float, tau: float, wrong: bool,
) -> None:
    found = report(observed(gauss_markov(600, tau), sigma), *in_time(600),
                   in_use=None if white else KNOWN)
    assert found.wrongly_white is wrong


def test_of_a_biased_source_the_whole_error_counts_not_the_white_rest() -> None:
    """With sigma 1, a white share of 0.05, and biases that explain all but the white part."""
    n, white = 600, 0.05
    bias, rest = gauss_markov(n, 20.0), np.random.default_rng(9).standard_normal((n, 2))
    factor = np.sqrt(1.0 - white)
    error = factor * bias + np.sqrt(white) * rest
    graph = Graph()
    information = np.tile(np.diag([1.0, 1.0, 0.0]) / white, (n, 1, 1))
    poses = np.column_stack((error, np.linspace(-3.0, 3.0, n)))
    arm = np.array([0.5, -0.2])
    graph.apply(GraphUpdate(
        hidden=poses, biases=np.column_stack((-bias, np.zeros(n))), factors=Factors(
            np.arange(n), n + np.arange(n),
            np.column_stack((se2.transform(poses, arm) - error, np.zeros(n))), information,
            [FactorKind.BIAS] * n, constants=np.tile((*arm, factor, 0.0), (n, 1)))))
    found = report(graph, *in_time(n), in_use=KNOWN)
    variance = np.mean(error**2)
    assert found.energy == pytest.approx(variance, rel=0.02)
    assert found.errors.significant
    assert 5.0 < found.errors.tau < 60.0
