# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Constraints of measurements between hidden nodes have no bias and the right noise."""

from hypothesis import given, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.config import BackendConfig, NodePolicy, OdometryNoise, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import factors
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.measurements import (
    GlobalPose,
    HeadingOnly,
    LoopClosure,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.motion import Attachment
from pose_graph_ros.core.sources import kinds

SECOND = 1_000_000_000
# Compositions of poses of some 50 m.
ROUNDING = 1e-12
# Sample covariances of 2e5 draws: 0.3 % one sigma; second-order terms of the noise: 1 %.
N_SAMPLES = 200_000
SAMPLING = 0.03

T_MAP_ODOM = np.array([30.0, -12.0, 2.1])
# A curved drive, a hidden node every fourth sample.
ODOMETRY = np.zeros((21, 3))
for _k in range(20):
    ODOMETRY[_k + 1] = se2.compose(ODOMETRY[_k], np.array([0.4, 0.02, 0.15]))
STAMPS = SECOND + np.arange(21) * SECOND // 10
NODE_STAMPS = STAMPS[::4]
NODES = se2.compose(T_MAP_ODOM, ODOMETRY[::4])

covered = st.integers(int(STAMPS[0]), int(STAMPS[-1]))


def hidden_nodes(noise: OdometryNoise) -> HiddenNodes:
    """Make a node at every fourth sample."""
    config = BackendConfig(
        nodes=NodePolicy(minimum_travel_distance=1e3, minimum_travel_heading=3.0,
                         moving_interval=0.4, minimum_interval=0.0),
        odometry={'odom': OdometrySource(noise=noise)})
    nodes = HiddenNodes(config, lambda *_: len(nodes))
    for stamp, pose in zip(STAMPS.tolist(), ODOMETRY, strict=True):
        nodes.add_sample(OdometrySample(stamp, pose), 'odom')
    nodes.finish()
    np.testing.assert_array_equal(nodes.stamps_ns, NODE_STAMPS)
    return nodes


PLAIN = hidden_nodes(OdometryNoise())


def anchored(stamp: int, nodes: HiddenNodes = PLAIN) -> Attachment:
    attachment = nodes.attach(stamp)
    assert attachment is not None
    return attachment


def truth(stamp: int) -> FloatArray:
    return se2.compose(T_MAP_ODOM, PLAIN.streams['odom'].timeline.pose(stamp))


def covariance_of(constraint: Factors | Factors) -> FloatArray:
    return np.linalg.inv(constraint.information[0])


def assert_agree(sampled: FloatArray, expected: FloatArray) -> None:
    scale = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
    np.testing.assert_allclose(sampled / scale, expected / scale, atol=SAMPLING)


# --- attachment ------------------------------------------------------------------------------

@given(covered)
def test_a_stamp_is_seen_from_the_last_hidden_node_before_it(stamp: int) -> None:
    attachment = anchored(stamp)
    assert NODE_STAMPS[attachment.node] <= stamp
    assert attachment.node == len(NODE_STAMPS) - 1 or stamp < NODE_STAMPS[attachment.node + 1]
    np.testing.assert_allclose(
        se2.compose(NODES[attachment.node], attachment.motion)[:2], truth(stamp)[:2],
        atol=ROUNDING)
    assert np.min(np.linalg.eigvalsh(attachment.noise)) > -ROUNDING


# --- no bias ---------------------------------------------------------------------------------

@given(covered, st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_a_true_measurement_in_the_map_has_no_error_at_the_true_nodes(
    stamp: int, x: float, y: float,
) -> None:
    pose, lever_arm = truth(stamp), np.array([x, y])
    position = se2.transform(pose, lever_arm)
    for measurement, kind, rows in (
            (GlobalPose(stamp, pose, np.eye(3)), FactorKind.GLOBAL_POSE, [0, 1, 2]),
            (Position(stamp, position, np.eye(2), lever_arm), FactorKind.POSITION, [0, 1]),
            (HeadingOnly(stamp, float(pose[2]), 1.0), FactorKind.HEADING, [2])):
        constraint = kinds.observed('source', measurement, anchored(stamp)).factor
        assert constraint.kind[0] == kind
        error = factors.errors(NODES, constraint)
        np.testing.assert_allclose(error[:, rows], 0.0, atol=ROUNDING)
        np.testing.assert_allclose(
            factors.energies(error, constraint.information), 0.0, atol=ROUNDING)
        assert np.flatnonzero(np.diagonal(constraint.information[0])).tolist() == rows


@given(covered, covered)
def test_a_true_loop_closure_has_no_error_at_the_true_nodes(stamp: int, other: int) -> None:
    z = se2.between(truth(other), truth(stamp))
    constraint = kinds.loop_closure_constraint(
        LoopClosure(stamp, z, np.eye(3), reference_ns=other), anchored(other), anchored(stamp))
    assert constraint.kind[0] == FactorKind.LOOP_CLOSURE
    np.testing.assert_allclose(factors.errors(NODES, constraint), 0.0, atol=ROUNDING)


# --- the right noise -------------------------------------------------------------------------
#
# The nodes are at their true poses. Odometry since then and the measurement are drawn at random.
# The errors of the constraints from these samples are compared with the covariance of the one
# constraint from the means.

# Large enough to matter beside the measurement's, small enough for first order.
NOISY = hidden_nodes(OdometryNoise(
    sigma_distance=0.02, sigma_lateral=0.01, sigma_heading_distance=0.02,
    sigma_heading_turn=0.02))
STAMP, OTHER = int(STAMPS[7]) + SECOND // 40, int(STAMPS[14]) + SECOND // 30
MAP_COVARIANCE = 1e-4 * np.array([[6.0, 1.5, 0.5], [1.5, 2.0, -0.3], [0.5, -0.3, 1.0]])


def draws(covariance: FloatArray, rng: np.random.Generator) -> FloatArray:
    return rng.multivariate_normal(np.zeros(len(covariance)), covariance, N_SAMPLES)


def noisy_motions(attachment: Attachment, rng: np.random.Generator) -> FloatArray:
    return se2.compose(np.tile(attachment.motion, (N_SAMPLES, 1)), draws(attachment.noise, rng))


def tiled(array: FloatArray) -> FloatArray:
    return np.tile(array, (N_SAMPLES, 1))


def test_the_noise_of_a_global_pose_is_that_of_samples() -> None:
    rng = np.random.default_rng(1)
    attachment, pose = anchored(STAMP, NOISY), truth(STAMP)
    measured = pose + draws(MAP_COVARIANCE, rng)
    moved = se2.compose(tiled(NODES[attachment.node]), noisy_motions(attachment, rng))
    errors = se2.between(measured, moved)     # (3.52) through the offset
    constraint = kinds.observed(
        'source', GlobalPose(STAMP, pose, MAP_COVARIANCE), attachment).factor
    assert_agree(np.cov(errors.T), covariance_of(constraint))


def test_the_noise_of_a_position_is_at_least_that_of_samples() -> None:
    rng = np.random.default_rng(2)
    lever_arm = np.array([1.5, -0.7])
    attachment, where = anchored(STAMP, NOISY), se2.transform(truth(STAMP), lever_arm)
    covariance = 0.2 * MAP_COVARIANCE[:2, :2]
    measured = where + draws(covariance, rng)
    moved = se2.compose(tiled(NODES[attachment.node]), noisy_motions(attachment, rng))
    errors = se2.transform(moved, lever_arm) - measured     # in map axes
    constraint = kinds.observed(
        'source', Position(STAMP, where, covariance, lever_arm), attachment).factor
    claimed = np.linalg.inv(constraint.information[0, :2, :2])
    sampled = np.cov(errors.T)
    # the variance is not too small in any direction, and not too large in the worst one
    ratios = np.linalg.eigvals(np.linalg.solve(claimed, sampled)).real
    assert np.max(ratios) == pytest.approx(1.0, abs=SAMPLING)


@pytest.mark.parametrize(('stamp', 'other'), [(OTHER, STAMP), (STAMP, OTHER)])
def test_the_noise_of_a_loop_closure_is_that_of_samples(stamp: int, other: int) -> None:
    rng = np.random.default_rng(3)
    attachment, reference = anchored(stamp, NOISY), anchored(other, NOISY)
    z = se2.between(truth(other), truth(stamp))
    measured = z + draws(MAP_COVARIANCE, rng)     # in the axes of the reference pose
    mean = se2.compose(se2.compose(noisy_motions(reference, rng), measured),
                       se2.inverse(noisy_motions(attachment, rng)))
    between = se2.between(NODES[reference.node], NODES[attachment.node])
    errors = se2.between(mean, tiled(between))     # (3.48)
    constraint = kinds.loop_closure_constraint(
        LoopClosure(stamp, z, MAP_COVARIANCE, reference_ns=other), reference, attachment)
    assert (constraint.i[0], constraint.j[0]) == (reference.node, attachment.node)
    assert_agree(np.cov(errors.T), covariance_of(constraint))


def test_the_noise_of_a_heading_is_that_of_samples() -> None:
    rng = np.random.default_rng(4)
    attachment, heading = anchored(STAMP, NOISY), float(truth(STAMP)[2])
    moved = se2.compose(tiled(NODES[attachment.node]), noisy_motions(attachment, rng))
    errors = se2.wrap(moved[:, 2] - heading - 0.01 * rng.standard_normal(N_SAMPLES))
    constraint = kinds.observed('source', HeadingOnly(STAMP, heading, 1e-4), attachment).factor
    assert constraint.kind[0] == FactorKind.HEADING
    assert np.var(errors) == pytest.approx(1.0 / constraint.information[0, 2, 2], rel=SAMPLING)
    np.testing.assert_array_equal(constraint.information[0, :2], 0.0)
    np.testing.assert_array_equal(constraint.information[0, :, :2], 0.0)


@pytest.mark.parametrize(('stamp', 'other'), [(OTHER, STAMP), (STAMP, OTHER)])
def test_a_relative_heading_does_not_constrain_the_position(stamp: int, other: int) -> None:
    rng = np.random.default_rng(5)
    attachment, reference = anchored(stamp, NOISY), anchored(other, NOISY)
    turn = float(se2.wrap(truth(stamp)[2] - truth(other)[2]))
    # the positions do not matter
    closure = LoopClosure(stamp, np.array([7.0, -9.0, turn]), np.diag([np.inf, np.inf, 1e-4]),
                          reference_ns=other)
    constraint = kinds.loop_closure_constraint(closure, reference, attachment)
    error = factors.errors(NODES, constraint)
    assert error[0, 2] == pytest.approx(0.0, abs=ROUNDING)
    information = constraint.information[0].copy()
    expected = np.var(0.01 * rng.standard_normal(N_SAMPLES)
                      + noisy_motions(attachment, rng)[:, 2] + noisy_motions(reference, rng)[:, 2])
    assert 1.0 / information[2, 2] == pytest.approx(expected, rel=SAMPLING)
    information[2, 2] = 0.0
    np.testing.assert_array_equal(information, 0.0)
