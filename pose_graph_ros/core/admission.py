# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The door for measurements: what cannot be used is refused, what can be mended is mended.

Of every covariance only x, y and yaw are looked at, in the axes in which the sender gave them. A
variance tells one of three things: how good the number is, that nobody knows (zero, negative, not
a number), or that the number says nothing (infinite, or too large for anything on the Earth).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import covariance
from pose_graph_ros.core.measurements import (
    Answer,
    GlobalPose,
    HeadingOnly,
    LARGEST_STAMP,
    LoopClosure,
    Measurement,
    Position,
    rejected,
    value_defect,
)
from pose_graph_ros.core.se2 import FloatArray
from pose_graph_ros.core.sources import CovariancePolicy, Heading

# Eigenvalues of a correlation matrix below this are raised to it.
LEAST_EIGENVALUE = 1e-6


class Admitted(NamedTuple):
    """A measurement that can be used, and what was mended in it."""

    measurement: Measurement
    repairs: tuple[str, ...]
    """Words for counting, such as `default_covariance`."""


def admit(measurement: Measurement, policy: CovariancePolicy) -> Admitted | Answer:
    """
    Return the measurement as it can be used, or why it cannot.

    Of a pose that says nothing about the heading the position is left, and of one that says
    nothing about the position the heading.
    """
    kind = type(measurement).__name__
    broken = value_defect(_numbers(measurement))
    if broken is not None:
        return rejected(broken, f'{kind}: {_numbers(measurement).tolist()}')
    stamps = _stamps(measurement)
    if stamps[0] <= 0 or any(abs(stamp) > LARGEST_STAMP for stamp in stamps):
        return rejected('zero_stamp' if stamps[0] <= 0 else 'no_stamp', f'{kind}: {stamps}')
    if isinstance(measurement, HeadingOnly):
        return _admit_heading(measurement, policy)
    cov, repairs = np.array(measurement.covariance, dtype=np.float64), []
    if len(cov) == 3 and _says_nothing(cov[0, 0]) and _says_nothing(cov[1, 1]):
        return _without_position(measurement, cov, policy)
    if len(policy.override) > 0:
        cov = _overridden(cov, policy)
    elif not np.any(cov) and policy.repair:
        cov = np.diag(_defaults(policy)[:len(cov)])
        repairs.append('default_covariance')
        if isinstance(measurement, GlobalPose) and policy.heading is not Heading.ALWAYS:
            cov[2, 2] = np.inf  # who does not know the covariance knows no heading either
    if isinstance(measurement, GlobalPose):
        measurement, cov = _with_heading_judged(measurement, cov, policy)
    defect = covariance.defect(cov)
    if defect is not None:
        if not policy.repair:
            return rejected(f'covariance_{defect}', f'{kind}: {cov.tolist()}')
        cov = mended(cov, policy)
        repairs.append(f'repaired_covariance_{defect}')
    floors = np.array([policy.position_floor, policy.position_floor, policy.heading_floor])
    cov = covariance.floored(policy.scale * cov, floors[:len(cov)]**2)
    return Admitted(replace(measurement, covariance=_lowered(cov, policy)), tuple(repairs))


def mended(cov: FloatArray, policy: CovariancePolicy) -> FloatArray:
    """
    Return the covariance nearest to a broken one, shape (d, d), that can be used.

    Unknown variances become the default, those that say nothing the ceiling, both without
    correlations; the rest is made symmetric and positive definite, by its eigenvalues.
    """
    diagonal = np.diagonal(cov).copy()
    nothing = np.array([_says_nothing(variance) for variance in diagonal])
    unknown = ~nothing & ~(diagonal > 0.0)
    size = len(cov)
    diagonal[unknown] = _defaults(policy)[:size][unknown]
    diagonal[nothing] = _ceilings(policy)[:size][nothing]
    sigma = np.sqrt(diagonal)
    with np.errstate(over='ignore', invalid='ignore'):
        both = np.stack((cov, cov.T)) / sigma / sigma[:, None]
    usable = np.isfinite(both)
    correlation = np.clip(np.where(usable, both, 0.0), -1.0, 1.0).sum(axis=0)
    correlation /= np.maximum(usable.sum(axis=0), 1)
    alone = nothing | unknown
    correlation[alone, :] = correlation[:, alone] = 0.0
    np.fill_diagonal(correlation, 1.0)
    values, vectors = np.linalg.eigh(correlation)
    correlation = (vectors * np.maximum(values, LEAST_EIGENVALUE)) @ vectors.T
    scale = sigma / np.sqrt(np.diagonal(correlation))
    result: FloatArray = correlation * scale * scale[:, None]
    return 0.5 * (result + result.T)


