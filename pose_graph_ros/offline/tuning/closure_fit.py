# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Factors on the sigmas of odometry and of loop closures, where nothing else is measured.

The likelihood of all edges of a graph, with the poses integrated out, is to the second order

    -2 log p = r^T W r - g^T H^-1 g + log det H - sum log det W,    H = J^T W J, g = J^T W r,

with errors r and Jacobian J at poses near the optimum and the information W of the edges
(Laplace's approximation; e.g. C. M. Bishop, "Pattern recognition and machine learning", section
4.4). Unlike chi2, it is least at the right factors. Factors that disagree show the sum of their
noise; that of odometry grows with the length of the loop, which tells both apart.
"""

from collections.abc import Callable, Sequence
import math
from typing import Any

import numpy as np
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import splu

from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.offline.residuals.variance_components import constraints
from pose_graph_ros.offline.tuning.fit import decided, Fit, Minimum, minimum
from pose_graph_ros.offline.tuning.likelihood import Parameter, PRIOR_SPREAD, Role

# Largest number of hidden nodes: each evaluation factorises H.
MOST_NODES = 20_000
# Sigma of the logarithm of the factor on the sigmas of closures, before it is seen.
CLOSURE_SPREAD = 1.5


class ClosureProblem:
    """Costs of a graph of odometry and closures as a function of two factors on sigmas."""

    def __init__(self, graph: Graph, tick: Callable[[], None] = lambda: None) -> None:
        self._tick, data = tick, constraints(graph)
        kinds = graph.factors_by_row.kind[data.rows]
        self.n_closures = int(np.sum(kinds == FactorKind.LOOP_CLOSURE))
        """How many closures are believed."""
        # at a factor of 1, of odometry and of closures
        self._parts: list[Any] = []
        for kind in (FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE):
            rows = np.flatnonzero(kinds == kind)
            n = len(rows)
            jacobian = data.jacobian[(3 * rows[:, None] + np.arange(3)).ravel()]
            weights = bsr_array((data.information[rows], np.arange(n), np.arange(n + 1)),
                                shape=(3 * n, 3 * n))
            errors = data.errors[rows].ravel()
            self._parts.append((
                csc_array(jacobian.T @ weights @ jacobian), jacobian.T @ (weights @ errors),
                float(errors @ (weights @ errors)), int(np.sum(data.measured[rows]))))

    def value(self, parameters: Sequence[Parameter], x: FloatArray) -> float:
        """
        Return twice the negative logarithm of the likelihood, with the prior, but for a constant.

        Parameters
        ----------
        parameters : sequence of Parameter, of both factors
        x : ndarray, shape (2,), their logarithms

        """
        given = {each.role: float(value) for each, value in zip(parameters, x, strict=True)}
        logs = [given.get(role, 0.0) for role in (Role.ODOMETRY, Role.CLOSURE)]
        self._tick()
        factors = [math.exp(-2.0 * log) for log in logs]
        hessian, gradient, energy = (
            sum(factor * part[k] for factor, part in zip(factors, self._parts, strict=True))
            for k in range(3))
        solver = splu(hessian, permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                      options={'SymmetricMode': True})
        cost = energy - gradient @ solver.solve(gradient) + np.sum(
            np.log(np.abs(solver.U.diagonal())))
        for log, spread, part in zip(
                logs, (PRIOR_SPREAD, CLOSURE_SPREAD), self._parts, strict=True):
            cost += 2.0 * log * part[3] + (log / spread)**2
        return float(cost)


def fit_closures(problem: ClosureProblem) -> Fit:
    """Return the most likely factors on the sigmas of odometry and of closures."""
    parameters = Parameter(Role.ODOMETRY, 0, 1.0), Parameter(Role.CLOSURE, 0, 1.0)
    best = Minimum(parameters, *minimum(problem, parameters, np.zeros(2)))
    return decided(problem, best, 1.0)
