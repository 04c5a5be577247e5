# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Factors on sigmas by all residuals together: by their law, on drives and on a known graph."""

from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.replay import CLOSURES
from pose_graph_ros.cli.run.document import read_document
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.offline import variance_components as vc
from pose_graph_ros.offline.source_residuals import inverse


def laps(seed: int, times: tuple[float, float]) -> vc.Constraints:
    """A graph at the truth, whose edges have errors of so many sigmas: odometry, closures."""
    rng, n = np.random.default_rng(seed), 120
    angle = np.arange(n) * 2.0 * np.pi / 40
    poses = np.column_stack((10.0 * np.cos(angle), 10.0 * np.sin(angle), angle + np.pi / 2))
    i = np.concatenate((np.arange(n - 1), np.arange(n - 40)))
    j = np.concatenate((np.arange(1, n), np.arange(40, n)))
    sigmas = np.where((j - i == 1)[:, None], (0.05, 0.02, 0.02), (0.2, 0.2, 0.1))
    factors = np.where(j - i == 1, *times)[:, None]
    turn = poses[i, 2]
    chord = poses[j, :2] - poses[i, :2]
    mean = np.column_stack((np.cos(turn) * chord[:, 0] + np.sin(turn) * chord[:, 1],
                            np.cos(turn) * chord[:, 1] - np.sin(turn) * chord[:, 0],
                            poses[j, 2] - turn))
    kinds = np.where(j - i == 1, FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE)
    graph = Graph()
    graph.apply(GraphUpdate(hidden=poses, fix=[0], factors=Factors(
        i, j, mean + factors * sigmas * rng.normal(size=mean.shape),
        np.array([np.diag(each**-2.0) for each in sigmas]), kinds)))
    return vc.constraints(graph)


def test_the_intervals_hold_the_true_factors_in_95_percent_of_all_runs() -> None:
    times, inside = (2.0, 0.7), np.zeros(2)
    for seed in range(60):
        data = laps(seed, times)
        closure = np.arange(len(data.errors)) >= 119
        claimed = inverse(data.information, data.measured)
        found = vc.restricted_likelihood(data, np.array([
            claimed * mask[:, None, None] for mask in (~closure, closure)]), 0.0 * claimed)
        assert found is not None
        for k, true in enumerate(times):
            ratio, low, high, independent = found.of([k]).values()
            assert low < ratio < high < 2.0 * low
            assert independent < 3.0 * np.sum(closure if k else ~closure)
            inside[k] += low < true < high
    assert np.all(inside >= 52)


@pytest.mark.parametrize('world', ['hall', 'grid'])
def test_closures_that_are_honest_are_not_found_wrong_and_those_that_claim_a_third_are(
    world: str, tmp_path: Path,
) -> None:
    for claim, name in ((1.0, 'honest'), (1.0 / 3.0, 'third')):
        bag, run = tmp_path / name, tmp_path / f'{name}_run'
        assert main(['simulate', str(bag), '--world', world, '--duration', '500', '--seed', '3',
                     '--claimed-sigma', f'/{CLOSURES}:{claim}']) == 0
        assert main(['replay', str(bag), '-o', str(run), '--odom', '/odom']) == 0
        data = read_document(run / 'run.json')
        source = next(each for each in data['sources'] if each['name'] == CLOSURES)
        assert source['low'] < 1.05 / claim
        assert source['high'] > 0.95 / claim
        texts = [each['text'] for each in data['findings'] if f'{CLOSURES}.covariance_scale' in (
            each['text'])]
        assert len(texts) == (0 if claim == 1.0 else 1)
