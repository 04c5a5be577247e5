# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Least squares with some edges that may be wrong: which of them to believe.

The *truncated cost* of a set of believed constraints is

    chi2 of all that is known to be right  +  sum over the others of min(r^2, c^2)

at the poses that minimise chi2 of what is known and of the set. r^2 is the energy of a constraint,
c^2 the value that 99 % of the energies of right ones are below. It compares sets of any size: one
more believed constraint pays if all together bend by less than c^2 for it.

Each set is solved for from the same start, because the minimum that Gauss-Newton ends in after
wrong constraints have bent the graph may be a tangle even where they are all gone again.

`TruncatedProblem.graduated` finds a set without a start that is nearly right (H. Yang,
P. Antonante, V. Tzoumas, L. Carlone, "Graduated non-convexity for robust spatial perception: from
non-minimal solvers to global outlier rejection", RA-L 2020). The truncated cost is the minimum
over weights w in [0, 1] of

    w r^2 + P(w),        P(w) = c^2 (1 - w).

It is replaced by a cost with a control mu that is convex at first and tends to it, in which
weights between 0 and 1 cost less. With s = r^2 / c^2,

    truncated:      P / c^2 = mu (1 - w) / (mu + w),   so w = sqrt(mu (mu + 1) / s) - mu in [0, 1]
    Geman-McClure:  P / c^2 = mu (1 - sqrt(w))^2,      so w = (mu / (mu + s))^2

each w where the derivative by w is zero. mu grows from near 0 to infinity for the truncated
surrogate (where its curvature, -2 mu between the bounds, does not outweigh the rest), and falls
from twice the largest s to 1 for that of Geman-McClure.
"""

from collections.abc import Generator
from enum import Enum
import math
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from pose_graph_ros.core.batch.optimizer import chi2_of, in_parts, Status, to_the_end
from pose_graph_ros.core.config import Loss, SolverConfig
from pose_graph_ros.core.elimination import symbolic
from pose_graph_ros.core.geometry.covariance import scaled
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray, Poses
from pose_graph_ros.core.graph.factors import energies
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.reweighting import costs_and_weights

# Value that 99 % of the energies of right constraints are below, by the rank of the information.
LIMITS: Final = np.array([0.0, 6.635, 9.210, 11.345])
# Factor on mu from step to step of graduated non-convexity.
GRADUATION = 1.4
# Of a set that is compared, and of a step on the way to one.
CONFIG = SolverConfig(max_iterations=60, step_tolerance=1e-6)
ROUGH = SolverConfig(max_iterations=15, step_tolerance=1e-4)


Solution: TypeAlias = Generator[None, None, bool]
"""Solves a graph, and pauses at each iteration; tells whether that was possible."""


class Surrogate(Enum):
    """Cost that tends to the truncated one."""

    TRUNCATED = 'truncated'
    GEMAN_MCCLURE = 'geman_mcclure'

    def weights(self, share: FloatArray, mu: float) -> FloatArray:
        """Return the weights of constraints."""
        if self is Surrogate.GEMAN_MCCLURE:
            return costs_and_weights(Loss.GEMAN_MCCLURE, share, math.sqrt(mu))[1]
        root = np.sqrt(mu * (mu + 1.0) / np.maximum(share, 1e-12))
        return np.clip(root - mu, 0.0, 1.0)

    def first(self, largest: float) -> float:
        """Return mu to begin with, given the largest r^2 / c^2, which is above 1."""
        if self is Surrogate.GEMAN_MCCLURE:
            return min(2.0 * largest, 1e12)
        return max(1.0 / (2.0 * largest - 1.0), 1e-6)


class Choice(NamedTuple):
    """A set of believed constraints."""

    believed: BoolArray  # of the M edges that may be wrong
    energies: FloatArray  # r^2 of the same at the poses
    cost: float  # the truncated cost
    poses: Poses  # those that minimise chi2 of what is believed


Choosing: TypeAlias = Generator[None, None, Choice | None]
"""Looks for a set, and pauses at each iteration; None if the graph cannot be solved."""


class TruncatedProblem:
    """
    A graph with M edges that may be wrong. Their weights and its poses are for trying.

    The graph is changed; the information of the edges, with `ids` without repetition, is that to
    decide by. Each solution starts at `start`, by default at the minimum of chi2 of all that is
    right, from the poses of the graph.
    """

    def __init__(self, graph: Graph, ids: IntArray, start: FloatArray | None = None) -> None:
        self.graph, self.ids = graph, ids
        self.edges = graph.factors_at(ids)
        """What may be wrong; their weights have no meaning."""
        # by the ranks of the information, whatever units it has
        values = np.linalg.eigvalsh(scaled(self.edges.information))
        self.limits = LIMITS[np.sum(values > 1e-9, axis=1)]
        """c^2 of each, shape (M,)."""
        self._weights = self.edges.weight
        self._choices: dict[bytes, Choice] = {}
        """The last sets that were solved for, the newest last."""
        self.start = graph.poses.copy() if start is None else start
        if start is None and to_the_end(self.solve(np.zeros(len(self)), CONFIG)):
            self.start = graph.poses.copy()

    def __len__(self) -> int:
        return len(self.limits)

    def begin_at(self, start: FloatArray) -> None:
        """Solve for all further sets from other poses."""
        self.start = start
        self._choices.clear()

    def solve(self, weights: FloatArray, config: SolverConfig = ROUGH, *,
              go_on: bool = False) -> Solution:
        """Move the graph from the start to the minimum for some weights."""
        self._weigh(weights)
        if not go_on:
            self.graph.set_poses(self.start)
        result = yield from in_parts(self.graph, config)
        return result.status is not Status.FAILED

    def factorisation(self, weights: FloatArray) -> int:
        """Return the number of entries of a factorisation with these weights, shape (M,)."""
        self._weigh(weights)
        return int(symbolic.analyse(self.graph.memory.head).need_f)

    def energies(self) -> FloatArray:
        """Return r^2 at the present poses, shape (M,)."""
        return energies(self.graph.errors(self.edges), self.edges.information)

    def errors(self, numbers: IntArray) -> FloatArray:
        """Return the errors of some of the edges at the present poses, shape (K, 3)."""
        return self.graph.errors(self.edges.rows(numbers))

    def choice(self, believed: BoolArray) -> Choosing:
        """Return a set with its cost; None if it leaves a node undetermined."""
        # retests of different sets often lead to the same one
        key = believed.tobytes()
        choice = self._choices.pop(key, None)
        if choice is None:
            if not (yield from self.solve(believed.astype(np.float64), CONFIG)):
                return None
            squares = self.energies()
            known = chi2_of(self.graph) - float(np.sum(squares[believed]))
            cost = known + float(np.sum(np.minimum(squares, self.limits)))
            choice = Choice(believed.copy(), squares, cost, self.graph.poses.copy())
        self._choices[key] = choice
        if len(self._choices) > 16:
            del self._choices[next(iter(self._choices))]
        return choice

    def near_start(self) -> Choosing:
        """Return a set with poses of no higher truncated cost than the start; None as `choice`."""
        self.graph.set_poses(self.start)
        choice = yield from self.choice(self.energies() <= self.limits)
        return None if choice is None else (yield from self.improved(choice))

    def cost_at(self, poses: FloatArray) -> float:
        """Return the truncated cost of poses, shape (N, 3), whatever is believed."""
        self._weigh(np.zeros(len(self)))
        self.graph.set_poses(poses)
        return chi2_of(self.graph) + float(np.sum(np.minimum(self.energies(), self.limits)))

    def graduated(self, surrogate: Surrogate) -> Choosing:
        """Return the set that graduated non-convexity ends with; None if no step was solved."""
        if not (yield from self.solve(np.zeros(len(self)))):
            return None
        share = self.energies() / self.limits
        largest = float(np.max(share, initial=0.0))
        if largest > 1.0:
            mu = surrogate.first(largest)
            for _ in range(100):
                weights = surrogate.weights(share, mu)
                if not (yield from self.solve(weights)):
                    break
                share = self.energies() / self.limits
                if surrogate is Surrogate.GEMAN_MCCLURE:
                    if mu == 1.0:
                        break
                    mu = max(mu / GRADUATION, 1.0)
                elif np.max(np.minimum(weights, 1.0 - weights), initial=0.0) < 1e-3:
                    break   # all weights are final
                else:
                    mu *= GRADUATION
        return (yield from self.choice(share <= 1.0))

    def improved(self, choice: Choice) -> Generator[None, None, Choice]:
        """
        Return a set that no retest lowers the cost of.

        All that is within its limit at the poses of the set is believed, and nothing else, as long
        as that lowers the cost.
        """
        for _ in range(20):
            believed = choice.energies <= self.limits
            if np.array_equal(believed, choice.believed):
                break
            other = yield from self.choice(believed)
            if other is None or other.cost >= choice.cost:
                break
            choice = other
        return choice

    def _weigh(self, weights: FloatArray) -> None:
        changed = np.flatnonzero(weights != self._weights)
        self.graph.apply(GraphUpdate(weigh=dict(zip(
            self.ids[changed].tolist(), weights[changed].tolist(), strict=True))))
        self._weights = weights.copy()
