# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Biases: errors of the edges to them, their rows in the graph, and correlated noise."""

from pathlib import Path

import numpy as np
import pytest
from random_graphs import (
    random_graph,
)
from scipy.optimize import least_squares
from slow_smoother import EXACT

from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import factors
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.io.g2o import read_g2o, write_g2o
from pose_graph_ros.core.odometry.motion import bent
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

ODOMETRY = np.diag([400.0, 900.0, 2500.0])
THOROUGH = SolverConfig(max_iterations=200, step_tolerance=1e-11)


def prior(bias: int) -> Factors:
    return Factors.on([bias], None, np.zeros((1, 3)), [np.eye(3)], [FactorKind.GLOBAL_POSE])


def link(newer: int, older: int, phi: float) -> Factors:
    """Return one step of a first-order Gauss-Markov process of unit variance."""
    return Factors([newer], [older], np.zeros((1, 3)), [np.eye(3) / (1.0 - phi**2)],
                 [FactorKind.BIAS], constants=[[0.0, 0.0, phi, phi]])


def fix(
    node: int, bias: int, where: FloatArray, offset: FloatArray, sigmas: FloatArray,
) -> Factors:
    """Return the edge of a measured position, with the sigmas of white noise and bias."""
    weight = sigmas[0]**-2.0
    return Factors([node], [bias], [[*where, 0.0]], [np.diag([weight, weight, 0.0])],
                 [FactorKind.BIAS], constants=[[*offset, sigmas[1], 0.0]])


# --- correlated noise ---------------------------------------------------------------------------

