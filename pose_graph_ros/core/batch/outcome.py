# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Results of optimisations, and when one has converged; nothing in here is compiled."""

from dataclasses import dataclass
from enum import Enum
import math

# Relative difference of chi2 below which two minima count as the same.
SAME_MINIMUM = 1e-9
# Iterations within which a good start converges; if it takes more, the next one is tried.
TRUSTED_ITERATIONS = 20
# Number of steps in a row for which chi2 may exceed the lowest so far, by any factor: a step along
# a narrow curved valley, as stiff constraints make it, ends high up, the next one far down.
UPHILL_STEPS = 2
# A step that is no shorter than the last one but below this is rounding noise [m, rad].
NOISE_STEP = 1e-7
# Limit of the predicted sum of all further steps at convergence [fraction of the tolerance].
SURE = 0.1
# Largest ratio of the lengths of two steps after which the next one is a chord step: after a step
# with a new factorisation, and after a chord step.
KEEP_RATIO = 0.1
CHORD_RATIO = 0.4


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
    reason: str
    """One sentence when the status is FAILED, else empty."""
    iterations: int
    """Number of steps."""
    chi2: float
    """chi2 at the poses after the call."""
    start: Start = Start.PRESENT


def has_converged(length: float, previous: float, tolerance: float) -> bool:
    """
    Tell whether the sum of all further steps is below the tolerance.

    Gauss-Newton converges linearly if errors remain at the minimum. If r is the ratio of the
    lengths of the last two steps and remains so, the further steps add up to r / (1 - r) times the
    last one.

    Parameters
    ----------
    length, previous : float, of the last steps [m, rad]; `previous` is infinite for the first one
    tolerance : float [m, rad]

    """
    if length >= previous:
        return length < NOISE_STEP
    if previous == math.inf:
        return length < tolerance
    ratio = length / previous
    return length * ratio < SURE * tolerance * (1.0 - ratio)
