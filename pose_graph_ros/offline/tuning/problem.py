# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The cost of noise parameters: how unlikely the measurements of a drive are with them.

All parameters are logarithms: of the sigmas of odometry, and of the variances of a source in units
of those that it claims. Noise of odometry has a wide prior around its settings, and the variances
of a source one with long tails around those that it claims, which are wrong by much or not at all.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
import math

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.offline.tuning import likelihood as lk
from pose_graph_ros.offline.tuning.drive_rows import DriveRows, first_row

# Sigma of the logarithm of a sigma of odometry, before it is seen: a factor of 4.5.
PRIOR_SPREAD = 1.5
# The same of the variance of a source, and the degrees of freedom of this Student distribution.
CLAIM_SPREAD, CLAIM_FREEDOM = 1.5, 10.0
# Bounds of logarithms: sigmas of odometry around their settings, variances of sources.
ODOMETRY_RANGE, VARIANCE_RANGE = math.log(1e3), math.log(1e8)
# Least and largest ratio of the white variance to the correlated one.
SHARES = 1e-2, 10.0
# Shortest and longest time constant: of the period of the source, and of the drive.
SHORTEST_TAU, LONGEST_TAU = 0.5, 4.0
# Measurements of which the first heading is found.
FIRST_MEASUREMENTS = 200
# Number of headings that are tried.
HEADINGS = 16
# Least number of measurements that are left when only some of them count.
LEAST = 40


class Role(Enum):
    """What a parameter is."""

    ODOMETRY = 'odometry'
    """Sigma of odometry."""
    WHITE = 'white'
    """White variance of a source, in units of the claimed one."""
    CORRELATED = 'correlated'
    """Its correlated variance, in the same units."""
    SHARE = 'share'
    """Its white variance in units of the correlated one."""
    TAU = 'tau'
    """Its time constant [s]."""
    CLOSURE = 'closure'
    """Factor on the sigmas of loop closures."""
    HEADING = 'heading'
    """Variance of its headings, in units of the claimed one."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number that is estimated."""

    role: Role
    index: int
    """Of the number in the noise of odometry, or of the source."""
    setting: float
    """Its value now: a sigma, a ratio of variances or a time."""


