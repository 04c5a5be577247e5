# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Batch optimisation of a whole graph: Gauss-Newton and Levenberg-Marquardt in one loop.

Every iteration linearizes at the present poses and solves `(H + lambda diag(H)) dx = -b`. With
lambda = 0 that is Gauss-Newton. A step that would raise chi2 is not taken: lambda grows until one
lowers it. Every step that is taken lets lambda shrink, and below a bound it becomes 0 again, so
that the last iterations converge as fast as Gauss-Newton does.

The scaling by diag(H) makes the damping independent of units (Marquardt 1963).
"""

import contextlib
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
import scipy.sparse

from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.exceptions import LinearSolveError
from pose_graph_ros.core.graph import Graph
from pose_graph_ros.core.linear_system import Factorization, LinearSystem
from pose_graph_ros.core.se2 import FloatArray, IntArray

# Damping that the first refused step brings, its growth and its decay, and where it is dropped.
FIRST_DAMPING = 1e-5
DAMPING_GROWTH = 10.0
DAMPING_DECAY = 0.1
LEAST_DAMPING = 1e-9
LARGEST_DAMPING = 1e12
# chi2 is a sum of many rounded numbers: an increase by this fraction (of at least 1) is none.
ROUNDING = 1e-12
# Where no step lowers chi2 by this fraction of it (of at least 1) although one should, there is no
# minimum.
STALL = 1e-6
# Steps below this that no longer shrink are rounding noise [m, rad].
NOISE_STEP = 1e-7


class Status(Enum):
    """How an optimisation ended."""

    CONVERGED = 'converged'
    MAX_ITERATIONS = 'max_iterations'
    STALLED = 'stalled'
    """No step lowers chi2, though H and b promise it: at the jump of a wrapped angle."""
    FAILED = 'failed'


@dataclass(frozen=True, slots=True)
class BatchResult:
    """What an optimisation did."""

    status: Status
    reason: str
    """One sentence when the status is FAILED, else empty."""
    iterations: int
    """Steps that were taken."""
    chi2_before: float
    chi2: float
    factorization: Factorization | None
    """
    Of H without damping: at the poses before the last step, or after it if that was damped.
    None if there are no unknowns, or H is singular.
    """
    free_nodes: IntArray
    """Hidden nodes with unknowns, in the order of the blocks of H."""


class _Trial(NamedTuple):
    """What `_downhill` found."""

    step: FloatArray | None
    """None if no step lowers chi2."""
    factorization: Factorization | None
    """Of H without damping; None if damping was needed."""
    damping: float
    """For the next iteration."""
    chi2: float
    """After the step; without one, before it."""
    stalled: bool = False
    """Whether there is no step although this is no minimum."""


def optimize(graph: Graph, config: SolverConfig) -> BatchResult:
    """
    Move the hidden nodes to the minimum of chi2 that lies downhill.

    A numerical failure is a result, not an exception; the poses are then as before the call.
    """
    poses = graph.poses.copy()
    chi2 = chi2_before = graph.energies(poses).chi2
    if not np.isfinite(chi2):
        return _failed('chi2 is not finite', chi2)
    damping, previous_length = config.initial_damping, np.inf
    factorization: Factorization | None = None
    status, iterations = Status.MAX_ITERATIONS, 0
    try:
        system = LinearSystem(graph)
        if system.size == 0:
            status = Status.CONVERGED
        while status is Status.MAX_ITERATIONS and iterations < config.max_iterations:
            step, factorization, damping, chi2, stalled = _downhill(
                graph, system, poses, chi2, damping)
            if step is None:
                status = Status.STALLED if stalled else Status.CONVERGED
                break
            poses = system.moved(poses, step)
            iterations += 1
            length = float(np.max(np.abs(step)))
            if damping == 0.0 and _converged(length, previous_length, config.step_tolerance):
                status = Status.CONVERGED
            previous_length = length
    except LinearSolveError as error:
        return _failed(str(error), chi2_before)
    if factorization is None and system.size > 0:
        with contextlib.suppress(LinearSolveError):
            factorization = Factorization(system.assemble(poses)[0])
    graph.set_poses(poses)
    return BatchResult(
        status, '', iterations, chi2_before, chi2, factorization, system.free_nodes)


def _failed(reason: str, chi2: float) -> BatchResult:
    return BatchResult(
        Status.FAILED, reason, 0, chi2, chi2, None, np.empty(0, dtype=np.int64))


def _converged(length: float, previous_length: float, tolerance: float) -> bool:
    """
    Tell from the lengths of the last two steps whether what is left is below the tolerance.

    Gauss-Newton converges linearly where errors remain: with a ratio r of two steps, the steps
    still to come add up to r / (1 - r) times the last one.
    """
    if length >= previous_length:
        return length < NOISE_STEP
    ratio = length / previous_length
    return length < tolerance and length * ratio / (1.0 - ratio) < tolerance


def _downhill(
    graph: Graph, system: LinearSystem, poses: FloatArray, chi2: float, damping: float,
) -> _Trial:
    """Find a step that does not raise chi2, with as little damping as it takes."""
    hessian, gradient = system.assemble(poses)
    if not (np.all(np.isfinite(hessian.data)) and np.all(np.isfinite(gradient))):
        raise LinearSolveError('H or b holds numbers that are not finite')
    damped = hessian.copy()
    failure: LinearSolveError | None = None
    solved = False
    while damping <= LARGEST_DAMPING:
        try:
            if damping > 0.0:
                damped.setdiag((1.0 + damping) * hessian.diagonal())
            factorization = Factorization(damped)
            step = -factorization.solve(gradient)
            solved = True
            trial = graph.energies(system.moved(poses, step)).chi2
            if trial <= chi2 + ROUNDING * max(chi2, 1.0):
                shrunk = damping * DAMPING_DECAY
                return _Trial(step, factorization if damping == 0.0 else None,
                              shrunk if shrunk >= LEAST_DAMPING else 0.0, trial)
        except LinearSolveError as error:
            failure = error
        damping = max(FIRST_DAMPING, damping * DAMPING_GROWTH)
    if failure is not None and not solved:
        raise failure
    return _Trial(None, None, damping, chi2, _promises(hessian, gradient, chi2))


def _promises(hessian: scipy.sparse.csc_array, gradient: FloatArray, chi2: float) -> bool:
    """Tell whether b^T H^-1 b, by which a quadratic chi2 would fall, is more than rounding."""
    try:
        fall = float(gradient @ Factorization(hessian).solve(gradient))
    except LinearSolveError:
        return False
    return fall > STALL * max(chi2, 1.0)
