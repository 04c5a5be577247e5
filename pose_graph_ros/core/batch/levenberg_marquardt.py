# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The loop of the batch optimisation: Gauss-Newton, with Levenberg-Marquardt damping if needed.

Every iteration solves `(H + lambda D) dx = -b`. D is diagonal and holds the information that the
constraints of a node have on its position and on its heading, which makes the damping independent
of units (Marquardt 1963). With lambda = 0 the step is that of Gauss-Newton.

chi2 may rise for up to `UPHILL_STEPS` Gauss-Newton steps in a row, since the path to a minimum can
cross a ridge that no damped step crosses. If chi2 is not below its lowest value after these, the
best poses are restored and lambda grows until a step, or half of it, lowers chi2. Each step that
lowers chi2 reduces lambda, which is set to 0 below `LEAST_DAMPING` and after `DAMPED_STEPS`.
"""

from collections.abc import Generator
from enum import Enum
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch import gauss_newton as gn
from pose_graph_ros.core.batch.outcome import (
    CHORD_RATIO,
    has_converged,
    KEEP_RATIO,
    UPHILL_STEPS,
)
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.solver_config import SolverConfig

# Damping lambda after the first rejected step, its factor of growth after each further one and of
# decay after each accepted one, the value below which it is set to 0, and the largest value.
FIRST_DAMPING = 1e-5
DAMPING_GROWTH = 10.0
DAMPING_DECAY = 0.1
LEAST_DAMPING = 1e-9
LARGEST_DAMPING = 1e12
# Number of damped steps in a row after which one without damping is tried again.
DAMPED_STEPS = 10
# Number of damped steps, each of which lowers chi2 by less than this fraction, until the
# optimisation ends: where residuals are so large that only short steps lower chi2, thousands of
# them would change it no more than the rounding of the measurements does.
SLOW_STEPS, SLOW = 10, 1e-9
# Number of steps that change chi2 by rounding only and do not become shorter, until convergence.
LEVEL_STEPS = 2
# Where no step lowers chi2, the optimisation has stalled if the linear model predicts a decrease
# by more than this fraction of chi2 (of 1 if chi2 is smaller), and has converged otherwise. After
# the last iteration it has converged below the second, and it ends early below the third.
STALL = 1e-6
AT_THE_END = 1e-9
LEAST_DECREASE = 1e-16


class Termination(Enum):
    """Why the iterations ended."""

    CONVERGED = 0
    MAX_ITERATIONS = 1
    STALLED = 2
    UNDETERMINED = 3
    """H is singular: a node is not determined."""


class Minimum(NamedTuple):
    """Result of `minimize`."""

    termination: Termination
    iterations: int
    """Number of steps."""
    chi2: float


def minimize(
    head: tb.IntHead, chi2: float, config: SolverConfig,
) -> Generator[None, None, Minimum]:
    """
    Return the result of moving all nodes to a local minimum of chi2, after a pause at each step.

    Unless the result is UNDETERMINED, the poses are those of the lowest chi2 found and the tables
    are in the state after a step of the smoother.

    Parameters
    ----------
    head : ndarray, head of tables that hold the cliques of the whole graph (`symbolic.plant`)
    chi2 : float, chi2 at the present poses
    config : SolverConfig

    """
    n_nodes = int(head[tb.N_NODES])
    right, best = np.empty((n_nodes, 3)), np.empty((n_nodes, 3))
    gn.keep_poses(head, best)
    end, iterations, uphill = Termination.MAX_ITERATIONS, 0, 0
    solved = False  # whether any factorisation succeeded
    rejected = False  # whether any step was rejected
    chord = False  # whether the next step is a chord step
    current = False  # whether the tree is that of the best poses, without damping
    damping = 0.0
    n_damped = n_level = n_slow = 0
    rounding, shortest, previous, last_damping = 0.0, math.inf, math.inf, 0.0
    while iterations < config.max_iterations:
        yield
        trial = math.inf
        length = _step(head, damping, right, chord=chord)
        if length < math.inf:
            solved = True
            if rejected and damping == uphill == 0 and not chord and (
                    gn.product_with_step(head, right) < LEAST_DECREASE * max(chi2, 1.0)):
                end = Termination.CONVERGED
                break
            trial, rounding = gn.evaluate(head, right)
            if damping > 0.0 and not trial <= chi2 + rounding < math.inf:
                gn.halve_step(head, best)
                trial, rounding = gn.evaluate(head, right)
        lower = trial <= chi2 + rounding
        current = lower and damping == 0.0
        if lower:
            if not (current and chi2 - trial <= rounding):
                n_level, shortest = 0, math.inf
            elif length >= shortest:
                n_level += 1
            shortest = min(shortest, length)
            slow = damping > 0.0 and chi2 - trial < SLOW * max(chi2, 1.0)
            n_slow = n_slow + 1 if slow else 0
            chi2 = trial
            gn.keep_poses(head, best)
            iterations += 1
            # an uphill step or stronger damping before this step changes its length
            comparable = uphill == 0 and damping <= last_damping
            if n_level >= LEVEL_STEPS or n_slow >= SLOW_STEPS or (
                    comparable and has_converged(length, previous, config.step_tolerance)):
                end = Termination.CONVERGED
                break
            chord = comparable and damping == 0.0 and previous < math.inf and (
                length < (CHORD_RATIO if chord else KEEP_RATIO) * previous)
            last_damping = damping
            n_damped = n_damped + 1 if damping > 0.0 else 0
            damping *= DAMPING_DECAY
            if damping < LEAST_DAMPING or n_damped >= DAMPED_STEPS:
                damping, n_damped = 0.0, 0
            uphill, previous = 0, length
        elif (damping == 0.0 and not chord and trial < math.inf
              and uphill < UPHILL_STEPS and iterations + 1 < config.max_iterations):
            iterations += 1
            uphill, previous = uphill + 1, length
        else:
            gn.put_poses(head, best)
            gn.evaluate(head, right)
            rejected = True
            if not chord:
                damping = max(FIRST_DAMPING, damping * DAMPING_GROWTH)
                if damping > LARGEST_DAMPING:
                    end = Termination.STALLED if solved else Termination.UNDETERMINED
                    break
            # a rejected chord step is repeated with a new factorisation before any damping
            chord, uphill = False, 0
    # after a rejected step short steps may mean that it is stuck where an error is at pi
    at_best = current and not rejected and end is not Termination.MAX_ITERATIONS
    if not at_best and end is not Termination.UNDETERMINED:
        gn.put_poses(head, best)
        end = _refactorized(head, best, end, chi2)
    if end is not Termination.UNDETERMINED:
        gn.settle(head)
    return Minimum(end, iterations, chi2)


def _step(head: tb.IntHead, damping: float, right: FloatArray, *, chord: bool) -> float:
    """Move all nodes; return the largest change of a coordinate, infinite if H is singular."""
    if chord:
        return float(gn.chord_step(head, right))
    gn.linearize(head)
    if not gn.eliminate(head, damping):
        return math.inf
    return float(gn.gauss_newton_step(head))


def _refactorized(
    head: tb.IntHead, best: FloatArray, end: Termination, chi2: float,
) -> Termination:
    """Eliminate all cliques at the best poses without damping; return the final termination."""
    gn.linearize(head)
    if not gn.eliminate(head, 0.0):
        return Termination.UNDETERMINED
    right = np.empty_like(best)
    gn.evaluate(head, right)
    gn.gauss_newton_step(head)
    # b^T H^-1 b, the decrease of a quadratic chi2
    predicted = gn.product_with_step(head, right)
    gn.put_poses(head, best)
    least = AT_THE_END if end is Termination.MAX_ITERATIONS else STALL
    if not predicted > least * max(chi2, 1.0):
        return Termination.CONVERGED
    return Termination.STALLED if end is Termination.CONVERGED else end
