# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Noise of odometry and of sources under which the measurements of a drive are the most likely.

The cost of `likelihood` is minimised by Powell's method, first with white errors, then with
correlated ones of each source, which are taken if they are much more likely. A parameter whose
setting is as likely as its optimum, by a likelihood ratio, keeps its setting; the others are
fitted again. The interval of a parameter is where the cost, minimised over all others, rises by
`RISE`. Where stretches of the drive contradict each other more than the model says (P. J. Huber,
"The behavior of maximum likelihood estimates under nonstandard conditions", Berkeley Symposium
1967), both thresholds are raised by that ratio.

If they do so by far, odometry is no random walk. Then the fit is made again with measurements that
are farther apart as well, each of these with the same weight together (a composite likelihood;
C. Varin et al., "An overview of composite likelihood methods", Statistica Sinica 21, 2011): what
is best for the next measurement is too sure of itself over longer times.

`estimate` does so for all sources of odometry and all that measure in the map.
"""

from collections.abc import Callable, Mapping, Sequence
import math
from typing import NamedTuple, Protocol

import numpy as np
from scipy.optimize import minimize

from pose_graph_ros.core.config import BackendConfig, NoiseFrom
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.odometry.timeline import OdometryTimeline
from pose_graph_ros.offline.tuning import likelihood as lk
from pose_graph_ros.offline.tuning.drive_rows import drive_rows, Measured, odometry_noise
from pose_graph_ros.offline.tuning.likelihood import bounds, Parameter, Problem, Role

# Rise of twice the negative logarithm of the likelihood at the ends of an interval of 95 %.
RISE = 3.84
# The same that makes a setting unlikely enough to be changed (99 %).
CHANGE_RISE = 6.63
# By how much correlated errors, which have two parameters more, must be more likely (97.5 %).
CORRELATED_RISE = 7.4
# What keeps its setting by itself; correlated errors are there or not as a whole.
DECIDABLE = Role.ODOMETRY, Role.WHITE, Role.HEADING, Role.CLOSURE
# White variance beside a correlated one, as its setting.
WHITE_SHARE = 0.05
# Number of parameters whose settings are tried before all the others are taken to be lost.
TRIALS = 2
# Steps of the logarithms for second derivatives.
STEP = 0.1
# Number of stretches that are compared with each other.
STRETCHES = 24
# Ratio of variances by stretches and by the model above which the model is wrong, and the largest
# that is believed.
CONTRADICTION, MOST_CONTRADICTION = 3.0, 10.0
# Least curvature of a direction that is known, and that of one which is not.
KNOWN, UNKNOWN = 4.0, 0.05
# Distances of measurements, in numbers of them, if it is.
STRIDES = 1, 4, 16
# An interval with a larger ratio of its ends says nothing.
WIDE = 10.0
# Tolerance of the logarithms, and relative one of the cost.
X_TOLERANCE, COST_TOLERANCE = 1e-2, 1e-7
# Number of measurements of each source that are used; of more, every second, third, ...
MOST = 2000
# Least path by odometry that can tell of its noise [m].
LEAST_PATH = 5.0


class Found(NamedTuple):
    """An estimate of one parameter."""

    parameter: Parameter
    value: float
    low: float
    """Ends of the interval of 95 %; 0 or infinite where the data give no bound."""
    high: float
    kept: bool
    """Whether the setting is as likely, and so stays."""

    @property
    def is_wide(self) -> bool:
        """Whether the data hardly tell."""
        return not self.high < WIDE * self.low


class Fit(NamedTuple):
    """Result of a fit."""

    found: tuple[Found, ...]
    contradiction: float
    """Ratio by which stretches contradict each other more than the model says, at least 1."""

    def value(self, role: Role, index: int, default: float) -> float:
        """Return the value of a parameter."""
        return next((each.value for each in self.found if each.parameter.role is role
                     and each.parameter.index == index), default)


class AnyProblem(Protocol):
    """A cost as a function of the logarithms of parameters; see `Problem`."""

    def value(self, parameters: Sequence[Parameter], x: FloatArray) -> float:
        """Return the cost."""


class Minimum(NamedTuple):
    """Parameters, their logarithms and the cost."""

    parameters: Sequence[Parameter]
    x: FloatArray
    cost: float


def fit(problem: Problem, parameters: Sequence[Parameter]) -> Fit:
    """Return the most likely parameters, with their intervals."""
    problem.find_heading()
    best = _unrestricted(problem, parameters)
    ratio = _contradiction(problem, *best[:2])
    if ratio > CONTRADICTION:
        problem.thin(STRIDES)
        best = _unrestricted(problem, parameters)
        ratio = max(ratio, _contradiction(problem, *best[:2]))
    return decided(problem, best, ratio)


def decided(problem: AnyProblem, best: Minimum, ratio: float) -> Fit:
    """Return the fit after settings that are likely enough are kept."""
    parameters, x, cost = best
    kept: list[Parameter] = []
    while True:
        # the setting that is lost least, by a parabola first, then by a fit without it
        every = [*parameters, *kept]
        covariance = np.linalg.inv(_hessian(problem, every, _with_settings(x, kept))[
            :len(x), :len(x)])
        losses = [((x[k] - math.log(each.setting))**2 / covariance[k, k] / ratio, k)
                  for k, each in enumerate(parameters) if each.role in DECIDABLE]
        accepted = False
        for _, k in sorted(losses)[:TRIALS]:
            each, others = parameters[k], [*parameters[:k], *parameters[k + 1:]]
            rest, held = minimum(problem, others, np.delete(x, k), hold=[*kept, each])
            accepted = held - cost <= CHANGE_RISE * ratio
            if accepted:
                parameters, x, cost = others, rest, held
                kept.append(each)
                break
        if not accepted:
            break
    found = [
        *_intervals(problem, parameters, x, kept, ratio),
        *(each._replace(value=each.parameter.setting, kept=True,
                        low=min(each.low, each.parameter.setting),
                        high=max(each.high, each.parameter.setting))
          for each in _intervals(problem, best.parameters, best.x, [], ratio)
          if each.parameter in kept)]
    return Fit(tuple(found), ratio)


def _unrestricted(problem: Problem, parameters: Sequence[Parameter]) -> Minimum:
    """Return the minimum over all parameters, with correlated errors where there are any."""
    best = Minimum(parameters, *minimum(problem, parameters, _begin(problem, parameters)))
    for each in parameters:
        if each.role is Role.WHITE:
            more = _correlated(problem, best, each)
            if best.cost - more.cost > CORRELATED_RISE:
                best = more
    return best


def _with_settings(x: FloatArray, kept: Sequence[Parameter]) -> FloatArray:
    return np.append(x, [math.log(each.setting) for each in kept])


def _begin(problem: Problem, parameters: Sequence[Parameter]) -> FloatArray:
    """Return the best of some common factors on odometry and on sources."""
    settings = np.log([each.setting for each in parameters])
    odometry = np.array([each.role is Role.ODOMETRY for each in parameters])
    best, begin = math.inf, settings
    for white in np.arange(-9.0, 13.0, 1.5):
        for wheels in (-1.5, 0.0, 1.5, 3.0):
            x = settings + np.where(odometry, wheels, white)
            value = problem.value(parameters, x)
            if value < best:
                best, begin = value, x
    return begin


def minimum(
    problem: AnyProblem, parameters: Sequence[Parameter], x: FloatArray, *,
    hold: Sequence[Parameter] = (),
) -> tuple[FloatArray, float]:
    """Return where the cost is least, from near there with some settings held, and the cost."""
    def value(free: FloatArray) -> float:
        return problem.value([*parameters, *hold], _with_settings(free, hold))
    if len(parameters) == 0:
        return x, value(x)
    limits = [bounds(problem, each) for each in parameters]
    low, high = np.array(limits).T
    result = minimize(
        value, np.clip(x, low, high), method='Powell', bounds=limits,
        options={'xtol': X_TOLERANCE, 'ftol': COST_TOLERANCE, 'maxfev': 400 * len(x),
                 'direc': 0.5 * np.eye(len(x))})
    return np.clip(np.atleast_1d(result.x), low, high), float(result.fun)


def _correlated(problem: Problem, best: Minimum, white: Parameter) -> Minimum:
    """Return the minimum with correlated errors of a source."""
    parameters, x = best.parameters, best.x
    at = list(parameters).index(white)
    others, rest, variance = [*parameters[:at], *parameters[at + 1:]], np.delete(x, at), x[at]
    more = [*others, Parameter(Role.CORRELATED, white.index, 1.0),
            Parameter(Role.SHARE, white.index, WHITE_SHARE),
            Parameter(Role.TAU, white.index, 1.0)]
    low, high = bounds(problem, more[-1])
    odometry = np.array([each.role is Role.ODOMETRY for each in others], dtype=bool)
    settings = np.where(odometry, np.log([each.setting for each in others]), rest)
    taus = np.arange(low, high + 0.1, math.log(3.0)).tolist()
    found = []
    # white errors may have been explained by noise of odometry: begin with less of that, too
    begins = [[(rest, np.array([variance, variance - 1.0]))], [
        (settings + factor * odometry, np.arange(-8.0, 9.5, 1.5)) for factor in (-1.0, 0.0, 1.0)]]
    for some in begins:
        trials = [np.concatenate((begin, [size, share, tau])) for begin, sizes in some
                  for size in sizes.tolist() for share in (-3.5, -1.0) for tau in taus]
        costs = [problem.value(more, trial) for trial in trials]
        found.append(Minimum(more, *minimum(problem, more, trials[int(np.argmin(costs))])))
    return min(found, key=lambda each: each.cost)


def _hessian(problem: AnyProblem, parameters: Sequence[Parameter], x: FloatArray) -> FloatArray:
    """Return the second derivatives of half the cost, shape (P, P), made positive definite."""
    n = len(x)
    steps = STEP * np.eye(n)

    def value(at: FloatArray) -> float:
        return 0.5 * problem.value(parameters, at)
    here = value(x)
    hessian = np.empty((n, n))
    plus = [value(x + step) for step in steps]
    minus = [value(x - step) for step in steps]
    for i in range(n):
        hessian[i, i] = (plus[i] - 2.0 * here + minus[i]) / STEP**2
        for j in range(i):
            both = value(x + steps[i] + steps[j]) + value(x - steps[i] - steps[j])
            hessian[i, j] = hessian[j, i] = (
                both - plus[i] - plus[j] - minus[i] - minus[j] + 2.0 * here) / (2.0 * STEP**2)
    values, vectors = np.linalg.eigh(hessian)
    return np.asarray((vectors * np.maximum(values, UNKNOWN)) @ vectors.T)


def _contradiction(
    problem: Problem, parameters: Sequence[Parameter], x: FloatArray,
) -> float:
    """Return how much larger the spread of slopes of stretches is than the model says, over 1."""
    n, measured = len(x), problem.rows.source >= 0
    count = int(np.sum(measured))
    if n == 0 or count < 4 * STRETCHES:
        return 1.0
    stretch = np.cumsum(measured) * STRETCHES // (count + 1)
    slopes = np.empty((STRETCHES, n))
    for k, step in enumerate(STEP * np.eye(n)):
        ahead = problem.costs(parameters, x + step) - problem.costs(parameters, x - step)
        slopes[:, k] = 0.5 * np.bincount(stretch, ahead, STRETCHES) / (2.0 * STEP)
    slopes -= np.mean(slopes, axis=0)
    values, vectors = np.linalg.eigh(_hessian(problem, parameters, x))
    known = values > KNOWN
    if not np.any(known):
        return 1.0
    spread = np.sum((slopes @ vectors[:, known])**2, axis=0) * STRETCHES / (STRETCHES - 1)
    return float(np.clip(np.mean(spread / values[known]), 1.0, MOST_CONTRADICTION))


def _intervals(
    problem: AnyProblem, parameters: Sequence[Parameter], x: FloatArray, kept: Sequence[Parameter],
    ratio: float,
) -> list[Found]:
    """Return the parameters with their intervals, along the valleys of the cost."""
    if len(parameters) == 0:
        return []

    cost = problem.value([*parameters, *kept], _with_settings(x, kept))

    def rise(at: FloatArray) -> float:
        return problem.value([*parameters, *kept], _with_settings(at, kept)) - cost
    covariance = np.linalg.inv(_hessian(
        problem, [*parameters, *kept], _with_settings(x, kept))[:len(x), :len(x)])
    found = []
    for k, each in enumerate(parameters):
        direction = covariance[:, k] / covariance[k, k]
        guess = 2.0 * math.sqrt(covariance[k, k] * ratio)
        low, high = (_end(rise, x, sign * direction, guess, RISE * ratio) for sign in (-1.0, 1.0))
        found.append(Found(each, math.exp(x[k]), math.exp(x[k] - low),
                           math.exp(x[k] + high) if high < 100.0 else math.inf, kept=False))
    return found


def _end(
    rise: Callable[[FloatArray], float], x: FloatArray, direction: FloatArray, guess: float,
    needed: float,
) -> float:
    """Return how far one can go until the cost has risen so much; infinite if it does not."""
    low, high = 0.0, min(max(guess, 0.02), 2.0)
    while rise(x + high * direction) < needed:
        low, high = high, 1.7 * high
        if high > 8.0:
            return math.inf
    for _ in range(6):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rise(x + middle * direction) < needed else (low, middle)
    return 0.5 * (low + high)


def estimate(
    odometry: Mapping[str, OdometryTimeline], sources: Mapping[str, Measured],
    config: BackendConfig, tick: Callable[[], None] = lambda: None,
) -> dict[str, Fit]:
    """
    Return a fit for each source of odometry; only the first one has those of the other sources.
    """
    thinned = {name: _thinned(of) for name, of in sources.items()}
    fits: dict[str, Fit] = {}
    errors = np.tile([1.0, 0.0, 1.0, 1.0], (len(sources), 1))
    for name, timeline in odometry.items():
        settings = config.odometry_source(name)
        sigmas = odometry_noise(settings)
        rows = drive_rows(timeline, thinned, config)
        if not np.any((rows.source >= 0) & (rows.rows[:, lk.XX] > 0.0)):
            continue
        numbers = [lk.GIVEN] if settings.noise_from is NoiseFrom.TWIST else range(4)
        parameters = [Parameter(Role.ODOMETRY, k, float(sigmas[k])) for k in numbers
                      if sigmas[k] > 0.0]
        if np.sum(rows.rows[:, lk.LENGTH]) < LEAST_PATH:
            parameters = []     # it stood
        if len(fits) == 0:
            parameters += [Parameter(role, k, 1.0) for k, of in enumerate(sources.values())
                           for role, there in ((Role.WHITE, of.has_positions),
                                               (Role.HEADING, of.has_headings)) if there]
        problem = Problem(rows, sigmas**2, errors, tick)
        fits[name] = fit(problem, parameters)
        if len(fits) == 1:
            errors = _errors(fits[name], len(sources))
    return fits


def _thinned(of: Measured) -> Measured:
    stride = -(-len(of.stamps_ns) // MOST)
    return Measured(of.stamps_ns[::stride], of.values[::stride]) if stride > 1 else of


def _errors(found: Fit, count: int) -> FloatArray:
    """Return the statistics of the errors of the sources, shape (S, 4)."""
    errors = np.empty((count, lk.N_SOURCE))
    for k, row in enumerate(errors):
        correlated = found.value(Role.CORRELATED, k, 0.0)
        white = found.value(Role.WHITE, k, 1.0)
        row[:] = (found.value(Role.TAU, k, 1.0), correlated,
                  found.value(Role.SHARE, k, 0.0) * correlated or white,
                  found.value(Role.HEADING, k, 1.0))
    return errors
