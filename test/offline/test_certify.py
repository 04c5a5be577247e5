# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Certificates of global optimality against dense matrices and many starts."""


from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import ComplexArray, FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.offline.certify import certify, examined, minimized, Verdict
from pose_graph_ros.offline.chordal_objective import (
    formulate,
    Formulation,
    NotCoveredError,
    QuadraticForm,
)


def ring(n: int, winding: int) -> Graph:
    """Return a regular polygon without noise, its headings wound a number of times too often."""
    i = np.arange(n)
    turn = 2.0 * np.pi / n
    poses = np.zeros((n, 3))
    poses[:, 2] = se2.wrap(i * turn * (1 + winding))
    graph = Graph()
    graph.apply(GraphUpdate(
        poses, Factors(i, (i + 1) % n, np.tile((1.0, 0.0, turn), (n, 1)),
                     np.tile(np.diag((1.0, 1.0, 10.0)), (n, 1, 1)), np.zeros(n, np.int64)),
        fix=[0]))
    return graph


def random_graph(seed: int, noise: float, n: int = 12) -> Graph:
    """Return a graph at its true poses: a chain with chords, observed and with fixed nodes."""
    rng = np.random.default_rng(seed)
    truth = np.column_stack((rng.uniform(-5.0, 5.0, (n, 2)), rng.uniform(-np.pi, np.pi, n)))
    far = rng.integers(0, n, (n, 2))
    far = far[far[:, 0] != far[:, 1]]
    i, j = np.concatenate((np.column_stack((np.arange(n - 1), np.arange(1, n))), far)).T
    m, n_observed = len(i), 3
    root = np.triu(rng.normal(size=(m, 3, 3))) + 2.0 * np.eye(3)
    information = np.swapaxes(root, 1, 2) @ root
    error = rng.normal(size=(m, 3)) * noise
    kind = np.full(m, FactorKind.LOOP_CLOSURE)
    node, offset = rng.integers(0, n, n_observed), rng.uniform(-1.0, 1.0, (n_observed, 3))
    mean = se2.compose(truth[node], offset) + rng.normal(size=(n_observed, 3)) * noise
    mean[0, 2] = offset[0, 2] = 0.0
    weights = np.tile(np.eye(3), (n_observed, 1, 1))
    weights[0, 2, 2] = 0.0
    graph = Graph()
    graph.apply(GraphUpdate(
        truth, Factors.joined([
            Factors(i, j, se2.between(truth[i], truth[j]) + error, information, kind),
            Factors.on(node, offset, mean, weights, [
                FactorKind.POSITION, *[FactorKind.GLOBAL_POSE] * (n_observed - 1)])]),
        fix=[2, 5] if seed % 2 else [0]))
    return graph


def slow_cost(graph: Graph, poses: FloatArray) -> float:
    """Return the objective at poses, from the errors (3.48) and (3.52)."""
    total = 0.0
    observed = graph.factors.observed
    found = se2.compose(poses[observed.i], observed.offset)
    edges = graph.factors.edges
    rows = [(e, matrix) for e, matrix in zip(
        graph.errors(edges, poses), edges.weighted_information, strict=True)]
    rows += [(e, matrix) for e, matrix in zip(
        found - observed.mean, observed.weighted_information, strict=True)]
    for error, matrix in rows:
        block = matrix[:2, :2]
        tau = 2.0 / np.trace(np.linalg.inv(block))
        total += tau * np.sum(error[:2]**2) + matrix[2, 2] * 4.0 * np.sin(error[2] / 2.0)**2
    return total


def dense(form: Formulation) -> ComplexArray:
    """Return Q as a dense matrix, from the definition of the objective."""
    n = form.n_unknowns
    matrix = np.zeros((2 * n, 2 * n), dtype=np.complex128)
    for k in range(len(form.i)):
        i, j = form.i[k], form.j[k]
        place, turn = np.zeros(2 * n, complex), np.zeros(2 * n, complex)
        place[j] += 1.0
        place[i] -= 1.0
        place[n + j] += form.arm_j[k]
        place[n + i] -= form.arm_i[k]
        turn[n + j] += 1.0
        turn[n + i] -= form.rotation[k]
        for row, weight in ((place, form.tau[k]), (turn, form.kappa[k])):
            matrix += weight * np.outer(row.conj(), row)
    t, z = slice(1, n), slice(n, 2 * n)
    return np.asarray(matrix[z, z] - matrix[z, t] @ np.linalg.solve(matrix[t, t], matrix[t, z]))


seeds = st.integers(0, 10_000)


