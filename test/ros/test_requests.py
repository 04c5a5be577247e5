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
from pose_graph_ros.core.judgement.verdicts import Decision
from pose_graph_ros.core.measurements import Answer
from pose_graph_ros.ros.requests import FIRST, NEWEST, read_decision, SetPoseInput

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
    setting = SetPoseInput('map', 'odom', 'base_link')
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
    setting = SetPoseInput('map', 'odom', 'base_link')
    assert setting.receive(message('map', 1.0, 2.0, 0.5, variances=variances, sec=0)) is None
    pose = setting.pop(ESTIMATE)
    assert pose is not None
    assert pose.stamp_ns == NEWEST
    np.testing.assert_allclose(np.sqrt(np.diag(pose.covariance)), [0.5, 0.5, 0.26])


@pytest.mark.parametrize(('frame', 'x', 'reason'), [
    ('elsewhere', 1.0, 'wrong_frame'), ('map', math.nan, 'not_finite'),
    ('map', 1e30, 'too_large')])
def test_what_cannot_be_read_is_refused(frame: str, x: float, reason: str) -> None:
    setting = SetPoseInput('map', 'odom', 'base_link')
    answer = setting.receive(message(frame, x, 0.0, 0.0, variances=(1.0, 1.0, 1.0)))
    assert answer is not None
    assert answer.reason == reason
    assert setting.pop(ESTIMATE) is None


def test_what_was_set_before_there_was_odometry_is_for_its_beginning() -> None:
    setting = SetPoseInput('map', 'odom', 'base_link')
    setting.receive(message('map', 1.0, 2.0, 0.5, variances=(1.0, 1.0, 1.0), sec=7), early=True)
    pose = setting.pop(ESTIMATE)
    assert pose is not None
    assert pose.stamp_ns == FIRST


def test_the_newest_counts_and_forgotten_ones_do_not() -> None:
    setting = SetPoseInput('map', 'odom', 'base_link')
    for x in (1.0, 2.0):
        setting.receive(message('map', x, 0.0, 0.0, variances=(1.0, 1.0, 1.0)))
    pose = setting.pop(ESTIMATE)
    assert pose is not None
    assert pose.pose[0] == 2.0
    setting.receive(message('map', 1.0, 0.0, 0.0, variances=(1.0, 1.0, 1.0)))
    setting.forget()
    assert setting.pop(ESTIMATE) is None


@pytest.mark.parametrize(('value', 'expected'), [
    ('in', Decision.IN), ('OUT', Decision.OUT), (' auto ', Decision.AUTO)])
def test_a_decision_is_read(value: str, expected: Decision) -> None:
    assert read_decision(Space(key='loop/7', value=value)) == ('loop/7', expected)


def test_another_word_is_answered_with_those_that_are_expected() -> None:
    answer = read_decision(Space(key='loop/7', value='maybe'))
    assert isinstance(answer, Answer)
    assert answer.reason == 'unknown_decision'
    assert answer.detail == (
        "expected one of in, out, auto as the value for the key 'loop/7', got 'maybe'")
