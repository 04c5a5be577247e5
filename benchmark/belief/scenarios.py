# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is done to a clean drive, whose fixes have white errors of 1 m, at 1 Hz, and claim 1 m.

Times of an outage are those since the start of the drive.
"""

from dataclasses import dataclass, replace

import numpy as np

from benchmark.drives import Drive, SECOND, SIGMA
from benchmark.fixes import aside, continued, Fault, jumps, two_receivers
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray
from pose_graph_ros.offline.simulation.worlds import gauss_markov

OUTAGE_S, ASIDE_S, ASIDE = 60.0, 30.0, 40.0
"""Length of an outage, and for how long how far aside all fixes are after it [s, s, m]."""
OFFSET, EVER = 15.0, 1e6
"""Of one of two receivers [m], and longer than any drive [s]."""
WHITE, SLOW, SLOW_S = 0.3, 2.0, 60.0
"""White and slow errors of correlated fixes [m, m], and how long the latter live [s]."""
CAMPUS_SLOW, AMPLITUDE = 3.0, 0.55
"""Slow errors of a consumer receiver [m], and the spread of their logarithm."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """What is done to a drive, and the true errors of right fixes."""

    change: Fault
    sigma: float = SIGMA
    """Of a coordinate [m]."""
    tau: float = 0.0
    """How long they live [s]; 0: white."""


def length(drive: Drive) -> float:
    """Return the length of a drive [s]."""
    return float(np.ptp(drive.odometry.stamps_ns)) / SECOND


def during(drive: Drive, begin: float, lasting: float) -> BoolArray:
    """Return which fixes are of a time [s]."""
    since = (drive.stamps_ns - drive.odometry.stamps_ns[0]) / SECOND
    return np.asarray((since >= begin) & (since < begin + lasting))


def wandering(drive: Drive, rng: np.random.Generator, sigma: float, tau: float) -> FloatArray:
    """Return slow errors of all fixes, shape (M, 2) [m]."""
    period = float(np.median(np.diff(drive.stamps_ns))) / SECOND
    return np.column_stack([gauss_markov(rng, len(drive.fixes), sigma, period / tau)
                            for _ in range(2)])


def bursts(
    seconds: tuple[float, float], between: float, far: tuple[float, float], wander: float,
    wander_s: float,
) -> Fault:
    """
    Return stretches of wrong fixes, with a mean time between them [s].

    Each has an offset [m], which wanders by a part of it.
    """
    def make(drive: Drive, rng: np.random.Generator) -> Drive:
        begin = rng.exponential(between)
        while begin < length(drive):
            lasting, distance = rng.uniform(*seconds), rng.uniform(*far)
            by = aside(rng, distance) + wandering(drive, rng, wander * distance, wander_s)
            drive = drive.moved(during(drive, begin, lasting), by)
            begin += lasting + rng.exponential(between)
        return drive
    return make


def _outage(drive: Drive) -> float:
    return min(0.25 * length(drive), 600.0)


def outage(drive: Drive, rng: np.random.Generator) -> Drive:
    """Return an outage, after which all fixes are aside for a while."""
    begin = _outage(drive)
    silent = drive.only(~during(drive, begin, OUTAGE_S))
    return silent.moved(during(silent, begin + OUTAGE_S, ASIDE_S), aside(rng, ASIDE))


def start(drive: Drive, rng: np.random.Generator) -> Drive:
    """Return a drive whose first fixes are all aside."""
    return drive.moved(during(drive, 0.0, ASIDE_S), aside(rng, ASIDE))


def slip(drive: Drive, _: np.random.Generator) -> Drive:
    """
    Return an outage in whose middle odometry goes forward by 10 m too much.

    It does so within a second, as the engine sees a jump in one message by its speed.
    """
    begin = _outage(drive)
    at_ns = int(drive.odometry.stamps_ns[0]) + round((begin + 0.5 * OUTAGE_S) * SECOND)
    return replace(drive.only(~during(drive, begin, OUTAGE_S)), odometry=continued(
        drive.odometry, at_ns, np.array((10.0, 0.0, 0.0)), 1.0))


def two_all(drive: Drive, rng: np.random.Generator) -> Drive:
    """Return two receivers of which one is always aside: either of them, by the seed."""
    if rng.random() < 0.5:
        return two_receivers(OFFSET, EVER, -EVER)(drive, rng)
    return two_receivers(0.0, 0.0)(drive, rng).moved(
        during(drive, 0.0, EVER), aside(rng, OFFSET))


def correlated(claim: float) -> Fault:
    """Return slow errors of fixes that claim something else [m]."""
    return lambda drive, rng: replace(
        drive, sigma=claim, fixes=drive.truth.at(drive.stamps_ns)[:, :2] + wandering(
            drive, rng, SLOW, SLOW_S) + rng.normal(0.0, WHITE, drive.fixes.shape))


def campus(drive: Drive, rng: np.random.Generator) -> Drive:
    """
    Return what a consumer receiver says on a campus, at 4 Hz, with a claim of 3 m.

    Blackouts are of 130, 200 and, on long drives, 460 s; for 24 s after the second one all fixes
    are 770 m off, and wander.
    """
    stamps = np.arange(drive.stamps_ns[0], drive.stamps_ns[-1], SECOND // 4)
    made = replace(drive, sigma=3.0, stamps_ns=stamps, fixes=drive.truth.at(stamps)[:, :2])
    amplitude = np.exp(wandering(made, rng, AMPLITUDE, SLOW_S)[:, :1])
    noise = amplitude * wandering(made, rng, CAMPUS_SLOW, SLOW_S)
    noise += rng.normal(0.0, WHITE, noise.shape)
    made = bursts((10.0, 60.0), 360.0, (15.0, 60.0), 0.3, 15.0)(
        replace(made, fixes=made.fixes + noise), rng)
    whole = length(drive)
    made = made.moved(during(made, 0.55 * whole + 200.0, 24.0),
                      aside(rng, 770.0) + wandering(made, rng, 35.0, 10.0))
    for share, lasting in ((0.2, 130.0), (0.55, 200.0), (0.8, 460.0)):
        if lasting <= 200.0 or whole >= 2400.0:
            made = made.only(~during(made, share * whole, lasting))
    # the set of the wrong ones names those of the blackouts too
    said = {('fix', stamp) for stamp in made.stamps_ns.tolist()}
    return replace(made, wrong=made.wrong & said)


SCENARIOS = {
    'clean': Scenario(lambda drive, _: drive),
    'outliers': Scenario(jumps(0.2, 20.0, 50.0)),
    'outage': Scenario(outage),
    'start': Scenario(start),
    'multipath': Scenario(
        # of 17.5 s in the mean, 15 % of the time
        bursts((5.0, 30.0), 17.5 * 0.85 / 0.15, (5.0, 50.0), 0.2, 20.0)),
    'correlated_1m': Scenario(correlated(1.0), np.hypot(SLOW, WHITE), SLOW_S),
    'correlated_2m': Scenario(correlated(2.0), np.hypot(SLOW, WHITE), SLOW_S),
    'slip': Scenario(slip),
    'two_half': Scenario(two_receivers(OFFSET, EVER)),
    'two_all': Scenario(two_all),
    # of a log-normal amplitude the mean square is that of the exponential
    'campus': Scenario(campus, np.hypot(CAMPUS_SLOW * np.exp(AMPLITUDE**2), WHITE), SLOW_S),
}
