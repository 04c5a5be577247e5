# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Validation of measurements: reject what cannot be used, repair covariances where possible.

Only x, y and yaw of a covariance are used, in the axes in which the sender gave them. A variance
that is zero, negative or not a number is unknown. One that is infinite, or larger than the square
of any distance on the Earth, is uninformative: the number that it belongs to means nothing.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.config import CovariancePolicy, Heading
from pose_graph_ros.core.geometry import covariance
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray
from pose_graph_ros.core.measurements import (
    Answer,
    Fix,
    GlobalPose,
    HeadingOnly,
    LARGEST_STAMP,
    LoopClosure,
    PoseMeasurement,
    Position,
    rejected,
    value_defect,
)

# Lower bound of the eigenvalues of a repaired correlation matrix.
LEAST_EIGENVALUE = 1e-6


class Validated(NamedTuple):
    measurement: PoseMeasurement
    repairs: tuple[str, ...]  # keys for counting, such as `default_covariance`


def validate(measurement: PoseMeasurement, policy: CovariancePolicy) -> Validated | Answer:
    """Return a measurement without what it has no information on, or why it is rejected."""
    kind = type(measurement).__name__
    numbers = _numbers(measurement)
    defect = value_defect(numbers)
    if defect is not None:
        return rejected(defect, f'{kind}: {numbers.tolist()}')
    stamps = _stamps(measurement)
    if stamps[0] <= 0 or any(abs(stamp) > LARGEST_STAMP for stamp in stamps):
        return rejected('zero_stamp' if stamps[0] <= 0 else 'no_stamp',
                        f'{kind}: expected stamps above 0, got {stamps} ns')
    if isinstance(measurement, HeadingOnly):
        return _validate_heading(measurement, policy)
    cov, repairs = np.array(measurement.covariance, dtype=np.float64), []
    if len(cov) == 3 and np.all(_is_uninformative(cov)[:2]):
        return _without_position(measurement, cov, policy)
    if len(policy.override) > 0:
        cov = _overridden(cov, policy)
    elif not np.any(cov) and policy.repair:
        cov = np.diag(_defaults(policy)[:len(cov)])
        repairs.append('default_covariance')
        if isinstance(measurement, GlobalPose) and policy.heading is not Heading.ALWAYS:
            cov[2, 2] = np.inf  # a sender that does not know its covariance knows no heading
    if isinstance(measurement, GlobalPose):
        measurement, cov = _with_heading_policy(measurement, cov, policy)
    defect = covariance.defect(cov)
    if defect is not None:
        if not policy.repair:
            return rejected(
                f'covariance_{defect}', f'{kind}: expected a positive definite matrix, got '
                f'{cov.tolist()}; covariance_override replaces it')
        cov = repaired(cov, policy)
        repairs.append(f'repaired_covariance_{defect}')
    floors = np.array([policy.position_floor, policy.position_floor, policy.heading_floor])
    cov = covariance.floored(policy.scale * cov, floors[:len(cov)]**2)
    return Validated(replace(measurement, covariance=_capped(cov, policy)), tuple(repairs))


def repaired(cov: FloatArray, policy: CovariancePolicy) -> FloatArray:
    """
    Return a usable covariance of x, y and perhaps yaw, close to a broken one.

    Unknown variances are replaced by the default, uninformative ones by the ceiling, both without
    correlations. The rest is made symmetric and, by its eigenvalues, positive definite.
    """
    diagonal, uninformative = np.diagonal(cov).copy(), _is_uninformative(cov)
    unknown = ~uninformative & ~(diagonal > 0.0)
    size = len(cov)
    diagonal[unknown] = _defaults(policy)[:size][unknown]
    diagonal[uninformative] = _ceilings(policy)[:size][uninformative]
    sigma = np.sqrt(diagonal)
    with np.errstate(over='ignore', invalid='ignore'):
        both = np.stack((cov, cov.T)) / sigma / sigma[:, None]
    usable = np.isfinite(both)
    correlation = np.clip(np.where(usable, both, 0.0), -1.0, 1.0).sum(axis=0)
    correlation /= np.maximum(usable.sum(axis=0), 1)
    replaced = uninformative | unknown
    correlation[replaced, :] = correlation[:, replaced] = 0.0
    np.fill_diagonal(correlation, 1.0)
    values, vectors = np.linalg.eigh(correlation)
    correlation = (vectors * np.maximum(values, LEAST_EIGENVALUE)) @ vectors.T
    scale = sigma / np.sqrt(np.diagonal(correlation))
    result: FloatArray = correlation * scale * scale[:, None]
    return 0.5 * (result + result.T)


