# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How likely the measurements of a drive are, for given noise of odometry and of their sources.

An extended Kalman filter runs along odometry, with the states

    x, y, theta      pose of the robot in the map
    m_x, m_y         of each source, its correlated error, of variance 1 and with time constant tau

and gives each measurement the cost `d^2 + log det S`, twice the negative logarithm of its density
given all those before it, but for a constant; d is the innovation in sigmas and S its covariance.
The sum is that of the likelihood of all (F. C. Schweppe, "Evaluation of likelihood functions for
Gaussian signals", IEEE Trans. Information Theory 11, 1965). Unlike residuals of an optimum, which
follow the measurements, it shows the noise of odometry and of measurements at once.

Beyond `GATE` sigmas, where a normal error hardly ever is, the cost is `GATE^2 (1 + log(d^2 /
GATE^2)) + log det S`, and the measurement corrects the state as one with `d^2 / GATE^2` times the
covariance S would. So single wrong measurements do little, nothing jumps when noise is changed,
and small noise cannot be bought by leaving measurements out.

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

from pose_graph_ros.core.compiled.jit import INTEGER, INTEGERS, kernel, NUMBER, NUMBERS, ROWS
from pose_graph_ros.core.geometry.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.offline.tuning.drive_rows import DriveRows, first_row

# Columns of the rows: motion since the row before, seen from there, path length, turn, variances
# of x, y and theta that are not noise by path and turn, number of hidden nodes.
DX, DY, TURN, LENGTH, TURNED, VAR_X, VAR_Y, VAR_TURN, NODES = range(9)
# And the measurement: position, its covariance, the point in the robot's frame, heading and its
# variance; a variance of 0 stands for none.
X, Y, XX, XY, YY, ARM_X, ARM_Y, HEADING, HEADING_VAR = range(9, 18)
N_COLUMNS = 18
# Parameters: variances of the noise of odometry, as in `OdometryNoise`, with the floors, and the
# factor on the variances that are not by path and turn.
ALONG, ACROSS, BY_LENGTH, BY_TURN, FLOOR, HEADING_FLOOR, GIVEN = range(7)
N_ODOMETRY = 7
# And of each source: time constant, correlated and white variance in units of the claimed one,
# the same of the heading.
TAU, CORRELATED, WHITE, WHITE_HEADING = range(4)
N_SOURCE = 4
# Innovation beyond which a measurement may be wrong, squared: 0.2 % of positions [sigma^2].
GATE = 12.25
# Variance of the heading at the first start, and at a later one [rad^2].
START_VARIANCE, RESTART_VARIANCE = 0.1, 0.3
# Variance of the heading of a motion above which the filter starts again after it [rad^2].
UNKNOWN = 0.3
# Variance of a position at a start [m^2].
START_SPREAD = 1e6
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


@kernel
def _start(state, p, row, heading_variance):  # type: ignore[no-untyped-def]
    """Start the filter at a position; the heading of the state stays."""
    c, s = math.cos(state[2]), math.sin(state[2])
    state[0] = row[X] - c * row[ARM_X] + s * row[ARM_Y]
    state[1] = row[Y] - s * row[ARM_X] - c * row[ARM_Y]
    p[:] = 0.0
    p[0, 0] = p[1, 1] = START_SPREAD
    p[2, 2] = heading_variance
    for i in range(3, len(state)):
        state[i] = 0.0
        p[i, i] = 1.0


@kernel
def _move(state, p, row, noise):  # type: ignore[no-untyped-def]
    """Predict the pose after a motion; the noise is that of `odometry_covariance`."""
    n = len(state)
    dx, dy, turn = row[DX], row[DY], row[TURN]
    c, s = math.cos(state[2]), math.sin(state[2])
    wx, wy = c * dx - s * dy, s * dx + c * dy
    state[0] += wx
    state[1] += wy
    state[2] += turn
    for i in range(n):
        p[i, 0] -= wy * p[i, 2]
        p[i, 1] += wx * p[i, 2]
    for i in range(n):
        p[0, i] -= wy * p[2, i]
        p[1, i] += wx * p[2, i]
    q = min(noise[BY_LENGTH] * row[LENGTH] + noise[BY_TURN] * row[TURNED]
            + noise[GIVEN] * row[VAR_TURN], UNKNOWN_HEADING_VARIANCE)
    # in the frame at the end of the motion
    ct, st = math.cos(turn), math.sin(turn)
    chord_x, chord_y = ct * dx + st * dy, ct * dy - st * dx
    floor = noise[FLOOR] * row[NODES]
    xx = (q / 3.0 * chord_y * chord_y + noise[ALONG] * row[LENGTH]
          + noise[GIVEN] * row[VAR_X] + floor)
    yy = (q / 3.0 * chord_x * chord_x + noise[ACROSS] * row[LENGTH]
          + noise[GIVEN] * row[VAR_Y] + floor)
    xy = -q / 3.0 * chord_x * chord_y
    xt, yt = -0.5 * q * chord_y, 0.5 * q * chord_x
    c, s = math.cos(state[2]), math.sin(state[2])
    p[0, 0] += c * c * xx - 2.0 * c * s * xy + s * s * yy
    p[1, 1] += s * s * xx + 2.0 * c * s * xy + c * c * yy
    cross = c * s * (xx - yy) + (c * c - s * s) * xy
    p[0, 1] += cross
    p[1, 0] += cross
    p[0, 2] += c * xt - s * yt
    p[2, 0] += c * xt - s * yt
    p[1, 2] += s * xt + c * yt
    p[2, 1] += s * xt + c * yt
    p[2, 2] += q + noise[HEADING_FLOOR] * row[NODES]


@kernel
def _fade(state, p, at, phi):  # type: ignore[no-untyped-def]
    """Predict the correlated error of a source, of which the part phi is left."""
    n = len(state)
    for i in range(at, at + 2):
        state[i] *= phi
        for j in range(n):
            p[i, j] *= phi
        for j in range(n):
            p[j, i] *= phi
        p[i, i] += 1.0 - phi * phi


@kernel
def _position(state, p, gain, row, at, correlated, white):  # type: ignore[no-untyped-def]
    """Return the cost of a position, after correcting by it."""
    n = len(state)
    c, s = math.cos(state[2]), math.sin(state[2])
    ox = c * row[ARM_X] - s * row[ARM_Y]
    oy = s * row[ARM_X] + c * row[ARM_Y]
    factor = math.sqrt(correlated * 0.5 * (row[XX] + row[YY]))
    ex = row[X] - state[0] - ox - factor * state[at]
    ey = row[Y] - state[1] - oy - factor * state[at + 1]
    for i in range(n):
        gain[i, 0] = p[i, 0] - oy * p[i, 2] + factor * p[i, at]
        gain[i, 1] = p[i, 1] + ox * p[i, 2] + factor * p[i, at + 1]
    sxx = gain[0, 0] - oy * gain[2, 0] + factor * gain[at, 0] + white * row[XX]
    sxy = gain[0, 1] - oy * gain[2, 1] + factor * gain[at, 1] + white * row[XY]
    syy = gain[1, 1] + ox * gain[2, 1] + factor * gain[at + 1, 1] + white * row[YY]
    det = sxx * syy - sxy * sxy
    distance = (syy * ex * ex - 2.0 * sxy * ex * ey + sxx * ey * ey) / det
    weight = 1.0 if distance <= GATE else GATE / distance
    ax, ay = weight * (syy * ex - sxy * ey) / det, weight * (sxx * ey - sxy * ex) / det
    for i in range(n):
        state[i] += gain[i, 0] * ax + gain[i, 1] * ay
    for i in range(n):
        kx = weight * (syy * gain[i, 0] - sxy * gain[i, 1]) / det
        ky = weight * (sxx * gain[i, 1] - sxy * gain[i, 0]) / det
        for j in range(i, n):
            p[i, j] -= kx * gain[j, 0] + ky * gain[j, 1]
            p[j, i] = p[i, j]
    if weight < 1.0:
        distance = GATE * (1.0 - math.log(weight))
    return distance + math.log(det)


@kernel
def _heading(state, p, gain, row, white):  # type: ignore[no-untyped-def]
    """Do the same with a heading."""
    n = len(state)
    error = row[HEADING] - state[2]
    error -= 2.0 * math.pi * math.floor((error + math.pi) / (2.0 * math.pi))
    variance = p[2, 2] + white * row[HEADING_VAR]
    distance = error * error / variance
    weight = 1.0 if distance <= GATE else GATE / distance
    for i in range(n):
        gain[i, 0] = p[i, 2]
        state[i] += weight * gain[i, 0] * error / variance
    for i in range(n):
        for j in range(n):
            p[i, j] -= weight * gain[i, 0] * gain[j, 0] / variance
    if weight < 1.0:
        distance = GATE * (1.0 - math.log(weight))
    return distance + math.log(variance)


@kernel(signature=(NUMBERS, INTEGERS, ROWS, NUMBERS, ROWS, NUMBER, INTEGER, NUMBERS),
        allocates=True)
def costs(  # type: ignore[no-untyped-def]
    seconds, source, rows, noise, errors, heading, first, out,
):
    """
    Write the cost of each row of a drive.

    Parameters
    ----------
    seconds : ndarray, shape (N,), stamps [s], not decreasing
    source : ndarray of int, shape (N,), index of the source of the measurement, -1 without one
    rows : ndarray, shape (N, 18), motions and measurements; the columns are named above
    noise : ndarray, shape (7,), of odometry
    errors : ndarray, shape (S, 4), of the sources
    heading : float, of the robot at the first position [rad]
    first : int, index of the row at which the filter starts
    out : ndarray, shape (N,), receives the costs, 0 where nothing is measured

    """
    n = 3 + 2 * len(errors)
    state, p, gain = np.zeros(n), np.zeros((n, n)), np.zeros((n, 2))
    state[2] = heading
    lost, started = False, False
    last = seconds[0]
    out[:first] = 0.0
    for k in range(first, len(seconds)):
        row, of = rows[k], source[k]
        if started:
            _move(state, p, row, noise)
            for each in range(len(errors)):
                _fade(state, p, 3 + 2 * each, math.exp((last - seconds[k]) / errors[each, TAU]))
            lost = lost or noise[GIVEN] * row[VAR_TURN] > UNKNOWN
        last = seconds[k]
        out[k] = 0.0
        if of < 0:
            continue
        if row[XX] > 0.0:
            starts = lost or not started
            if starts:
                _start(state, p, row, RESTART_VARIANCE if started else START_VARIANCE)
            cost = _position(
                state, p, gain, row, 3 + 2 * of, errors[of, CORRELATED], errors[of, WHITE])
            if not starts:  # at a start, nothing was predicted
                out[k] += cost
            lost, started = False, True
        if row[HEADING_VAR] > 0.0 and started:
            out[k] += _heading(state, p, gain, row, errors[of, WHITE_HEADING])


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
        """
        at = np.flatnonzero(self.rows.source >= 0)
        useful = [stride for stride in strides if stride == 1 or len(at) >= LEAST * stride]
        self._levels = []
        for stride in useful:
            source = np.full_like(self.rows.source, -1)
            source[at[::stride]] = self.rows.source[at[::stride]]
            self._levels.append((source, len(at) / max(len(at[::stride]), 1) / len(useful)))

    def costs(self, parameters: Sequence[Parameter], x: FloatArray) -> FloatArray:
        """Return the cost of each row, shape (N,)."""
        noise, errors = self.noise.copy(), self.errors.copy()
        for parameter, value in zip(parameters, np.exp(x).tolist(), strict=True):
            if parameter.role is Role.ODOMETRY:
                noise[parameter.index] = value**2
            else:
                errors[parameter.index, _COLUMNS[parameter.role]] = value
        for parameter in parameters:
            if parameter.role is Role.SHARE:
                errors[parameter.index, WHITE] *= errors[parameter.index, CORRELATED]
        self.tick()
        total = np.zeros(len(self._costs))
        for source, weight in self._levels:
            costs(self._seconds, source, self.rows.rows, noise, errors, self.heading,
                  self._first, self._costs)
            total += weight * self._costs
        return total

    def value(self, parameters: Sequence[Parameter], x: FloatArray) -> float:
        """Return the cost of all rows with the prior."""
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
            some.errors[:, WHITE] *= 2.0**exponent
            for heading in (2.0 * np.pi / HEADINGS * np.arange(HEADINGS)).tolist():
                some.heading = heading
                value = some.value([], np.empty(0))
                if value < best:
                    best, self.heading = value, heading


_COLUMNS = {Role.WHITE: WHITE, Role.SHARE: WHITE, Role.CORRELATED: CORRELATED,
            Role.TAU: TAU, Role.HEADING: WHITE_HEADING}


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
