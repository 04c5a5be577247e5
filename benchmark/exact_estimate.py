# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The estimate of a drive that knows all there is to know, without the engine.

A Kalman filter for the errors of the poses at all instants that matter, linear at the truth, with
the covariances by which the noise was drawn and each measurement at its own instant. Its NEES is
one in the mean over drives; over a few drives it is what their noise happens to make it.
"""

import numpy as np

from benchmark.course import Course, SECOND, START_NS
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.measurements import LoopClosure, Position
from pose_graph_ros.offline.simulation.sensors import model_variances

UNKNOWN = 1e4
"""Variance of a pose that nothing is known of [m^2, rad^2]."""


def exact_nees(course: Course, looks: IntArray) -> FloatArray:
    """
    Return the NEES of the newest pose, divided by 3, at some stamps, shape (L,).

    Without fixes the first pose is known, else nothing is known of it.

    Parameters
    ----------
    course : Course
    looks : ndarray of int64, shape (L,), ascending stamps of samples of odometry [ns]

    """
    pieces = list(course.pieces())
    time, measured = (np.concatenate([piece[k] for piece in pieces]) for k in (0, 1))
    truth, others = course.truth(time), [each for piece in pieces for _, each in piece[2]]
    moves = se2.between(truth[:-1], truth[1:])
    noise = se2.between(moves, se2.between(measured[:-1], measured[1:]))
    variances = model_variances(moves)
    # a closure of these drives names its reference by stamp
    stamps = looks.tolist() + [each.reference_ns for each in others
                               if isinstance(each, LoopClosure)]
    at_sample: dict[int, list[LoopClosure | Position]] = {
        sample: [] for sample in _samples(course, stamps)}
    for each in others:
        assert isinstance(each, LoopClosure | Position)
        at_sample.setdefault(_samples(course, [each.stamp_ns])[0], []).append(each)
    wanted, found = {*_samples(course, looks.tolist())}, list[float]()
    # errors of all instants so far, each in the frame of its pose, and their covariance
    error, covariance = np.zeros(3), np.zeros((3, 3))
    if course.fix_period > 0.0:
        covariance += UNKNOWN * np.eye(3)
    columns, last = {0: slice(0, 3)}, 0
    for sample in sorted(at_sample):
        if sample >= len(time):
            break
        if sample > last:
            motion, offset, spread = np.eye(3), np.zeros(3), np.zeros((3, 3))
            for k in range(last, sample):
                step = se2.adjoint(se2.inverse(moves[k]))
                motion, offset = step @ motion, step @ offset + noise[k]
                spread = step @ spread @ step.T + np.diag(variances[k])
            across = motion @ covariance[-3:]
            covariance = np.block([[covariance, across.T],
                                   [across, across[:, -3:] @ motion.T + spread]])
            error = np.append(error, motion @ error[-3:] + offset)
            columns[sample], last = slice(len(error) - 3, len(error)), sample
        for each in at_sample[sample]:
            jacobian, residual, known = _linear(course, each, columns, len(error))
            gain = np.linalg.solve(
                jacobian @ covariance @ jacobian.T + known, jacobian @ covariance).T
            error = error + gain @ (residual - jacobian @ error)
            covariance = covariance - gain @ jacobian @ covariance
            covariance = 0.5 * (covariance + covariance.T)
        if sample in wanted:
            newest = error[-3:]
            found.append(float(newest @ np.linalg.solve(covariance[-3:, -3:], newest)) / 3.0)
    return np.array(found)


def _linear(
    course: Course, measurement: LoopClosure | Position, columns: dict[int, slice], size: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the Jacobian of a measurement by the errors of poses, its error and covariance."""
    new = _samples(course, [measurement.stamp_ns])[0]
    pose = _truth(course, measurement.stamp_ns)
    if isinstance(measurement, Position):
        jacobian = np.zeros((2, size))
        jacobian[:, columns[new]] = se2.rotation(pose[2]) @ np.eye(2, 3)
        return jacobian, measurement.position - pose[:2], measurement.covariance
    assert measurement.reference_ns is not None
    true = se2.between(_truth(course, measurement.reference_ns), pose)
    jacobian = np.zeros((3, size))
    jacobian[:, columns[new]] = np.eye(3)
    old = _samples(course, [measurement.reference_ns])[0]
    jacobian[:, columns[old]] = -se2.adjoint(se2.inverse(true))
    return jacobian, se2.between(true, measurement.pose), np.diag(np.square(course.closure_sigma))


def _truth(course: Course, stamp_ns: int) -> FloatArray:
    return course.truth(np.array([(stamp_ns - START_NS) / SECOND]))[0]


def _samples(course: Course, stamps_ns: list[int]) -> list[int]:
    """Return the numbers of the samples of odometry next to stamps [ns]."""
    return [round((stamp - START_NS) / SECOND * course.odometry_rate) for stamp in stamps_ns]
