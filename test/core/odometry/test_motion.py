# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Motions by odometry: their covariance is that of samples; errors go in and out of both."""

from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np

from pose_graph_ros.core.config import OdometryNoise
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.covariance import UNKNOWN_HEADING_VARIANCE
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.graph_update import Measured
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.odometry.motion import (
    AS_CLAIMED,
    changed,
    Motion,
    odometry_covariance,
    OdometryErrors,
)
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

NOISE = OdometryNoise()
NO_FLOORS = replace(NOISE, sigma_floor_position=1e-9, sigma_floor_heading=1e-9)
lengths = st.floats(0.0, 100.0)
angles = st.floats(-np.pi, np.pi)


@given(lengths, lengths, angles, lengths, lengths)
def test_covariances_are_symmetric_positive_and_have_a_bounded_heading(
    x: float, y: float, theta: float, more: float, turn: float,
) -> None:
    motion = Motion(np.array([x, y, theta]), float(np.hypot(x, y)) + more, abs(theta) + turn)
    cov = odometry_covariance(NOISE, motion)
    np.testing.assert_array_equal(cov, cov.T)
    assert np.linalg.eigvalsh(cov)[0] > 0.0
    assert cov[2, 2] <= UNKNOWN_HEADING_VARIANCE + NOISE.sigma_floor_heading**2


def test_the_covariance_is_that_of_samples_along_a_straight_path() -> None:
    noise, n, length = NO_FLOORS, 200, 20.0
    rng, step = np.random.default_rng(0), length / n
    wrong = rng.standard_normal((3, 5_000, n)) * np.sqrt(step)
    heading = np.cumsum(noise.sigma_heading_distance * wrong[2], axis=1)
    x = length + np.sum(noise.sigma_distance * wrong[0], axis=1)
    y = np.sum(noise.sigma_lateral * wrong[1] + step * heading, axis=1)
    # the true end seen from the measured one
    ends = se2.between(np.column_stack((x, y, heading[:, -1])), np.array([length, 0.0, 0.0]))
    expected = odometry_covariance(noise, Motion(np.array([length, 0.0, 0.0]), length, 0.0))
    root = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        np.cov(ends.T) / root / root[:, None], expected / root / root[:, None], atol=0.05)


SECOND = 1_000_000_000
some_errors = st.builds(
    OdometryErrors, st.floats(0.01, 50.0), st.floats(0.01, 50.0), st.floats(-0.02, 0.02),
    st.floats(-0.05, 0.05))