def _numbers(measurement: PoseMeasurement) -> FloatArray:
    if isinstance(measurement, Position):
        return np.concatenate((measurement.position, measurement.lever_arm))
    if isinstance(measurement, HeadingOnly):
        return np.array([measurement.heading])
    if isinstance(measurement, Fix):
        return measurement.lever_arm    # its position is checked when it is placed
    return measurement.pose


def _overridden(cov: FloatArray, policy: CovariancePolicy) -> FloatArray:
    variances = np.diagonal(cov).copy()
    variances[:2] = policy.override[0]**2
    if len(policy.override) == 2:
        variances[2:] = policy.override[1]**2
    return np.diag(variances)


def _stamps(measurement: PoseMeasurement) -> tuple[int, ...]:
    if isinstance(measurement, LoopClosure):
        return (measurement.stamp_ns, measurement.reference_ns or 0,
                measurement.reference_node or 0)
    return (measurement.stamp_ns,)


def _validate_heading(measurement: HeadingOnly, policy: CovariancePolicy) -> Validated | Answer:
    variance, repairs = measurement.variance, []
    if len(policy.override) == 2:
        variance = policy.override[1]**2
    elif not variance > 0.0:
        if not policy.repair:
            return rejected('covariance_not_positive', f'variance of a heading: {variance}')
        variance = policy.default_heading**2
        repairs.append('default_covariance')
    if not _is_known_heading(variance):
        return rejected('no_information', f'variance of a heading: {variance}')
    return Validated(
        replace(measurement, variance=_heading_variance(variance, policy)), tuple(repairs))


def _without_position(
    measurement: GlobalPose | LoopClosure | Position | Fix, cov: FloatArray,
    policy: CovariancePolicy,
) -> Validated | Answer:
    """Return what is left of a pose without information on the position: its known heading."""
    variance = float(cov[2, 2]) if len(policy.override) < 2 else policy.override[1]**2
    never = isinstance(measurement, GlobalPose) and policy.heading is Heading.NEVER
    if isinstance(measurement, Position | Fix) or never or not _is_known_heading(variance):
        return rejected('no_information', f'{type(measurement).__name__}: {cov.tolist()}')
    variance = _heading_variance(variance, policy)
    if isinstance(measurement, LoopClosure):
        return Validated(replace(measurement, covariance=np.diag((np.inf, np.inf, variance))), ())
    return Validated(
        HeadingOnly(measurement.stamp_ns, float(measurement.pose[2]), variance), ())


def _heading_variance(variance: float, policy: CovariancePolicy) -> float:
    """Return the variance of a heading with factor, floor and ceiling applied [rad^2]."""
    return min(max(policy.scale * variance, policy.heading_floor**2),
               covariance.UNKNOWN_HEADING_VARIANCE)


def _with_heading_policy(
    measurement: GlobalPose, cov: FloatArray, policy: CovariancePolicy,
) -> tuple[GlobalPose | Position, FloatArray]:
    """Return a global pose, or its position if the policy does not use the heading."""
    known = _is_known_heading(cov[2, 2])
    if policy.heading is Heading.NEVER or (policy.heading is Heading.AUTO and not known):
        return Position(measurement.stamp_ns, measurement.pose[:2], cov[:2, :2],
                        np.zeros(2)), cov[:2, :2]
    if not known:
        cov = cov.copy()
        cov[2, :] = cov[:, 2] = 0.0
        cov[2, 2] = policy.default_heading**2
    return measurement, cov


def _is_known_heading(variance: float) -> bool:
    """Tell whether the variance of a heading is positive and below that of a flat guess."""
    return bool(0.0 < variance < covariance.UNKNOWN_HEADING_VARIANCE)


def _is_uninformative(cov: FloatArray) -> BoolArray:
    return np.diagonal(cov) > covariance.LARGEST_VARIANCE


def _defaults(policy: CovariancePolicy) -> FloatArray:
    return np.array([policy.default_position, policy.default_position, policy.default_heading])**2


def _ceilings(policy: CovariancePolicy) -> FloatArray:
    return np.array([policy.position_ceiling**2, policy.position_ceiling**2,
                     covariance.UNKNOWN_HEADING_VARIANCE])


def _capped(cov: FloatArray, policy: CovariancePolicy) -> FloatArray:
    factor = np.minimum(1.0, np.sqrt(_ceilings(policy)[:len(cov)] / np.diagonal(cov)))
    return np.asarray(cov * factor * factor[:, None])
