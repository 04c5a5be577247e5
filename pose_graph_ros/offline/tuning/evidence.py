# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
From the most likely noise to what a drive proves: nothing is written that is surer than that.

The likelihood knows what changes between measurements. It is blind to errors of a source that
last longer than the drive, and takes slower ones than it models for motion. So a source claims
less than before only as far as odometry, laid over its positions without any model of noise,
shows: there its errors are all that is left, slow ones too, and only as many pieces of the drive
as these can change in are independent. Less noise of odometry is written with the upper end of
its interval. The path depends on ratios of noise: where a source keeps more than was found,
odometry keeps as much more.
"""

from collections.abc import Mapping, Sequence
import math

import numpy as np
from scipy.special import gammaincinv

from pose_graph_ros.offline.tuning import likelihood as lk
from pose_graph_ros.offline.tuning.drive_rows import DriveRows
from pose_graph_ros.offline.tuning.fit import Fit, Found, WIDE
from pose_graph_ros.offline.tuning.problem import Role

# Time in which slow errors of a receiver change: satellites, ionosphere, reflections [s].
SLOW = 300.0
# Probability that a variance is larger than the end of its interval.
TAIL = 0.025


def largest_ratio(squares: float, degrees: float) -> float:
    """
    Return the upper end of the interval of a variance from a mean of squared errors.

    Parameters
    ----------
    squares : float, mean squared error
    degrees : float, number of independent errors; infinite is returned without any

    """
    if degrees <= 0.0:
        return math.inf
    quantile = 2.0 * float(gammaincinv(0.5 * degrees, TAIL))
    return squares * degrees / quantile if quantile > 0.0 else math.inf


def shown_variances(rows: DriveRows, count: int) -> list[float]:
    """
    Return how large the variances of sources can be at most, in units of those they claim.

    Parameters
    ----------
    rows : DriveRows
    count : int, number of sources

    """
    steps = rows.rows[:, :3]
    headings = np.cumsum(steps[:, 2])
    before = np.concatenate(([0.0], headings[:-1]))
    path = np.cumsum((steps[:, 0] + 1j * steps[:, 1]) * np.exp(1j * before))
    path += (rows.rows[:, lk.ARM_X] + 1j * rows.rows[:, lk.ARM_Y]) * np.exp(1j * headings)
    shown = []
    for k in range(count):
        own = (rows.source == k) & (rows.rows[:, lk.XX] > 0.0)
        if np.sum(own) < 2:
            shown.append(math.inf)
            continue
        there = rows.rows[own, lk.X] + 1j * rows.rows[own, lk.Y]
        here, there = path[own] - np.mean(path[own]), there - np.mean(there)
        turn = np.angle(np.sum(np.conj(here) * there))
        errors = np.abs(there - here * np.exp(1j * turn))**2
        claimed = rows.rows[own, lk.XX] + rows.rows[own, lk.YY]
        # two coordinates, without the three numbers by which odometry was laid there
        pieces = float(np.ptp(rows.seconds[own])) / SLOW
        shown.append(largest_ratio(float(np.mean(errors / claimed)), 2.0 * pieces - 3.0))
    return shown


def proven(fits: Mapping[str, Fit], shown: Sequence[float], duration: float) -> dict[str, Fit]:
    """
    Return fits, that with the sources first, with the values that the data prove.

    Parameters
    ----------
    fits : mapping
    shown : sequence of float, for each source, as by `shown_variances`
    duration : float, of the drive [s]

    """
    every = [each for fit in fits.values() for each in fit.found]
    known = {each.parameter.index for each in every if each.parameter.role is Role.TAU
             and not each.is_wide and _is_known(duration / each.value)}
    written: dict[tuple[Role, int], Found] = {}
    excess = 1.0
    for each in every:
        role, index, setting = each.parameter.role, each.parameter.index, each.parameter.setting
        if role is Role.CLOSURE:
            # their constraints share noise of odometry up to the hidden nodes
            value = max(each.value, setting)
            excess = max(excess, value / each.value)
        elif role in (Role.WHITE, Role.CORRELATED, Role.HEADING):
            is_known = role is not Role.CORRELATED or index in known
            value = _safe(each, max(each.high, shown[index])) if is_known else setting
            excess = max(excess, math.sqrt(value / each.value))
        elif role is Role.ODOMETRY or index not in known:
            continue
        else:
            value = each.value
        written[role, index] = _written(each, value)

    def result(each: Found) -> Found | None:
        if each.parameter.role is Role.ODOMETRY:
            # slow errors of sources look like more noise of it, so less than that is proven, too
            setting = each.parameter.setting
            return _written(each, max(each.low, setting) if each.value > setting else _safe(
                each, excess * each.high))
        return written.get((each.parameter.role, each.parameter.index))
    return {name: fit._replace(found=tuple(filter(None, map(result, fit.found))))
            for name, fit in fits.items()}


def _is_known(degrees: float) -> bool:
    """Tell whether so many independent errors give a variance to a factor of `WIDE`."""
    ends = gammaincinv(0.5 * degrees, np.array((TAIL, 1.0 - TAIL)))
    return bool(ends[1] < WIDE * ends[0])


def _safe(each: Found, high: float) -> float:
    """Return the most likely value; of less noise than before the upper end."""
    setting = each.parameter.setting
    return each.value if each.value >= setting else min(high, setting)


def _written(each: Found, value: float) -> Found:
    return each._replace(value=value, high=max(each.high, value),
                         kept=value == each.parameter.setting)
