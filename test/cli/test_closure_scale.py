# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The factor on the sigmas of closures: in a linear world, and in a graph of laps."""

import numpy as np
import pytest

from pose_graph_ros.cli.believe import give_scale, residual_scale
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

SIGMAS = np.array([0.2, 0.3, 0.05])
VECTORS, EACH = 10, 8


def found(measured: FloatArray, group: IntArray, rank: int = 3) -> float:
    """Return the factor in a linear world: noisy measurements of vectors, seen at the optimum."""
    errors = (measured.mean(axis=1, keepdims=True) - measured).reshape(-1, 3)
    each = np.diag(np.where(np.arange(3) < rank, SIGMAS**-2.0, 0.0))
    information = np.tile(each, (len(errors), 1, 1))
    covariances = np.tile(np.diag(SIGMAS**2 / EACH), (len(errors), 1, 1))
    scale = 1.0
    for _ in range(6):
        scale = residual_scale(errors, scale**2 * covariances, information, group, scale)
    return scale


def noise(factor: float, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return factor * SIGMAS * rng.normal(size=(VECTORS, EACH, 3))


@pytest.mark.parametrize('factor', [0.5, 1.0, 2.5])
@pytest.mark.parametrize('rank', [2, 3])
def test_the_factor_is_that_of_independent_errors(factor: float, rank: int) -> None:
    alone = np.arange(VECTORS * EACH)
    # 80 of them are believed a little less than that they are as claimed
    assert 0.65 * factor < found(noise(factor, 1), alone, rank) <= 1.2 * max(factor, 1.0)


def test_a_few_wrong_ones_do_not_decide() -> None:
    measured = noise(1.0, 2)
    measured[0, 0] += 300.0 * SIGMAS
    assert found(measured, np.arange(VECTORS * EACH)) < 1.5


def test_closures_of_one_place_with_a_common_error_count_as_one() -> None:
    """Each vector is measured at two places, four times with the same error."""
    rng = np.random.default_rng(3)
    places = EACH // 4
    common = np.repeat(rng.normal(size=(VECTORS, places, 3)), 4, axis=1)
    measured = 2.0 * SIGMAS * common + noise(0.2, 4)
    group = np.arange(VECTORS * EACH) // 4
    alone, together = found(measured, np.arange(VECTORS * EACH)), found(measured, group)
    # four with the common error are as good as one of 2 sigma, which is each of four with 4 sigma;
    # but 20 places with half of their residuals left count as little as that sigmas are as claimed
    assert together > 1.3 * alone
    assert 2.0 < together < 4.5


@pytest.mark.parametrize(('factor', 'least', 'most'), [(1.0, 1.0, 1.2), (3.0, 2.0, 3.5)])
def test_closures_of_a_graph_get_the_weight_of_the_factor(
    factor: float, least: float, most: float,
) -> None:
    rng, lap, laps = np.random.default_rng(5), 30, 5
    step = np.array([1.0, 0.0, 2.0 * np.pi / lap])
    truth = np.zeros((lap * laps, 3))
    for k in range(1, len(truth)):
        truth[k] = se2.compose(truth[k - 1], step)
    first = np.arange(len(truth) - 1)
    odometry = Factors(
        first, first + 1, np.tile(step, (len(first), 1)),
        np.tile(np.diag([400.0, 400.0, 1e4]), (len(first), 1, 1)),
        [FactorKind.ODOMETRY] * len(first))
    late = np.arange(lap, len(truth))
    closures = Factors(
        late - lap, late, rng.normal(0.0, factor * SIGMAS, (len(late), 3)),
        np.tile(np.diag(SIGMAS**-2.0), (len(late), 1, 1)), [FactorKind.LOOP_CLOSURE] * len(late))
    graph = Graph()
    graph.apply(GraphUpdate(hidden=truth, fix=[0], factors=odometry))
    rows = len(graph.factors.edges) + np.arange(len(late))
    graph.apply(GraphUpdate(factors=closures))
    scale = give_scale(graph, rows)
    assert least <= scale <= most
    np.testing.assert_allclose(graph.factors_at(rows).weight, scale**-2.0)
