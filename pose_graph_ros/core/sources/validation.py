# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Covariances of measurements: reject what cannot be used, repair them where possible.

Only x, y and yaw of a covariance are used, in the axes in which the sender gave them. A variance
that is zero, negative or not a number is unknown. One that is infinite, or larger than the square
of any distance on the Earth, is uninformative: the number that it belongs to means nothing.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import measurements as ms
from pose_graph_ros.core.config import CovariancePolicy, Heading
from pose_graph_ros.core.geometry import covariance
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray

# Lower bound of the eigenvalues of a repaired correlation matrix.
LEAST_EIGENVALUE = 1e-6


class Validated(NamedTuple):
    measurement: ms.PoseMeasurement
    repairs: tuple[str, ...]  # keys for counting, such as `default_covariance`


Checked = Validated | ms.Answer  # what is left of a measurement, or why it is rejected


def check_position(measurement: ms.Position | ms.Fix, policy: CovariancePolicy) -> Checked:
    """Return a position with a valid covariance, or why it is rejected."""
    return _finished(measurement, *_given(measurement.covariance, policy), policy)


def check_pose(measurement: ms.GlobalPose, policy: CovariancePolicy) -> Checked:
    """Return a pose, or its position or heading if it has no information on the other."""
    never = policy.heading is Heading.NEVER
    if np.all(_is_uninformative(measurement.covariance)[:2]):
        variance = None if never else _heading_variance(measurement.covariance, policy)
        return _no_information(measurement) if variance is None else Validated(
            ms.HeadingOnly(measurement.stamp_ns, float(measurement.pose[2]), variance), ())
    cov, repairs = _given(measurement.covariance, policy)
    if len(repairs) > 0 and policy.heading is not Heading.ALWAYS:
        cov[2, 2] = np.inf  # a sender that does not know its covariance knows no heading
    is_known = 0.0 < cov[2, 2] < covariance.UNKNOWN_HEADING_VARIANCE    # of a flat guess
    if never or (policy.heading is Heading.AUTO and not is_known):
        position = ms.Position(
            measurement.stamp_ns, measurement.pose[:2], cov[:2, :2], np.zeros(2))
        return _finished(position, cov[:2, :2], repairs, policy)
    if not is_known:
        cov[2, :] = cov[:, 2] = 0.0
        cov[2, 2] = policy.default_heading**2
    return _finished(measurement, cov, repairs, policy)


def check_closure(measurement: ms.LoopClosure, policy: CovariancePolicy) -> Checked:
    """Return a loop closure; without information on the position, that is infinite."""
    if not np.all(_is_uninformative(measurement.covariance)[:2]):
        return _finished(measurement, *_given(measurement.covariance, policy), policy)
    variance = _heading_variance(measurement.covariance, policy)
    return _no_information(measurement) if variance is None else Validated(
        replace(measurement, covariance=np.diag((np.inf, np.inf, variance))), ())


def check_heading(measurement: ms.HeadingOnly, policy: CovariancePolicy) -> Checked:
    """Return a heading with a valid variance, or why it is rejected."""
    variance, repairs = measurement.variance, list[str]()
    if not variance > 0.0 and len(policy.override) < 2:
        if not policy.repair:
            return ms.rejected('covariance_not_positive', f'variance of a heading: {variance}')
        variance = policy.default_heading**2
        repairs.append('default_covariance')
    valid = _heading_variance(np.diag((0.0, 0.0, variance)), policy)
    if valid is None:
        return ms.rejected('no_information', f'variance of a heading: {variance}')
    return Validated(replace(measurement, variance=valid), tuple(repairs))


def check_range(measurement: ms.Range, policy: CovariancePolicy) -> Checked:
    """Return a range with a valid variance, or why it is rejected."""
    if measurement.distance <= 0.0:
        return ms.rejected('no_information', f'a range of {measurement.distance} m')
    variance = np.array([[measurement.variance]])
    cov, repairs = _given(variance, policy)
    if not 0.0 < cov[0, 0] <= covariance.LARGEST_VARIANCE:
        cov, repairs = repaired(cov, policy), [*repairs, 'repaired_covariance_not_positive']
    bounded = np.clip(policy.scale * cov[0, 0], policy.position_floor**2,
                      policy.position_ceiling**2)
    return Validated(replace(measurement, variance=float(bounded)), tuple(repairs))


def _given(given: FloatArray, policy: CovariancePolicy) -> tuple[FloatArray, list[str]]:
    """Return a covariance as a policy overrides it, or its default, and what was repaired."""
    cov = np.array(given, dtype=np.float64)
    if len(policy.override) > 0:
        variances = np.diagonal(cov).copy()
        variances[:2] = policy.override[0]**2
        variances[2:] = policy.override[-1]**2 if len(policy.override) == 2 else variances[2:]
        return np.diag(variances), []
    if not np.any(cov) and policy.repair:
        return np.diag(_defaults(policy)[:len(cov)]), ['default_covariance']
    return cov, []


def _finished(measurement: ms.GlobalPose | ms.Position | ms.LoopClosure | ms.Fix, cov: FloatArray,
              repairs: list[str], policy: CovariancePolicy) -> Checked:
    """Return a measurement with a covariance that is repaired, scaled and within the bounds."""
    defect = covariance.defect(cov)
    if defect is not None:
        if not policy.repair:
            return ms.rejected(
                f'covariance_{defect}', f'{type(measurement).__name__}: expected a positive '
                f'definite matrix, got {cov.tolist()}; covariance_override replaces it')
        cov = repaired(cov, policy)
        repairs.append(f'repaired_covariance_{defect}')
    floors = np.array([policy.position_floor, policy.position_floor, policy.heading_floor])
    cov = covariance.floored(policy.scale * cov, floors[:len(cov)]**2)
    factor = np.minimum(1.0, np.sqrt(_ceilings(policy)[:len(cov)] / np.diagonal(cov)))
    return Validated(
        replace(measurement, covariance=cov * factor * factor[:, None]), tuple(repairs))


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


def _no_information(measurement: ms.GlobalPose | ms.LoopClosure) -> ms.Answer:
    return ms.rejected('no_information', (
        f'{type(measurement).__name__}: {np.asarray(measurement.covariance).tolist()}'))


def _heading_variance(cov: FloatArray, policy: CovariancePolicy) -> float | None:
    """Return the variance of a heading within the bounds [rad^2]; None if it is not known."""
    variance = float(cov[2, 2]) if len(policy.override) < 2 else policy.override[1]**2
    if not 0.0 < variance < covariance.UNKNOWN_HEADING_VARIANCE:
        return None
    return min(max(policy.scale * variance, policy.heading_floor**2),
               covariance.UNKNOWN_HEADING_VARIANCE)


def _is_uninformative(cov: FloatArray) -> BoolArray:
    return np.diagonal(cov) > covariance.LARGEST_VARIANCE


def _defaults(policy: CovariancePolicy) -> FloatArray:
    return np.array([policy.default_position, policy.default_position, policy.default_heading])**2


def _ceilings(policy: CovariancePolicy) -> FloatArray:
    return np.array([policy.position_ceiling**2, policy.position_ceiling**2,
                     covariance.UNKNOWN_HEADING_VARIANCE])