def drive(n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return true poses, and the odometry between them."""
    truth = [np.zeros(3)]
    for _ in range(n - 1):
        move = np.array([1.0, 0.0, rng.normal(0.0, 0.1)])
        truth.append(se2.wrapped(se2.compose(truth[-1], move)))
    poses = np.array(truth)
    moves = se2.between(poses[:-1], poses[1:])
    return poses, moves + rng.normal(size=moves.shape) @ np.diag([0.05, 1.0 / 30.0, 0.02])


@pytest.mark.parametrize('late', [False, True])
def test_a_chain_of_biases_is_noise_with_its_full_covariance(*, late: bool) -> None:
    """Compare with generalized least squares with the dense covariance, without biases."""
    rng, n, phi, s, white = np.random.default_rng(5), 25, 0.9, 1.5, 0.3
    truth, odometry = drive(n, rng)
    lever = np.array([0.7, -0.4])
    covariance = s**2 * phi**np.abs(np.subtract.outer(np.arange(n), np.arange(n))) + (
        white**2 * np.eye(n))
    fixes = se2.transform(truth, np.tile(lever, (n, 1))) + np.linalg.cholesky(
        covariance) @ rng.normal(size=(n, 2))

    smoother = IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(
        hidden=truth[:1], biases=np.zeros((1, 3)),
        factors=Factors.joined([
            fix(0, 1, fixes[0], lever, np.array([white, s])), prior(1)]), fix=[0]))
    smoother.update(GraphUpdate(free=[0], factors=Factors.on(
        [0], None, truth[:1], [np.diag([1e-6, 1e-6, 100.0])], [FactorKind.GLOBAL_POSE])))
    nodes, bias = [0], 1
    for k in range(1, n):
        smoother.extend(odometry[k - 1], ODOMETRY)
        nodes.append(smoother.graph.newest_pose)
        if not late:
            bias = add_fix(smoother, nodes[k], bias, phi, fixes[k], lever, white, s)
    for k in range(1, n if late else 0):
        bias = add_fix(smoother, nodes[k], bias, phi, fixes[k], lever, white, s)

    root, whiten = np.linalg.cholesky(ODOMETRY).T, np.linalg.inv(np.linalg.cholesky(covariance))

    def errors(x: FloatArray) -> FloatArray:
        poses = x.reshape(-1, 3)
        moves = factors.errors(poses, Factors(
            np.arange(n - 1), np.arange(1, n), odometry, np.tile(ODOMETRY, (n - 1, 1, 1)),
            [FactorKind.ODOMETRY] * (n - 1)))
        off = fixes - se2.transform(poses, np.tile(lever, (n, 1)))
        first = np.array([1e-3, 1e-3, 10.0]) * (poses[0] - truth[0])
        return np.concatenate(((moves @ root.T).ravel(), (whiten @ off).ravel(), first))

    other = least_squares(
        errors, smoother.poses[nodes].ravel(), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    expected = other.x.reshape(-1, 3)
    off = smoother.poses[nodes] - expected
    off[:, 2] = se2.wrap(off[:, 2])
    np.testing.assert_allclose(off, 0.0, atol=1e-5)
    assert smoother.chi2() == pytest.approx(2.0 * other.cost, rel=1e-9)
    dense = np.linalg.inv(other.jac.T @ other.jac)
    blocks = dense.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    np.testing.assert_allclose(smoother.covariances()[nodes], blocks, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(smoother.newest_covariance(), blocks[-1], rtol=1e-4, atol=1e-6)
    # treated as white noise, the fixes would give much smaller sigmas
    assert np.min(np.sqrt(blocks[:, 0, 0])) > 2.0 * np.hypot(white, s) / np.sqrt(n)


def add_fix(  # noqa: PLR0917
    smoother: IncrementalSmoother, node: int, before: int, phi: float, where: FloatArray,
    lever: FloatArray, white: float, s: float,
) -> int:
    bias = smoother.graph.n_nodes
    result = smoother.update(GraphUpdate(
        biases=phi * smoother.poses[before][None], factors=Factors.joined([
            link(bias, before, phi), fix(node, bias, where, lever, np.array([white, s]))])))
    assert result.status is Status.CONVERGED
    return bias


def test_the_estimate_is_good_all_along_a_drive_with_default_settings() -> None:
    rng, n, phi, s, white = np.random.default_rng(2), 400, 0.99, 1.0, 0.2
    truth, odometry = drive(n, rng)
    smoother, m, bias, nodes = IncrementalSmoother(), np.zeros(2), -1, [0]
    smoother.update(GraphUpdate(hidden=truth[:1], factors=Factors.on(
        [0], None, truth[:1], [np.diag([1.0, 1.0, 100.0])], [FactorKind.GLOBAL_POSE])))
    for k in range(1, n):
        smoother.extend(odometry[k - 1], ODOMETRY)
        nodes.append(smoother.graph.newest_pose)
        m = phi * m + np.sqrt(1.0 - phi**2) * rng.normal(size=2)
        where = truth[k, :2] + s * m + white * rng.normal(size=2)
        if bias < 0:
            bias = smoother.graph.n_nodes
            smoother.update(GraphUpdate(
                biases=np.zeros((1, 3)),
                factors=Factors.joined([
                    fix(nodes[k], bias, where, np.zeros(2), np.array([white, s])),
                    prior(bias)])))
        elif k % 3 == 0:
            bias = add_fix(smoother, nodes[k], bias, phi, where, np.zeros(2), white, s)
        if k % 90 == 0:     # a closure, which moves all newer nodes
            assert smoother.update(GraphUpdate(factors=Factors(
                [nodes[k - 80]], [nodes[k]], [se2.between(truth[k - 80], truth[k])], [ODOMETRY],
                [FactorKind.LOOP_CLOSURE]))).reason == ''
        if k % 40 == 0:
            other = Graph()
            other.fill(smoother.graph.rows()._replace(poses=smoother.poses))
            optimizer.optimize(other, THOROUGH)
            assert -1e-6 < smoother.chi2() - other.energies().chi2 < 0.05
    off = np.hypot(*(smoother.poses[nodes] - truth)[:, :2].T)
    assert np.max(off) < 5.0


# --- batch, starts, files -----------------------------------------------------------------------


def test_a_file_has_no_biases_and_says_so(tmp_path: Path) -> None:
    graph = random_graph(seed=3, fix=(0,), n_biases=2)
    write_g2o(graph, tmp_path / 'graph.g2o')
    text = (tmp_path / 'graph.g2o').read_text(encoding='ascii')
    assert text.startswith(
        '# left out: 2 biases, 7 edges that g2o does not have and 1 observed biases\n')
    read = read_g2o(tmp_path / 'graph.g2o').graph
    same = random_graph(seed=3, fix=(0,))
    np.testing.assert_array_equal(read.poses, same.poses)
    assert '# instead of odometry with a bias and an error of the scale: 7 lines' in text
    np.testing.assert_array_equal(read.factors.edges.mean[:15], same.factors.edges.mean)
    of_odometry = graph.factors.rows(graph.factors.kind == FactorKind.ODOMETRY)
    rate, scale, _ = graph.poses[of_odometry.k].T
    np.testing.assert_allclose(read.factors.edges.mean[15:], se2.wrapped(bent(
        of_odometry.mean, -of_odometry.constants[:, 3] * rate, 1.0 + scale)))


def test_a_file_has_measurements_with_correlated_errors_as_if_these_were_white(
    tmp_path: Path,
) -> None:
    graph = random_graph(seed=3, fix=(0,), n_biases=1)
    bias = int(np.flatnonzero(graph.rows().is_bias)[0])
    white = Factors.on(
        [2, 2], None, [[1.0, 2.0, 0.0], [30.0, 2.0, 0.0]],
        np.tile(np.diag((4.0, 4.0, 0.0)), (2, 1, 1)), [FactorKind.POSITION] * 2)
    first = graph.n_factors
    graph.apply(GraphUpdate(factors=white))
    # an edge to the bias holds the first of them; the second is doubted
    graph.apply(GraphUpdate(
        weigh={first: 0.0, first + 1: 0.0}, factors=Factors(
            [2], [bias], white.mean[:1], np.diag((9.0, 9.0, 0.0))[None], [FactorKind.BIAS],
            constants=[(0.0, 0.0, 0.5, 0.0)])))
    write_g2o(graph, tmp_path / 'graph.g2o')
    lines = (tmp_path / 'graph.g2o').read_text(encoding='ascii').splitlines()
    names = np.cumsum(~graph.rows().is_bias) - 1
    assert names[2] == 2
    assert 'EDGE_PRIOR_SE2_XY 2 1.0 2.0 4.0 0.0 4.0' in lines
    assert '# not used EDGE_PRIOR_SE2_XY 2 30.0 2.0 4.0 0.0 4.0' in lines
