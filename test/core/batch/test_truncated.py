# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sets of believed constraints: graduated non-convexity and the truncated cost."""

from itertools import product

from false_loops import Drive, laps
from hypothesis import given, strategies as st
import numpy as np
import pytest
from random_graphs import slow_edge
from scipy.optimize import least_squares

from pose_graph_ros.core.batch.optimizer import to_the_end
from pose_graph_ros.core.batch.truncated import LIMITS, Surrogate, TruncatedProblem
from pose_graph_ros.core.geometry.se2 import FloatArray


def problem_of(drive: Drive) -> TruncatedProblem:
    return TruncatedProblem(drive.graph, drive.closures)


# --- The weights -----------------------------------------------------------------------------

@given(st.sampled_from(Surrogate), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_a_weight_minimises_what_it_was_derived_from(
    surrogate: Surrogate, share: float, mu: float,
) -> None:
    (weight,) = surrogate.weights(np.array([share]), mu)
    w = np.append(np.linspace(0.0, 1.0, 2001), weight)
    if surrogate is Surrogate.TRUNCATED:
        penalty = mu * (1.0 - w) / (mu + w)
    else:
        penalty = mu * (1.0 - np.sqrt(w)) ** 2
    cost = w * share + penalty
    assert cost[-1] <= np.min(cost) * (1.0 + 1e-9)


def test_the_surrogates_end_at_the_truncated_cost_and_at_that_of_geman_mcclure() -> None:
    share = np.array([0.0, 0.5, 0.99, 1.01, 4.0, 1e6])
    assert Surrogate.TRUNCATED.weights(share, 1e6).round().tolist() == [1, 1, 1, 0, 0, 0]
    np.testing.assert_allclose(
        Surrogate.GEMAN_MCCLURE.weights(share, 1.0), 1.0 / (1.0 + share) ** 2)


# --- Against a dense solver, one constraint at a time ----------------------------------------

class Dense:
    """The same problem with SciPy's dense least squares."""

    def __init__(self, problem: TruncatedProblem, start: FloatArray) -> None:
        graph = problem.graph
        self.edges, self.closures = graph.factors.edges, len(graph.factors.edges) - len(problem)
        self.start = start
        self.root = np.linalg.cholesky(self.edges.information).transpose(0, 2, 1)

    def errors(self, poses: FloatArray) -> FloatArray:
        return np.array([self.root[k] @ slow_edge(
            poses[self.edges.i[k]], poses[self.edges.j[k]], self.edges.mean[k])[0]
            for k in range(len(self.edges))])

    def solved(self, weights: FloatArray) -> FloatArray:
        factor = np.sqrt(np.append(np.ones(self.closures), weights))

        def residuals(flat: FloatArray) -> FloatArray:
            poses = np.vstack((self.start[:1], flat.reshape(-1, 3)))
            return (factor[:, None] * self.errors(poses)).ravel()

        found = least_squares(residuals, self.start[1:].ravel(), method='lm', xtol=1e-12)
        self.start = np.vstack((self.start[:1], found.x.reshape(-1, 3)))
        return self.start

    def squares(self, poses: FloatArray) -> FloatArray:
        return np.sum(self.errors(poses) ** 2, axis=1)

    def truncated(self, believed: FloatArray) -> float:
        squares = self.squares(self.solved(believed.astype(np.float64)))
        return float(np.sum(squares[:self.closures])
                     + np.sum(np.minimum(squares[self.closures:], LIMITS[3])))

    def gnc(self) -> FloatArray:
        share = self.squares(self.solved(np.zeros(len(self.edges) - self.closures)))[
            self.closures:] / LIMITS[3]
        mu = 1.0 / (2.0 * np.max(share) - 1.0)
        while True:
            weights = np.clip(np.sqrt(mu * (mu + 1.0) / share) - mu, 0.0, 1.0)
            share = self.squares(self.solved(weights))[self.closures:] / LIMITS[3]
            if np.max(np.minimum(weights, 1.0 - weights)) < 1e-3:
                return share <= 1.0
            mu *= 1.4


def small(seed: int) -> TruncatedProblem:
    """Return four right and three wrong closures on 15 nodes."""
    return problem_of(laps(seed, n_laps=2, n=7, every=2, n_wrong=3))


def test_the_set_is_that_of_dense_graduated_non_convexity() -> None:
    problem = problem_of(laps(0, n_laps=2, n=5, every=2, n_wrong=2))
    dense = Dense(problem, problem.graph.poses.copy())
    choice = to_the_end(problem.graduated(Surrogate.TRUNCATED))
    np.testing.assert_array_equal(choice.believed, dense.gnc())
    assert choice.cost == pytest.approx(dense.truncated(choice.believed), rel=1e-6)


@pytest.mark.parametrize('seed', range(6))
def test_no_subset_has_a_lower_cost(seed: int) -> None:
    problem = small(seed)
    costs = {subset: choice.cost for subset in product((False, True), repeat=len(problem))
             if (choice := to_the_end(problem.choice(np.array(subset)))) is not None}
    for surrogate in Surrogate:
        choice = to_the_end(problem.improved(to_the_end(problem.graduated(surrogate))))
        assert choice.cost == pytest.approx(min(costs.values()), rel=1e-6)


# --- What a problem is -----------------------------------------------------------------------

def test_right_closures_are_believed_and_wrong_ones_not() -> None:
    drive = laps(3, n_wrong=8)
    problem, before = problem_of(drive), drive.graph.poses.copy()
    choices = [to_the_end(problem.choice(drive.right))]
    choices += [to_the_end(problem.improved(to_the_end(problem.graduated(surrogate))))
                for surrogate in Surrogate]
    for choice in choices:
        np.testing.assert_array_equal(choice.believed, drive.right)
        assert drive.error(choice.poses) < 0.3 * drive.error(before)
    # the cost counts what is doubted with its limit
    all_, none = (to_the_end(problem.choice(np.full(len(problem), each)))
                  for each in (True, False))
    assert choices[0].cost < min(all_.cost, none.cost)
    assert none.cost == pytest.approx(np.sum(np.minimum(none.energies, problem.limits)), abs=1e-9)