@dataclass(slots=True)
class Problem:
    """Costs of a drive as a function of the logarithms of some parameters."""

    rows: DriveRows
    noise: FloatArray
    """Of odometry by the settings, as variances, shape (7,)."""
    errors: FloatArray
    """Of the sources by the settings, shape (S, 4)."""
    tick: Callable[[], None] = lambda: None
    """Called at each evaluation, for progress and for giving up."""
    heading: float = 0.0
    n_evaluations: int = 0
    n_beyond: int = 0
    """Number of positions beyond the gate at the last evaluation."""
    _seconds: FloatArray = field(init=False)
    _first: int = field(init=False)
    _costs: FloatArray = field(init=False)
    _levels: list[tuple[IntArray, float]] = field(init=False)
    """Sources of the measurements that count, and their weight, for each distance of them."""

    def __post_init__(self) -> None:
        self._seconds, self._first = self.rows.seconds, first_row(self.rows)
        self._costs = np.zeros(len(self._seconds))
        self.thin((1,))

    def thin(self, strides: Sequence[int]) -> None:
        """
        Count all measurements, and only every so manieth of them, with the same weight together.

        Parameters
        ----------
        strides : sequence of int, 1 for all

        """
        at = np.flatnonzero(self.rows.source >= 0)
        useful = [stride for stride in strides if stride == 1 or len(at) >= LEAST * stride]
        self._levels = []
        for stride in useful:
            source = np.full_like(self.rows.source, -1)
            source[at[::stride]] = self.rows.source[at[::stride]]
            self._levels.append((source, len(at) / max(len(at[::stride]), 1) / len(useful)))

    def costs(self, parameters: Sequence[Parameter], x: FloatArray) -> FloatArray:
        """
        Return the cost of each row, shape (N,).

        Parameters
        ----------
        parameters : sequence of Parameter, P of them
        x : ndarray, shape (P,), their logarithms

        """
        noise, errors = self.noise.copy(), self.errors.copy()
        for parameter, value in zip(parameters, np.exp(x).tolist(), strict=True):
            if parameter.role is Role.ODOMETRY:
                noise[parameter.index] = value**2
            else:
                errors[parameter.index, _COLUMNS[parameter.role]] = value
        for parameter in parameters:
            if parameter.role is Role.SHARE:
                errors[parameter.index, lk.WHITE] *= errors[parameter.index, lk.CORRELATED]
        self.n_evaluations += 1
        self.tick()
        total = np.zeros(len(self._costs))
        for source, weight in self._levels:
            n_left_out = lk.costs(self._seconds, source, self.rows.rows, noise, errors,
                                  self.heading, self._first, self._costs)
            if source is self._levels[0][0]:
                self.n_beyond = n_left_out
            total += weight * self._costs
        return total

    def value(self, parameters: Sequence[Parameter], x: FloatArray) -> float:
        """
        Return the cost of all rows with the prior.

        Parameters
        ----------
        parameters : sequence of Parameter, P of them
        x : ndarray, shape (P,), their logarithms

        """
        prior, claims = 0.0, dict[int, float]()
        for each, value in zip(parameters, x.tolist(), strict=True):
            if each.role is Role.ODOMETRY:
                prior += ((value - math.log(each.setting)) / PRIOR_SPREAD)**2
            elif each.role in (Role.WHITE, Role.CORRELATED):
                claims[each.index] = claims.get(each.index, 0.0) + value
            elif each.role is Role.SHARE:
                claims[each.index] = claims.get(each.index, 0.0) + math.log1p(math.exp(value))
        return prior + float(np.sum(self.costs(parameters, x))) + sum(
            CLAIM_FREEDOM * math.log1p((ratio / CLAIM_SPREAD)**2 / CLAIM_FREEDOM)
            for ratio in claims.values())

    def find_heading(self) -> None:
        """Find the heading at the first position under which the first ones are most likely."""
        first = self._first
        at = np.flatnonzero(self.rows.source >= 0)
        at = at[at >= first]    # before the first position, headings have no cost
        end = int(at[min(FIRST_MEASUREMENTS, len(at)) - 1]) + 1 if len(at) > 0 else first
        some = Problem(DriveRows(self.rows.stamps_ns[:end], self.rows.source[:end],
                                 self.rows.rows[:end]), self.noise, self.errors)
        best = math.inf
        for exponent in range(-6, 12, 2):
            some.errors = self.errors.copy()
            some.errors[:, lk.WHITE] *= 2.0**exponent
            for heading in (2.0 * np.pi / HEADINGS * np.arange(HEADINGS)).tolist():
                some.heading = heading
                value = some.value([], np.empty(0))
                if value < best:
                    best, self.heading = value, heading


_COLUMNS = {Role.WHITE: lk.WHITE, Role.SHARE: lk.WHITE, Role.CORRELATED: lk.CORRELATED,
            Role.TAU: lk.TAU, Role.HEADING: lk.WHITE_HEADING}


def bounds(problem: object, each: Parameter) -> tuple[float, float]:
    """Return the bounds of the logarithm of a parameter."""
    at = math.log(each.setting)
    if each.role is Role.ODOMETRY:
        return at - ODOMETRY_RANGE, at + ODOMETRY_RANGE
    if each.role is Role.SHARE:
        return math.log(SHARES[0]), math.log(SHARES[1])
    if each.role is not Role.TAU:
        return at - VARIANCE_RANGE, at + VARIANCE_RANGE
    assert isinstance(problem, Problem), 'no other has time constants'
    seconds = problem.rows.seconds[problem.rows.source == each.index]
    period = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 1.0
    shortest = SHORTEST_TAU * max(period, 1e-3)
    return math.log(shortest), math.log(
        max(LONGEST_TAU * float(seconds[-1] - seconds[0]), 2.0 * shortest))
