# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses that are set, in the frame that their header names."""

import math
from types import SimpleNamespace as Space
from typing import Any

import harness
import numpy as np
import pytest

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.ros.worker import NEWEST, SetPoseInput

ESTIMATE = Space(T_map_odom=np.array([10.0, 5.0, 1.0]), T_map_base=np.array([20.0, -3.0, -2.0]))


def message(
    frame: str, x: float, y: float, yaw: float, *, variances: tuple[float, float, float],
    sec: int = 7,
) -> Any:
    return harness.pose(float(sec), x, y, yaw, frame, variances=variances)


@pytest.mark.parametrize(('frame', 'origin'), [
    ('map', np.zeros(3)), ('', np.zeros(3)), ('/map', np.zeros(3)),
    ('odom', ESTIMATE.T_map_odom), ('base_link', ESTIMATE.T_map_base)])
def test_a_pose_is_read_in_its_frame(frame: str, origin: np.ndarray) -> None:
    setting = SetPoseInput(('map', 'odom', 'base_link'))
    assert setting.receive(message(frame, 1.0, 2.0, 0.5, variances=(0.04, 0.01, 0.01))) is None
    pose = setting.pop(ESTIMATE)
    assert pose is not None
    assert pose.stamp_ns == 7_000_000_000
    np.testing.assert_allclose(pose.pose, se2.compose(origin, np.array([1.0, 2.0, 0.5])))
    along = se2.rotation(float(origin[2])) @ np.array([1.0, 0.0])
    assert along @ pose.covariance[:2, :2] @ along == pytest.approx(0.04)
    assert setting.pop(ESTIMATE) is None


@pytest.mark.parametrize('variances', [
    (0.0, 0.0, 0.0), (math.nan, 1.0, 1.0), (1.0, -1.0, 1.0), (1.0, 1.0, math.inf)])
def test_without_a_covariance_that_is_one_it_is_rvizs(
    variances: tuple[float, float, float],
) -> None:
    setting = SetPoseInput(('map', 'odom', 'base_link'))
    assert setting.receive(message('map', 1.0, 2.0, 0.5, variances=variances, sec=0)) is None
    pose = setting.pop(ESTIMATE)
    assert pose is not None
    assert pose.stamp_ns == NEWEST
    np.testing.assert_allclose(np.sqrt(np.diag(pose.covariance)), [0.5, 0.5, 0.26])


@pytest.mark.parametrize(('frame', 'x', 'reason'), [
    ('elsewhere', 1.0, 'wrong_frame'), ('map', math.nan, 'not_finite'),
    ('map', 1e30, 'too_large')])
def test_what_cannot_be_read_is_refused(frame: str, x: float, reason: str) -> None:
    setting = SetPoseInput(('map', 'odom', 'base_link'))
    answer = setting.receive(message(frame, x, 0.0, 0.0, variances=(1.0, 1.0, 1.0)))
    assert answer is not None
    assert answer.reason == reason
    assert setting.pop(ESTIMATE) is None
