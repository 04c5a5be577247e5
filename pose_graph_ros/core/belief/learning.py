# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How noisy odometry and sources are, by all that they show of one another.

The noise with the largest posterior density of the innovations of one filter is searched on a
lattice of exponents of 2. What to believe depends on it, and it on what is believed: the search
begins with all, and with noise that nobody has learnt, and takes what explains all measurements
best, by the evidence of the bank. So wrong measurements are not explained by noise, nor noise by
faults. The result depends on the measurements alone, not on the order of arrival.

Searches are generators: each step takes a bounded time.
"""

from collections.abc import Collection, Generator, Sequence
from itertools import product
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.belief.bank import added_covariance, as_claimed, Bank, is_believed
from pose_graph_ros.core.belief.filter import log_density
from pose_graph_ros.core.belief.hypotheses import SLIPPED
from pose_graph_ros.core.belief.rows import Records
from pose_graph_ros.core.belief.settings import BANK
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.odometry.motion import OdometryErrors
from pose_graph_ros.core.sources.bias import CorrelatedErrors

# Exponents of 2 of the variances by way and by turn, and of each source of those of its white and
# slow errors, with the time constant.
Point = tuple[float, ...]
WAY, TURN = 0, 1
NO_SLOW = -math.inf  # exponent of a source without slow errors
LN_2 = math.log(2.0)
# Steps on the lattice, and bounds.
COARSEST, FINEST, LEAST, MOST = 2.0, 0.25, -12.0, 16.0
# What searches begin with: way and turn; slow and white variance; time constants [s]; and white
# and slow variance with the time constant, where nothing is learnt yet.
ODOMETRY_BEGINS = (-4.0, -4.0), (0.0, 4.0), (4.0, 0.0), (4.0, 4.0)
SLOW_BEGINS = (-2.0, -3.0), (0.0, -3.0), (2.0, -3.0), (-1.0, -1.0), (1.0, -1.0)
SLOW_TAUS = 10.0, 60.0
UNLEARNT = -1.0, -1.0, math.log2(40.0)
LARGER = 1.0, 2.5  # by which slow errors are tried that are larger than the best ones
MOST_ROUNDS = 2  # of learning from what is believed
# Sweeps over all axes of one descent, which takes a few dozens: where the posterior is so flat
# that each lowers it a little, the point that it has reached is as good.
MOST_SWEEPS = 500
# Positions are not correlated with headings: how they are is of a place that the robot leaves.
APART = np.array(((1.0, 1.0, 0.0), (1.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
UNDECIDED = 5.0  # what is less likely by so many nats may be the best with all hypotheses
ROWS_IN_STEP = 8000  # measurements that are filtered in a step, of about a microsecond each
BANK_ROWS_IN_STEP = 80  # the same of a bank, of 0.1 to 0.4 ms each

Search = Generator[None, None, 'Found']


def axes_of(source: int) -> tuple[int, int, int]:
    """Return the axes of a source: white, slow, time constant."""
    return 2 + 3 * source, 3 + 3 * source, 4 + 3 * source


class Known(NamedTuple):
    """The noise that is given, and of what it is to be found."""

    point: Point  # what is given; what is to be found is as claimed here
    odometry: bool
    sources: tuple[int, ...]  # numbers of the sources whose errors are to be found


class Learnt(NamedTuple):
    point: Point
    evidence: float  # of all measurements, with the prior of the noise [nats]
    constants: FloatArray  # rate and scale of odometry, and their variances, shape (4,)
    # of the robot in the map at the newest measurement, with covariance: shapes (3,) and (3, 3)
    pose: FloatArray
    covariance: FloatArray

    def odometry(self) -> OdometryErrors:
        rate, scale, *variances = self.constants.tolist()
        return OdometryErrors(
            2.0**self.point[WAY], 2.0**self.point[TURN], rate, scale, *map(math.sqrt, variances))

    def is_far_from(self, known: OdometryErrors) -> bool:
        """Tell whether errors of odometry differ by more than what is known of them."""
        new, (*_, rate_variance, scale_variance) = self.odometry(), self.constants.tolist()
        return (any(max(one, other) > 1.5 * min(one, other)
                    for one, other in zip(known[:2], new[:2], strict=True))
                or (new.rate - known.rate)**2 > rate_variance
                or (new.scale - known.scale)**2 > scale_variance)

    def errors(self, source: int) -> CorrelatedErrors | None:
        """Return the slow and white errors of a source; None without slow ones."""
        axes = axes_of(source)
        if axes[-1] >= len(self.point):
            return None
        white, slow, tau = (2.0**self.point[axis] for axis in axes)
        return CorrelatedErrors(tau, slow, white) if slow > 0.0 else None


class Found(NamedTuple):
    best: Learnt
    every: dict[Point, Learnt]

    def instead_of(self, point: Point | None) -> Learnt:
        """Return the best, or noise that is in use if the evidence against it is not enough."""
        used = None if point is None else self.every.get((*point, *self.best.point[len(point):]))
        return used if used is not None and (
            self.best.evidence - used.evidence <= BANK.noise_evidence) else self.best

    def spread(self, used: Learnt) -> FloatArray:
        """Return what noise other than that in use adds to the covariance of the pose, (3, 3)."""
        every = [*self.every.values()]
        # the evidence that slow errors need is for what is done, not for what may be; but where
        # all may be a fault, the pose would hardly be known for nothing that speaks for it
        evidence = np.array([each.evidence + BANK.slow_evidence * sum(
            slow > NO_SLOW and each.covariance[0, 0] < BANK.fault_size**2
            for slow in each.point[axes_of(0)[1]::3]) for each in every])
        likely = np.exp(evidence - np.max(evidence))
        return APART * added_covariance(
            likely / np.sum(likely), np.array([each.pose for each in every]) - used.pose,
            np.array([each.covariance for each in every]) - used.covariance)


def claimed(n_sources: int) -> Point:
    """Return the noise by which all is as good as it claims."""
    return (0.0, 0.0, *(n_sources * (0.0, NO_SLOW, 0.0)))


def noise_at(point: Point) -> Records:
    """Return the noise at a point, as the filters take it."""
    noise = as_claimed()
    noise['way'], noise['turn'] = 2.0**point[WAY], 2.0**point[TURN]
    for source in range((len(point) - 2) // 3):
        for name, axis in zip(('white', 'slow', 'tau'), axes_of(source), strict=True):
            noise[name][0, source] = 2.0**point[axis]
    return noise


def log_prior(point: Point, known: Known, spread: tuple[float, float] = BANK.spread) -> float:
    """Return the logarithm of the prior of what is to be found, with its Occam factor."""
    total, known_by = 0.0, [(WAY, *BANK.way), (TURN, *BANK.turn)] if known.odometry else []
    for source in known.sources:
        white, slow, tau = axes_of(source)
        size = math.log(2.0**point[white] + 2.0**point[slow])
        total -= 0.5 * (size / spread[size > 0.0])**2
        if point[slow] > NO_SLOW:
            known_by += [(slow, *BANK.slow), (tau, *BANK.tau)]
            total -= BANK.slow_evidence
    return total - sum(0.5 * ((LN_2 * point[axis] - math.log(median)) / sigma)**2
                       for axis, median, sigma in known_by)


class Minimum(NamedTuple):
    value: float
    point: Point


class Posterior:
    """The negative logarithm of the posterior density of noise, at most once at each point."""

    def __init__(self, rows: Records, slips: FloatArray, known: Known, *,
                 spread: tuple[float, float] = BANK.spread, least_white: float = BANK.least_white,
                 finest: float = FINEST) -> None:
        """Take slips as `log_density` does."""
        self.least = dict.fromkeys(
            (axes_of(source)[0] for source in known.sources), math.log2(least_white))
        self.rows, self.slips, self.known = np.ascontiguousarray(rows), slips, known
        self._spread, self.finest = spread, finest
        self._heading: float | None = None
        self._values: dict[Point, float] = {}  # with constant errors of odometry
        self._left = ROWS_IN_STEP

    def _density(self, point: Point, heading: float, has_rate: bool = True,
                 has_scale: bool = True) -> tuple[float, FloatArray]:
        constants = np.array((0.0, 0.0, (BANK.rate * has_rate)**2, (BANK.scale * has_scale)**2))
        n_sources = (len(point) - 2) // 3
        return float(log_density(self.rows, self.slips, n_sources, noise_at(point), heading,
                                 constants)), constants

    def heading(self) -> Generator[None, None, float]:
        """Return the heading at the first position that makes all as claimed the most likely."""
        if self._heading is None:
            angles = 2.0 * math.pi / BANK.headings * np.arange(BANK.headings)
            values: list[tuple[float, float]] = []
            for angle in angles.tolist():
                values.append((-self._density(self.known.point, angle)[0], angle))
                yield from self._pause()
            self._heading = min(values)[1]
        return self._heading

    def value(self, point: Point) -> Generator[None, None, float]:
        if point not in self._values:
            heading = yield from self.heading()
            density, _ = self._density(point, heading)
            self._values[point] = -density - log_prior(point, self.known, self._spread)
            yield from self._pause()
        return self._values[point]

    def shown(self, point: Point) -> Generator[None, None, tuple[float, FloatArray]]:
        """
        Return the constant errors of odometry that the measurements show, as in `Learnt`.

        Before them comes the cost of the measurements, and of the evidence that they need [nats].
        """
        heading, best = (yield from self.heading()), (math.inf, np.zeros(4))
        prior = log_prior(point, self.known, self._spread)
        for shown in product((False, True) if self.known.odometry else (False,), repeat=2):
            density, constants = self._density(point, heading, *shown)
            yield from self._pause()
            cost = BANK.constant_evidence * sum(shown) - density - prior
            if cost < best[0]:
                best = cost, constants
        return best

    def _pause(self) -> Generator[None, None, None]:
        self._left -= len(self.rows)
        if self._left < 0:
            self._left = ROWS_IN_STEP
            yield


def descend(posterior: Posterior, begins: Sequence[Point],
            axes: Collection[int]) -> Generator[None, None, Minimum]:
    """Return the minimum along some axes near the best of some points, by halved steps."""
    values: list[Minimum] = []
    for point in begins:
        values.append(Minimum((yield from posterior.value(point)), point))
    best, step = min(values), COARSEST
    for _ in range(MOST_SWEEPS):
        if step < posterior.finest:
            break
        before = best
        for axis in axes:
            for move in (step, -step):
                point = moved(best.point, {axis: min(max(
                    best.point[axis] + move, posterior.least.get(axis, LEAST)), MOST)})
                value = yield from posterior.value(point)
                if value < best.value:
                    best = Minimum(value, point)
                    break
        if best.value == before.value:
            step /= 2.0
    return best


def moved(point: Point, to: dict[int, float]) -> Point:
    """Return a point with other exponents on some axes."""
    return tuple(to.get(axis, exponent) for axis, exponent in enumerate(point))


def most_likely(posterior: Posterior) -> Generator[None, None, list[Minimum]]:
    """Return the best point, after the best ones with slow errors of fewer sources."""
    known = posterior.known
    white, best = [axes_of(source)[0] for source in known.sources], Minimum(math.inf, known.point)
    axes: Sequence[int] = (WAY, TURN, *white) if known.odometry else white
    begins = [moved(known.point, dict.fromkeys(white, at)) for at in (-3.0, 3.0)]
    if known.odometry:
        begins += [moved(known.point, {WAY: way, TURN: turn}) for way, turn in ODOMETRY_BEGINS]
    for some in ([known.point], begins):
        best = min(best, (yield from descend(posterior, some, axes)))
    every = [best]
    for source in known.sources:
        own = axes_of(source)
        wider = (*axes, *own[1:])
        found = Minimum(math.inf, best.point)
        for point in dict.fromkeys((best.point, known.point)):
            for tau in SLOW_TAUS:
                found = min(found, (yield from descend(posterior, [
                    moved(point, {own[0]: part, own[1]: slow, own[2]: math.log2(tau)})
                    for slow, part in SLOW_BEGINS], wider)))
        if found.value < best.value + UNDECIDED:
            every.append(found)
        if found.value < best.value:
            best, axes = found, wider
    return every if every[-1] is best else [*every, best]


def with_larger_errors(posterior: Posterior, best: Point) -> Generator[None, None, list[Point]]:
    """Return the best points by which slow errors are larger than by the best one of all."""
    known, points = posterior.known, list[Point]()
    for source in known.sources:
        white, slow, tau = axes_of(source)
        for more in LARGER if best[slow] > NO_SLOW else ():
            larger = yield from descend(
                posterior, [moved(best, {slow: min(best[slow] + more, MOST)})],
                (*((WAY, TURN) if known.odometry else ()), white, tau))
            points.append(larger.point)
    return points


def search(bank: Bank, known: Known, *, begins: Collection[Point] = (),
           newest: int | None = None) -> Search:
    """
    Return the noise that explains the measurements of a bank best, or the newest ones.

    It begins also with some points, which may be of before some sources have come. The bank stays
    as it is.
    """
    same, found = bank.again(bank.noise, newest, learns=True), dict[Point, Learnt]()
    first, rows = same.done, same.rows[same.done:].copy()
    posteriors, learnt = dict[bytes, Posterior](), dict[bytes, list[Point]]()  # by the slips

    def posterior(slips: FloatArray) -> Posterior:
        return posteriors.setdefault(slips.tobytes(), Posterior(rows, slips, known))

    def learn(slips: FloatArray) -> Generator[None, None, list[Point]]:
        if (key := slips.tobytes()) not in learnt:
            every, learnt[key] = posterior(slips), []
            for best in (yield from most_likely(every)):
                better = best
                if known.odometry:
                    # the best one by which odometry is as noisy as it is given
                    given = yield from descend(
                        every, [(*known.point[:2], *best.point[2:])],
                        [axis for source in known.sources for axis in axes_of(source)
                         if best.point[axis] > NO_SLOW])
                    gained = (yield from every.shown(given.point))[0] - (
                        yield from every.shown(best.point))[0]
                    better = best if gained >= BANK.noise_evidence else given
                learnt[key].append(better.point)
        return learnt[key]

    unlearnt = moved(known.point, {
        axis: value for source in known.sources
        for axis, value in zip(axes_of(source), UNLEARNT, strict=True)})
    as_all = yield from learn(np.zeros(len(rows)))
    waiting = [(point, 0) for point in dict.fromkeys((
        *as_all, known.point, unlearnt,
        *((*point, *known.point[len(point):]) for point in begins)))]
    slips_by = dict[Point, FloatArray]()

    def try_noise(point: Point) -> Generator[None, None, None]:
        trial = same.again(noise_at(point), len(rows))
        while trial.advance(BANK_ROWS_IN_STEP):
            yield
        trial.decide()
        told = trial.told(first)
        # what is believed, and the slips before it, for `log_density`
        slips = np.where(told.choice == SLIPPED, (BANK.slip_size**2 + told.far**2) / 3.0, 0.0)
        slips[~is_believed(told.choice)] = -1.0
        found[point] = Learnt(point, trial.evidence + log_prior(point, known), (
            yield from posterior(slips).shown(point))[1], *trial.newest())
        slips_by[point] = slips

    for point, n_rounds in waiting:
        if point in found:
            continue
        yield from try_noise(point)
        # while measurements come there is no time for what is unlikely to lead to the best
        if n_rounds < MOST_ROUNDS and (newest is None or found[point].evidence > max(
                each.evidence for each in found.values()) - BANK.hopeless):
            waiting += [(other, n_rounds + 1) for other in (yield from learn(slips_by[point]))]
    best = max(found.values(), key=lambda each: each.evidence)
    # few slow errors were seen: larger ones may be as likely, and by them the pose is less sure
    for point in (yield from with_larger_errors(posterior(slips_by[best.point]), best.point)):
        if point not in found:
            yield from try_noise(point)
    return Found(best, found)
