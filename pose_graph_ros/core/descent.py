# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The loop of the batch optimisation: Gauss-Newton and Levenberg-Marquardt in one.

Every iteration solves `(H + lambda D) dx = -b`, D the information that the constraints of a node
have on its position and on its heading. With lambda = 0 that is Gauss-Newton. A step that raises
chi2 is not final: Gauss-Newton may go uphill for a few steps, since the way to the minimum can
lead over a ridge that no damped step crosses, and goes back if it has not come out lower by then.
After that lambda grows until a step lowers chi2. Every step that does lets lambda shrink, and
below a bound it becomes 0 again.

Scaling by D makes the damping independent of units (Marquardt 1963).
"""

from enum import Enum
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import gauss_newton as gn, tables as tb
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.se2 import FloatArray

# Damping that the first refused step brings, its growth and its decay, and where it is dropped.
FIRST_DAMPING = 1e-5
DAMPING_GROWTH = 10.0
DAMPING_DECAY = 0.1
LEAST_DAMPING = 1e-9
LARGEST_DAMPING = 1e12
# Steps in a row for which chi2 may be above the lowest so far, and how far [times the lowest].
UPHILL_STEPS = 2
UPHILL_LIMIT = 2.0
# Where no step lowers chi2 by this fraction of it (of at least 1) although one should, there is no
# minimum.
STALL = 1e-6
# Steps below this that no longer shrink are rounding noise [m, rad].
NOISE_STEP = 1e-7
# What is left is taken for below the tolerance if it should be below this fraction of it.
SURE = 0.1
# The factorisation is kept for the next iteration if steps shrink by this factor with new ones,
# and goes on being kept while they shrink by that one with an old one.
KEEP_RATIO = 0.1
CHORD_RATIO = 0.4


class End(Enum):
    """Why an optimisation ended."""

    CONVERGED = 0
    OUT_OF_ITERATIONS = 1
    STALLED = 2
    UNDETERMINED = 3


class Descent(NamedTuple):
    """What `descend` did."""

    end: End
    iterations: int
    chi2: float


def descend(head: tb.IntHead, chi2: float, config: SolverConfig) -> Descent:
    """
    Move all nodes to the minimum of chi2 that lies downhill.

    The cliques of the graph must have been planted. The poses are the best that were met, the
    tables are as after a step of the smoother; neither if the end is UNDETERMINED.

    Parameters
    ----------
    head : ndarray
    chi2 : float
        At the poses.
    config : SolverConfig

    """
    n_nodes = int(head[tb.N_NODES])
    right, best = np.empty((n_nodes, 3)), np.empty((n_nodes, 3))
    gn.keep_poses(head, best)
    end, iterations, uphill = End.OUT_OF_ITERATIONS, 0, 0
    solved = False  # has any factorisation worked?
    keep = False  # is the next step to be made with the present one?
    current = False  # does the tree stand for the best poses?
    damping = config.initial_damping
    previous, last_damping = math.inf, 0.0
    while iterations < config.max_iterations:
        trial, rounding = math.inf, 0.0
        length = _step(head, damping, right, keep=keep)
        if length < math.inf:
            solved = True
            trial, rounding = gn.evaluate(head, right)
        lower = trial <= chi2 + rounding
        current = lower and damping == 0.0
        if lower:
            chi2 = trial
            gn.keep_poses(head, best)
            iterations += 1
            # lengths of steps tell something only if no other reason made this one shorter
            alike = uphill == 0 and damping <= last_damping
            if alike and _has_converged(length, previous, config.step_tolerance):
                end = End.CONVERGED
                break
            keep = alike and damping == 0.0 and previous < math.inf and (
                length < (CHORD_RATIO if keep else KEEP_RATIO) * previous)
            last_damping = damping
            damping *= DAMPING_DECAY
            if damping < LEAST_DAMPING:
                damping = 0.0
            uphill, previous = 0, length
        elif (damping == 0.0 and not keep and trial < UPHILL_LIMIT * chi2
              and uphill < UPHILL_STEPS and iterations + 1 < config.max_iterations):
            iterations += 1
            uphill, previous = uphill + 1, length
        else:
            gn.put_poses(head, best)
            if not keep:
                damping = max(FIRST_DAMPING, damping * DAMPING_GROWTH)
                if damping > LARGEST_DAMPING:
                    end = End.STALLED if solved else End.UNDETERMINED
                    break
            # else it was the factorisation that was too old
            keep, uphill = False, 0
    if not current and end is not End.UNDETERMINED:
        gn.put_poses(head, best)
        end = _renewed(head, best, end, chi2)
    if end is not End.UNDETERMINED:
        gn.settle(head)
    return Descent(end, iterations, chi2)


def _step(head: tb.IntHead, damping: float, right: FloatArray, *, keep: bool) -> float:
    """Move all nodes; return the largest change of a coordinate, infinite if that failed."""
    if keep:
        return float(gn.chord_step(head, right))
    gn.linearize(head)
    if not gn.eliminate(head, damping):
        return math.inf
    return float(gn.gauss_newton_step(head))


def _renewed(head: tb.IntHead, best: FloatArray, end: End, chi2: float) -> End:
    """Make the tree one of the best poses, without damping; return the end after all."""
    gn.linearize(head)
    if not gn.eliminate(head, 0.0):
        return End.UNDETERMINED
    if end is End.STALLED:
        right = np.empty_like(best)
        gn.evaluate(head, right)
        gn.gauss_newton_step(head)
        # b^T H^-1 b, by which a quadratic chi2 would fall
        promised = gn.product_with_step(head, right)
        gn.put_poses(head, best)
        if not promised > STALL * max(chi2, 1.0):
            return End.CONVERGED
    return end


def _has_converged(length: float, previous: float, tolerance: float) -> bool:
    """
    Tell from the lengths of the last two steps whether what is left is below the tolerance.

    Gauss-Newton converges linearly where errors remain: with a ratio r of two steps, the steps
    still to come add up to r / (1 - r) times the last one, if they shrink as these did.
    """
    if length >= previous:
        return length < NOISE_STEP
    if previous == math.inf:
        return length < tolerance
    ratio = length / previous
    return length * ratio < SURE * tolerance * (1.0 - ratio)
