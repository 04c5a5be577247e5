# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The loop of the batch optimisation: Gauss-Newton, with Levenberg-Marquardt damping if needed.

Every iteration solves `(H + lambda D) dx = -b`. D is diagonal and holds the information that the
constraints of a node have on its position and on its heading, which makes the damping independent
of units (Marquardt 1963). With lambda = 0 the step is that of Gauss-Newton.

chi2 may rise for a few Gauss-Newton steps in a row, since the path to a minimum can cross a ridge
that no damped step crosses. If chi2 is not below its lowest value after these, the best poses are
restored and lambda grows until a step, or half of it, lowers chi2. Each step that lowers chi2
reduces lambda, which is set to 0 when it is small and after some damped steps.

Once a step is short, the next ones are chord steps, which keep the factorisation, as long as the
linear model promises less and less of them. `secant_step` corrects each by the one before.

Nothing in here is compiled; a `System` does the linear algebra.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from enum import Enum
import math
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, Poses

# Relative difference of chi2 below which two minima count as the same.
SAME_MINIMUM = 1e-9
# Iterations that each start is given, and below which a good one converges; if it takes more, the
# next one is tried.
TRUSTED_ITERATIONS, GOOD_ITERATIONS = 20, 15


class Tuning(NamedTuple):
    """Numbers of the loop, found on graphs of the benchmark; lengths of steps in m and rad."""

    # lambda after the first rejected step, its growth after each further one, its decay after each
    # accepted one, the value below which it is set to 0, and the largest value
    first_damping: float = 1e-5
    damping_growth: float = 10.0
    damping_decay: float = 0.1
    least_damping: float = 1e-9
    largest_damping: float = 1e12
    # damped steps in a row after which one without damping is tried again
    damped_steps: int = 10
    # steps in a row for which chi2 may exceed the lowest so far, by any factor: a step along a
    # narrow curved valley, as stiff constraints make it, ends high up, the next one far down
    uphill_steps: int = 2
    # It ends after so many damped steps that each lower chi2 by less than this fraction: where
    # residuals are so large that only short steps lower chi2, thousands of them would change it
    # no more than the rounding of the measurements does.
    slow_steps: int = 10
    slow: float = 1e-9
    # steps that change chi2 by rounding only, and are not expected to do less, until convergence
    level_steps: int = 2
    # Where no step lowers chi2, the optimisation has stalled if the linear model predicts a
    # decrease by more than this fraction of chi2 (at least 1), and has converged otherwise. After
    # the last iteration it has converged below the second, and it ends early below the third.
    stall: float = 1e-6
    at_the_end: float = 1e-9
    least_decrease: float = 1e-16
    # length of a step below which the next one is a chord step
    chord_length: float = 0.1
    # least ratio of the lengths of two steps that is believed to go on
    least_ratio: float = 0.03
    # a step that is no shorter than the last one but below this is rounding noise
    noise_step: float = 1e-7
    # largest predicted sum of all further steps at convergence, as a fraction of the tolerance
    sure: float = 0.1


TUNING = Tuning()


class Status(Enum):
    """Outcome of an optimisation or of an update."""

    CONVERGED = 'converged'
    MAX_ITERATIONS = 'max_iterations'
    STALLED = 'stalled'
    """
    No step lowers chi2 although the linear model predicts a decrease: a heading error is at pi.
    """
    FAILED = 'failed'


class Start(Enum):
    """Poses from which an optimisation began."""

    CHORDAL = 'chordal start'
    JOINT = 'joint start'
    """Headings and positions solved for together, where nodes are observed."""
    UNIT = 'start with unit headings'
    PRESENT = 'present poses'


@dataclass(frozen=True, slots=True)
class BatchResult:
    """Result of an optimisation."""

    status: Status
    reason: str  # a sentence when the status is FAILED, else empty
    iterations: int  # number of steps
    chi2: float  # at the poses after the call
    start: Start = Start.PRESENT

    def is_better_than(self, other: 'BatchResult') -> bool:
        """Tell whether it is a lower minimum than another one, or than a failure."""
        return self.status is not Status.FAILED and (
            other.status is Status.FAILED or self.chi2 < other.chi2 * (1.0 - SAME_MINIMUM))


def is_trusted(result: BatchResult, before: float) -> bool:
    """Tell whether a start has led to a minimum that is not above chi2 of the poses before."""
    return result.status is Status.CONVERGED and result.iterations < GOOD_ITERATIONS and (
        result.chi2 <= before + SAME_MINIMUM * max(before, 1.0))


Result = TypeVar('Result')
Optimization = Generator[None, None, BatchResult]
"""An optimisation that pauses after parts of at most an iteration; it returns the result."""


def to_the_end(parts: Generator[None, None, Result],
               between: Callable[[], None] = lambda: None) -> Result:
    """Return the result of what is done in parts, each of which is followed by a call."""
    while True:     # whoever makes the parts counts them
        try:
            next(parts)
            between()
        except StopIteration as end:
            result: Result = end.value
            return result


class System(Protocol):
    """A graph whose poses are moved; it keeps the last factorisation."""

    @property
    def poses(self) -> Poses:
        """Poses of all nodes, which further steps leave as they are."""

    def set_poses(self, poses: Poses) -> None:
        """Set the poses of all nodes."""

    def evaluate(self) -> tuple[float, float]:
        """Return chi2 at the poses and its rounding error; note the gradient."""

    def step(self, damping: float, *, chord: bool) -> tuple[float, float]:
        """
        Move all poses; return the largest change of a coordinate, infinite if H is singular.

        A chord step takes the last factorisation, with the gradient that was noted. The step times
        that gradient is returned as well, which a quadratic chi2 falls by.
        """