def _numbers(measurement: Measurement) -> FloatArray:
    if isinstance(measurement, Position):
        return np.concatenate((measurement.position, measurement.lever_arm))
    if isinstance(measurement, HeadingOnly):
        return np.array([measurement.heading])
    return measurement.pose


def _overridden(cov: FloatArray, policy: CovariancePolicy) -> FloatArray:
    """Return the covariance, shape (d, d), with the sigmas that are taken instead."""
    variances = np.diagonal(cov).copy()
    variances[:2] = policy.override[0]**2
    if len(policy.override) == 2:
        variances[2:] = policy.override[1]**2
    return np.diag(variances)


def _stamps(measurement: Measurement) -> tuple[int, ...]:
    if isinstance(measurement, LoopClosure):
        return (measurement.stamp_ns, measurement.reference_ns or 0,
                measurement.reference_node or 0)
    return (measurement.stamp_ns,)


def _admit_heading(measurement: HeadingOnly, policy: CovariancePolicy) -> Admitted | Answer:
    variance, repairs = measurement.variance, []
    if len(policy.override) == 2:
        variance = policy.override[1]**2
    elif not variance > 0.0:
        if not policy.repair:
            return rejected('covariance_not_positive', f'variance of a heading: {variance}')
        variance = policy.default_heading**2
        repairs.append('default_covariance')
    if not _known(variance):
        return rejected('no_information', f'variance of a heading: {variance}')
    return Admitted(
        replace(measurement, variance=_heading_variance(variance, policy)), tuple(repairs))


def _without_position(
    measurement: GlobalPose | LoopClosure | Position, cov: FloatArray, policy: CovariancePolicy,
) -> Admitted | Answer:
    """Admit a pose, or a relative pose, whose heading alone means something."""
    variance = float(cov[2, 2]) if len(policy.override) < 2 else policy.override[1]**2
    never = isinstance(measurement, GlobalPose) and policy.heading is Heading.NEVER
    if isinstance(measurement, Position) or never or not _known(variance):
        return rejected('no_information', f'{type(measurement).__name__}: {cov.tolist()}')
    variance = _heading_variance(variance, policy)
    if isinstance(measurement, LoopClosure):
        return Admitted(replace(measurement, covariance=np.diag((np.inf, np.inf, variance))), ())
    return Admitted(
        HeadingOnly(measurement.stamp_ns, float(measurement.pose[2]), variance), ())


def _heading_variance(variance: float, policy: CovariancePolicy) -> float:
    """Return a known variance of a heading alone, with the factor, the floor and the ceiling."""
    return min(max(policy.scale * variance, policy.heading_floor**2),
               covariance.UNKNOWN_HEADING_VARIANCE)


def _with_heading_judged(
    measurement: GlobalPose, cov: FloatArray, policy: CovariancePolicy,
) -> tuple[GlobalPose | Position, FloatArray]:
    """Return a global pose, or its position if its heading is not to be used."""
    known = _known(cov[2, 2])
    if policy.heading is Heading.NEVER or (policy.heading is Heading.AUTO and not known):
        return Position(measurement.stamp_ns, measurement.pose[:2], cov[:2, :2],
                        np.zeros(2)), cov[:2, :2]
    if not known:
        cov = cov.copy()
        cov[2, :] = cov[:, 2] = 0.0
        cov[2, 2] = policy.default_heading**2
    return measurement, cov


def _known(variance: float) -> bool:
    """Tell whether the variance of a heading is neither infinite, nor huge, nor zero, nor less."""
    return bool(0.0 < variance < covariance.UNKNOWN_HEADING_VARIANCE)


def _says_nothing(variance: float) -> bool:
    return bool(variance > covariance.LARGEST_VARIANCE)


def _defaults(policy: CovariancePolicy) -> FloatArray:
    return np.array([policy.default_position, policy.default_position, policy.default_heading])**2


def _ceilings(policy: CovariancePolicy) -> FloatArray:
    return np.array([policy.position_ceiling**2, policy.position_ceiling**2,
                     covariance.UNKNOWN_HEADING_VARIANCE])


def _lowered(cov: FloatArray, policy: CovariancePolicy) -> FloatArray:
    """Scale what exceeds the ceiling down to it; correlations stay."""
    factor = np.minimum(1.0, np.sqrt(_ceilings(policy)[:len(cov)] / np.diagonal(cov)))
    return np.asarray(cov * factor * factor[:, None])