@settings(max_examples=20, deadline=None)
@given(seeds, st.sampled_from((0.0, 0.1, 1.0)))
def test_the_objective_is_chi2_with_chords_and_isotropic(seed: int, noise: float) -> None:
    graph = random_graph(seed, noise)
    form = formulate(graph)
    quadratic = QuadraticForm(form)
    z = form.headings(graph.poses)[:, None]
    poses = form.poses(quadratic.positions(z)[:, 0], z[:, 0])
    np.testing.assert_allclose(poses[graph.fixed], graph.poses[graph.fixed])
    assert quadratic.cost(z) == pytest.approx(slow_cost(graph, poses), rel=1e-9, abs=1e-9)
    # the positions are the best ones for these headings
    rng = np.random.default_rng(seed)
    for _ in range(5):
        other = poses.copy()
        other[~graph.fixed, :2] += rng.normal(size=(int(np.sum(~graph.fixed)), 2))
        assert slow_cost(graph, other) > quadratic.cost(z)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_the_gradient_is_that_of_differences(seed: int) -> None:
    form = formulate(random_graph(seed, 0.3))
    quadratic = QuadraticForm(form)
    rng = np.random.default_rng(seed)
    z = np.exp(1j * rng.uniform(-np.pi, np.pi, (quadratic.n, 1)))
    change = rng.normal(size=z.shape)
    slope = 2.0 * np.vdot(1j * z * change, quadratic.product(z)).real
    step = 1e-5
    ahead, behind = (quadratic.cost(z * np.exp(1j * s * change)) for s in (step, -step))
    assert slope == pytest.approx((ahead - behind) / (2.0 * step), rel=1e-5, abs=1e-4)
    np.testing.assert_allclose(quadratic.product(z), dense(form) @ z, rtol=1e-8, atol=1e-8)


@settings(max_examples=25, deadline=None)
@given(seeds, st.sampled_from((0.05, 0.5, 3.0)))
def test_the_smallest_eigenvalue_is_that_of_the_dense_matrix(seed: int, noise: float) -> None:
    form = formulate(random_graph(seed, noise))
    quadratic = QuadraticForm(form)
    rng = np.random.default_rng(seed)
    z = minimized(quadratic, np.exp(1j * rng.uniform(-np.pi, np.pi, (quadratic.n, 1))))
    q = dense(form)
    diagonal = (z.conj() * (q @ z)).real.ravel()
    values = np.linalg.eigvalsh(q - np.diag(diagonal))
    spectrum = examined(quadratic, z)
    assert spectrum.smallest is not None
    if values[0] < -1e-4:
        assert not spectrum.positive
        assert spectrum.smallest == pytest.approx(values[0], rel=1e-3)
        assert spectrum.bound <= np.sum(diagonal) + quadratic.n * values[0] + 1e-9
        assert spectrum.bound >= np.sum(diagonal) + 1.1 * quadratic.n * values[0]
    elif values[1] > 1e-4:
        assert spectrum.positive
        assert spectrum.smallest == pytest.approx(values[1], rel=1e-3)
        assert spectrum.bound == pytest.approx(np.sum(diagonal), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize('n', [10, 40])
def test_a_ring_wound_too_often_is_not_certified_and_the_right_one_is_found(n: int) -> None:
    graph = ring(n, 1)
    form = formulate(graph)
    quadratic = QuadraticForm(form)
    z = minimized(quadratic, form.headings(graph.poses)[:, None])
    stuck = quadratic.cost(z)
    assert stuck > 1.0
    assert not examined(quadratic, z).positive

    found = certify(form, graph.poses)
    assert found.near == pytest.approx(stuck)
    assert found.is_lower
    assert found.verdict is Verdict.CERTIFIED
    assert found.chi2 < 1e-8
    assert found.rank > 1
    graph.set_poses(found.poses)
    assert graph.energies().chi2 < 1e-8
    # that one is certified at once
    again = certify(form, found.poses)
    assert (again.verdict, again.rank, again.is_lower) == (Verdict.CERTIFIED, 1, False)


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_no_start_leads_below_the_bound(seed: int) -> None:
    # so much noise that often the relaxation is not tight
    graph = random_graph(seed, 3.0, 6)
    form = formulate(graph)
    quadratic = QuadraticForm(form)
    found = certify(form, graph.poses)
    rng = np.random.default_rng(seed)
    starts = np.exp(1j * rng.uniform(-np.pi, np.pi, (20, quadratic.n, 1)))
    best = min(quadratic.cost(minimized(quadratic, z)) for z in starts)
    assert best >= found.chi2 - found.gap - 1e-6
    if found.verdict is Verdict.CERTIFIED:
        assert best >= found.chi2 * (1.0 - 1e-5) - 1e-5


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_the_objective_is_nowhere_above_chi2_if_it_says_so(seed: int) -> None:
    graph = random_graph(seed, 0.5)
    assert not formulate(graph).below_chi2
    edges, observed = graph.factors.edges, graph.factors.observed
    rng = np.random.default_rng(seed)
    isotropic = Graph()
    isotropic.apply(GraphUpdate(
        graph.poses.copy(), Factors.joined([
            edges.replaced(information=np.eye(3) * rng.uniform(0.1, 9.0, (len(edges), 1, 1))),
            observed]), fix=np.flatnonzero(graph.fixed).tolist()))
    form = formulate(isotropic)
    assert form.below_chi2
    quadratic = QuadraticForm(form)
    for _ in range(5):
        poses = np.column_stack((rng.uniform(-5.0, 5.0, (12, 2)), rng.uniform(-np.pi, np.pi, 12)))
        poses[isotropic.fixed] = isotropic.poses[isotropic.fixed]
        assert quadratic.cost(form.headings(poses)[:, None]) <= isotropic.energies(poses).chi2


@pytest.mark.parametrize(('what', 'size', 'reason'), [
    ('landmarks', 2, 'landmarks'), ('biases', 3, 'biases'), ('hidden', 3, 'join 1 node')])
def test_what_the_objective_does_not_cover_is_said(what: str, size: int, reason: str) -> None:
    graph = ring(4, 0)
    graph.apply(GraphUpdate(**{what: np.zeros((1, size))}))
    with pytest.raises(NotCoveredError, match=reason):
        formulate(graph)
