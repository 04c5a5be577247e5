# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Factors on the sigmas of odometry and of closures are found from closures alone."""

import numpy as np
import pytest

from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.odometry.motion import Motion, odometry_covariance
from pose_graph_ros.offline.tuning.closure_fit import ClosureProblem, fit_closures
from pose_graph_ros.offline.tuning.fit import Found
from pose_graph_ros.offline.tuning.likelihood import Role

LAP, N, EVERY = 40, 320, 4


def found(odometry: float, closures: float, seed: int) -> dict[Role, Found]:
    """Drive in circles with so many times the noise that is claimed."""
    generator = np.random.default_rng(seed)
    step = np.array([1.0, 0.0, 2.0 * np.pi / LAP])
    claimed = odometry_covariance(OdometryNoise(), Motion(step, 1.0, step[2]))
    errors = odometry * generator.normal(size=(N, 3)) @ np.linalg.cholesky(claimed).T
    truth = [np.zeros(3)]
    for _ in range(N - 1):
        truth.append(se2.compose(truth[-1], step))
    poses, covariance = np.array(truth), np.diag([0.01, 0.01, 3e-4])
    ends = np.arange(LAP, N, EVERY)
    loops = se2.compose(se2.between(poses[ends - LAP], poses[ends]), closures * generator.normal(
        size=(len(ends), 3)) * np.sqrt(np.diagonal(covariance)))
    i, j = np.append(np.arange(N - 1), ends - LAP), np.append(np.arange(1, N), ends)
    means = np.concatenate((se2.compose(step, errors[1:]), loops))
    information = np.concatenate((np.tile(np.linalg.inv(claimed), (N - 1, 1, 1)),
                                  np.tile(np.linalg.inv(covariance), (len(ends), 1, 1))))
    graph = Graph()
    graph.apply(GraphUpdate(hidden=poses, fix=(0,), factors=Factors(
        i, j, means, information,
        np.where(np.arange(len(i)) < N - 1, FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE))))
    # the cost is that of the linear problem, the same at the truth and at the optimum
    return {each.parameter.role: each for each in fit_closures(ClosureProblem(graph)).found}


@pytest.mark.parametrize('seed', [1, 2])
@pytest.mark.parametrize(('odometry', 'closures'), [(1.0, 1.0), (2.5, 1.0), (1.0, 3.0)])
def test_the_factors_are_found(odometry: float, closures: float, seed: int) -> None:
    of = found(odometry, closures, seed)
    for role, true in ((Role.ODOMETRY, odometry), (Role.CLOSURE, closures)):
        assert 0.8 * true < of[role].value < 1.25 * true
        assert of[role].low < 1.1 * true
        assert of[role].high > 0.9 * true
        assert of[role].kept == (true == 1.0)
