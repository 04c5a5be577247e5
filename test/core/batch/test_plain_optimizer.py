# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The optimiser without compiled kernels against the one with them."""


from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import corridor_graph

from pose_graph_ros.core.batch.levenberg_marquardt import Start, Status
from pose_graph_ros.core.batch.optimizer import optimize_from_linear_start
from pose_graph_ros.core.batch.plain_optimizer import PlainGraph, TOLERANCE
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

CONFIG = SolverConfig(max_iterations=200)


def test_its_tolerance_is_that_of_the_parameters() -> None:
    assert CONFIG.step_tolerance == TOLERANCE


def noisy_graph(seed: int, n: int = 30, noise: float = 0.1) -> Graph:
    """Return a chain with chords, also backward and parallel ones, from wrong poses."""
    rng = np.random.default_rng(seed)
    truth = np.column_stack((rng.uniform(-9.0, 9.0, (n, 2)), rng.uniform(-np.pi, np.pi, n)))
    chords = rng.integers(0, n, (n, 2))
    chords = chords[chords[:, 0] != chords[:, 1]]
    i, j = np.concatenate((np.column_stack((np.arange(n - 1), np.arange(1, n))), chords,
                           chords[:3])).T
    root = np.triu(rng.normal(size=(len(i), 3, 3))) + 3.0 * np.eye(3)
    mean = se2.between(truth[i], truth[j]) + noise * rng.normal(size=(len(i), 3))
    kind = np.where(j - i == 1, FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE)
    graph = Graph()
    graph.apply(GraphUpdate(
        truth + rng.normal(size=(n, 3)), Factors(
            i, j, mean, np.swapaxes(root, 1, 2) @ root, kind), fix=[3, 7] if seed % 2 else [0]))
    return graph


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_optimum_is_that_of_the_compiled_optimiser(seed: int) -> None:
    graph = noisy_graph(seed)
    plain = PlainGraph(graph.rows())
    assert plain.energies().chi2 == pytest.approx(graph.energies().chi2, rel=1e-12)
    result = plain.optimize(Start.CHORDAL)
    expected = optimize_from_linear_start(graph, CONFIG)
    if result is None:
        # what is not simple is left to the other one
        np.testing.assert_array_equal(plain.poses, PlainGraph(noisy_graph(seed).rows()).poses)
        return
    assert result.status is Status.CONVERGED
    assert result.chi2 == pytest.approx(plain.energies().chi2, rel=1e-12)
    assert result.chi2 <= expected.chi2 * (1.0 + 1e-9)
    if result.chi2 >= expected.chi2 * (1.0 - 1e-9):
        change = plain.poses - graph.poses
        change[:, 2] = se2.wrap(change[:, 2])
        np.testing.assert_allclose(change, 0.0, atol=1e-6)
    np.testing.assert_array_equal(plain.poses[graph.fixed], graph.rows().poses[graph.fixed])


def test_a_hard_graph_is_left_to_the_other_optimiser() -> None:
    # its chordal start leads to a minimum far from the lowest one
    graph = corridor_graph(1, sigma=0.3)
    plain = PlainGraph(graph.rows())
    before: FloatArray = plain.poses.copy()
    assert plain.optimize(Start.CHORDAL) is None
    np.testing.assert_array_equal(plain.poses, before)


@pytest.mark.parametrize('seed', range(5))
def test_edges_that_do_not_measure_all_coordinates_are_not_covered(seed: int) -> None:
    # the optimum does not determine the last pose of a chain, but rounding hides it from factors
    rng = np.random.default_rng(seed)
    chain, n = np.column_stack((np.arange(4), np.arange(1, 5))), 5
    information = np.repeat(np.diag([3.0, 2.0, 5.0])[None], n - 1, axis=0)
    root = rng.normal(size=(2, 3))
    information[3] = root.T @ root
    graph = Graph()
    graph.apply(GraphUpdate(rng.normal(size=(n, 3)), Factors(
        chain[:, 0], chain[:, 1], rng.normal(size=(4, 3)), information, np.zeros(4, np.int64)),
        fix=[0]))
    assert not PlainGraph.is_covered(graph.rows())
    assert optimize_from_linear_start(graph, CONFIG).status is Status.FAILED


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('start', [Start.CHORDAL, Start.PRESENT])
def test_what_overflows_is_no_result_and_no_warning(start: Start) -> None:
    graph = noisy_graph(0, n=8)
    edges = graph.factors.edges
    refused = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        scale = 10.0 ** rng.uniform(-140.0, 140.0, (len(edges), 1, 1))
        mean = edges.mean * [*10.0 ** rng.uniform(0.0, 90.0, 2), 1.0]
        plain = PlainGraph(graph.rows()._replace(factors=Factors.joined([
            edges.replaced(information=scale * edges.information, mean=mean),
            graph.factors.observed])))
        before = plain.poses.copy()
        if plain.optimize(start) is None:
            refused += 1
            np.testing.assert_array_equal(plain.poses, before)
        assert np.all(np.isfinite(plain.poses))
    assert refused > 0