Last = tuple[FloatArray, FloatArray] | None
"""A step, and -b before it; None where the next step has a new factorisation."""


def secant_step(solve: Callable[[FloatArray], FloatArray], right: FloatArray,
                last: Last) -> FloatArray:
    """
    Return the step for -b by the last factorisation, corrected by the last step: BFGS.

    What -b has lost by that step tells of H what the factorisation does not hold: the curvature of
    residuals that remain, and what is different where the poses are now.
    """
    if last is None:
        return solve(right.copy())
    step, before = last
    change = before - right
    curvature = float(np.vdot(step, change))
    scale = 1.0 / curvature if curvature > 0.0 else 0.0
    part = scale * float(np.vdot(step, right))
    found = solve(right - part * change)
    return found + (part - scale * float(np.vdot(change, found))) * step


def minimize(system: System, tolerance: float, most: int) -> Optimization:
    """
    Return the result of at most so many steps to a local minimum of chi2, after a pause at each.

    The poses are those of the lowest chi2 found, unless it has failed as H is singular.
    """
    best = system.poses
    chi2, rounding = system.evaluate()
    end, iterations, uphill = Status.MAX_ITERATIONS, 0, 0
    solved = False  # whether any factorisation succeeded
    rejected = False  # whether any step was rejected
    chord = False  # whether the next step is a chord step
    current = False  # whether the tree is that of the best poses, without damping
    damping = last_damping = 0.0
    n_damped = n_level = n_slow = 0
    least = previous = energy = math.inf
    while iterations < most:
        yield
        trial = math.inf
        length, predicted = system.step(damping, chord=chord)
        if length < math.inf:
            solved = True
            if rejected and damping == uphill == 0 and not chord and (
                    predicted < TUNING.least_decrease * max(chi2, 1.0)):
                end = Status.CONVERGED
                break
            trial, rounding = system.evaluate()
            if damping > 0.0 and not trial <= chi2 + rounding < math.inf:
                step = system.poses - best
                step[:, 2] = se2.wrap(step[:, 2])
                system.set_poses(se2.wrapped(best + 0.5 * step))
                trial, rounding = system.evaluate()
        lower = trial <= chi2 + rounding
        current = lower and damping == 0.0
        if lower:
            if not (current and chi2 - trial <= rounding):
                n_level, least = 0, math.inf
            elif predicted >= least:
                n_level += 1
            least = min(least, predicted)
            slow = damping > 0.0 and chi2 - trial < TUNING.slow * max(chi2, 1.0)
            n_slow = n_slow + 1 if slow else 0
            chi2 = trial
            best = system.poses
            iterations += 1
            # an uphill step or stronger damping before this step changes its length
            comparable = uphill == 0 and damping <= last_damping
            if n_level >= TUNING.level_steps or n_slow >= TUNING.slow_steps or (
                    comparable and has_converged(length, previous, tolerance)):
                end = Status.CONVERGED
                break
            chord = (comparable and damping == 0.0
                     and length < TUNING.chord_length and predicted < energy)
            last_damping = damping
            n_damped = n_damped + 1 if damping > 0.0 else 0
            damping *= TUNING.damping_decay
            if damping < TUNING.least_damping or n_damped >= TUNING.damped_steps:
                damping, n_damped = 0.0, 0
            uphill, previous, energy = 0, length, predicted
        elif (damping == 0.0 and not chord and trial < math.inf
              and uphill < TUNING.uphill_steps and iterations + 1 < most):
            iterations += 1
            uphill, previous, energy = uphill + 1, length, math.inf
        else:
            system.set_poses(best)
            system.evaluate()
            rejected = True
            if not chord:
                damping = max(TUNING.first_damping, damping * TUNING.damping_growth)
                if damping > TUNING.largest_damping:
                    end = Status.STALLED if solved else Status.FAILED
                    break
            # a rejected chord step is repeated with a new factorisation before any damping
            chord, uphill = False, 0
    # after a rejected step short steps may mean that it is stuck where an error is at pi
    at_best = current and not rejected and end is not Status.MAX_ITERATIONS
    if not at_best and end is not Status.FAILED:
        system.set_poses(best)
        end = _refactorized(system, end, chi2)
    return BatchResult(end, '', iterations, chi2)


def _refactorized(system: System, end: Status, chi2: float) -> Status:
    """Eliminate all nodes at the best poses without damping; return the final status."""
    best = system.poses
    system.evaluate()
    length, predicted = system.step(0.0, chord=False)
    if not length < math.inf:
        return Status.FAILED
    system.set_poses(best)
    most = TUNING.at_the_end if end is Status.MAX_ITERATIONS else TUNING.stall
    if not predicted > most * max(chi2, 1.0):
        return Status.CONVERGED
    return Status.STALLED if end is Status.CONVERGED else end


def has_converged(length: float, previous: float, tolerance: float) -> bool:
    """
    Tell whether the sum of all further steps is below the tolerance [m, rad].

    Gauss-Newton converges linearly if errors remain at the minimum. If r is the ratio of the
    lengths of the last two steps and remains so, the further steps add up to r / (1 - r) times the
    last one. `previous` is infinite for the first step.
    """
    if length >= previous:
        return length < TUNING.noise_step
    ratio = max(length / previous, TUNING.least_ratio)
    return length * ratio < TUNING.sure * tolerance * (1.0 - ratio)