def edges(seed: int, n: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return motions, covariances and durations."""
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, 0.01, (n, 3, 3)) + 0.02 * np.eye(3)
    # a floor, as odometry has one: the inverse of what is nearly singular has few right digits
    noise = root @ np.swapaxes(root, 1, 2) + 1e-6 * np.eye(3)
    return rng.normal(0.0, 1.0, (n, 3)), noise, rng.uniform(0.1, 3.0, n)


@given(st.integers(0, 1000), some_errors, some_errors)
def test_other_errors_can_be_put_in_and_taken_out(
    seed: int, one: OdometryErrors, other: OdometryErrors,
) -> None:
    means, noise, seconds = edges(seed)
    first = changed(means, np.linalg.inv(noise), seconds, AS_CLAIMED, one)
    np.testing.assert_allclose(np.linalg.inv(first[1]), one.covariances(noise), rtol=1e-7)
    directly = changed(means, np.linalg.inv(noise), seconds, AS_CLAIMED, other)
    for found, expected in zip(changed(*first, seconds, one, other), directly, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)


@given(some_errors)
def test_the_parts_of_the_noise_are_those_of_the_way_and_of_the_heading(
    errors: OdometryErrors,
) -> None:
    """A motion with an error of the heading at its begin, and one of its own."""
    _, noise, _ = edges(3)
    spread = errors.covariances(noise)
    np.testing.assert_allclose(spread[:, 2, 2], errors.turn * noise[:, 2, 2])
    for of, factor in ((noise, 1.0), (spread, errors.way)):
        known = of[:, :2, :2] - of[:, :2, 2:] @ of[:, 2:, :2] / of[:, 2:, 2:]
        by_way = noise[:, :2, :2] - noise[:, :2, 2:] @ noise[:, 2:, :2] / noise[:, 2:, 2:]
        np.testing.assert_allclose(known, factor * by_way, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(OdometryErrors(2.0, 3.0).covariances(np.zeros((1, 3, 3))), 0.0)


def test_a_constant_rate_on_an_arc_is_taken_out() -> None:
    errors, speed, seconds = OdometryErrors(rate=0.02, scale=0.01), 2.0, np.array((1.0,))

    def arc(rate: float, speed: float) -> np.ndarray:
        angle = rate * seconds[0]
        return np.array([(speed / rate * np.sin(angle), speed / rate * (1.0 - np.cos(angle)),
                          angle)])

    found = errors.motions(arc(0.1, speed), seconds)
    np.testing.assert_allclose(found, arc(0.12, 1.01 * speed), rtol=1e-3)
    np.testing.assert_allclose(errors.as_odometry_says(found, seconds), arc(0.1, speed))


def chain_graph(means: np.ndarray, informations: np.ndarray) -> IncrementalSmoother:
    smoother, n = IncrementalSmoother(), len(means)
    poses = [np.zeros(3)]
    for mean in means:
        poses.append(se2.compose(poses[-1], mean))
    ends = np.arange(n)
    smoother.update(GraphUpdate(
        hidden=np.array(poses), fix=(0,), factors=Factors(
            np.append(ends, 0), np.append(ends + 1, n), np.vstack((means, poses[n] + 0.1)),
            np.concatenate((informations, 10.0 * np.eye(3)[None])),
            [FactorKind.ODOMETRY] * n + [FactorKind.LOOP_CLOSURE])))
    return smoother


@given(st.integers(0, 1000), some_errors)
def test_a_graph_with_other_edges_is_the_one_made_with_them(
    seed: int, errors: OdometryErrors,
) -> None:
    means, noise, seconds = edges(seed)
    informations = np.linalg.inv(noise)
    smoother, n = chain_graph(means, informations), len(means)
    known = changed(means, informations, seconds, AS_CLAIMED, errors)
    new = chain_graph(*known)
    measured = Measured(np.arange(n), *known)
    before = smoother.graph.poses.copy()
    smoother.graph.begin()
    smoother.graph.apply(GraphUpdate(measure=[measured]))
    smoother.graph.rollback()
    np.testing.assert_array_equal(smoother.graph.factors.edges.mean[:n], means)
    np.testing.assert_array_equal(smoother.graph.poses, before)
    smoother.update(GraphUpdate(measure=[measured]))
    np.testing.assert_allclose(smoother.graph.factors.edges.mean[:n], known[0])
    np.testing.assert_allclose(smoother.graph.factors.edges.information,
                               new.graph.factors.edges.information, rtol=1e-12)
    closed = smoother.graph.factors.edges.mean[n]
    new.graph.apply(GraphUpdate(measure=[Measured(
        np.array((n,)), closed[None], smoother.graph.factors.edges.information[n:])]))
    for each in (smoother, new):
        for _ in range(30):
            each.update(GraphUpdate())
            each.refine()
    np.testing.assert_allclose(smoother.chi2(), new.chi2(), rtol=1e-5, atol=1e-6)
    for each in (smoother, new):
        nodes = each.graph.node_records
        assert np.all(np.isfinite(nodes['scale_t'] + nodes['scale_r']))


@given(st.integers(0, 1000), some_errors, some_errors)
def test_a_chain_follows_the_edges(
    seed: int, before: OdometryErrors, after: OdometryErrors,
) -> None:
    means, noise, seconds = edges(seed)
    stamps_ns = np.round(np.append(0.0, np.cumsum(seconds)) * SECOND).astype(np.int64)
    seconds = np.diff(stamps_ns) / SECOND
    chains = []
    for errors in (before, after):
        graph, ends = Graph(), np.arange(len(means))
        known = changed(means, np.linalg.inv(noise), seconds, AS_CLAIMED, errors)
        graph.apply(GraphUpdate(hidden=np.zeros((len(means) + 1, 3)), fix=(0,), factors=Factors(
            ends, ends + 1, *known, [FactorKind.ODOMETRY] * len(means))))
        chains.append(OdometryChain())
        chains[-1].extend(graph)
    chains[0].correct(before, after, stamps_ns, np.ones(len(means), dtype=bool))
    np.testing.assert_allclose(chains[0].poses, chains[1].poses, atol=1e-9)
    np.testing.assert_allclose(chains[0].sums, chains[1].sums, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(chains[0].travel(chains[0].nodes), chains[1].travel(
        chains[1].nodes), atol=1e-9)
