# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The compiled steps of a track are those of an extended Kalman filter, written with NumPy."""

from hypothesis import given, settings, strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.tracks import (
    LEAST_SIGMA,
    Observation,
    observations,
    Track,
)
from pose_graph_ros.core.sources.bias import STRETCH

seeds = st.integers(0, 2**32 - 1)


def random_covariance(rng: np.random.Generator, size: int, scale: float = 1.0) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return scale * (root @ root.T + 0.1 * np.eye(size))


def random_track(rng: np.random.Generator, node: int = 0) -> Track:
    pose = np.append(rng.normal(size=2) * 50.0, rng.uniform(-np.pi, np.pi))
    return Track(node, pose, random_covariance(rng, 3))


def random_chain(rng: np.random.Generator, n: int) -> OdometryChain:
    graph = Graph()
    means = rng.normal((1.0, 0.0, 0.0), (0.3, 0.2, 0.8), (n - 1, 3))
    information = np.array([np.linalg.inv(random_covariance(rng, 3, 0.01)) for _ in means])
    graph.apply(GraphUpdate(hidden=np.zeros((n, 3)), fix=[0], factors=Factors(
        np.arange(n - 1), np.arange(1, n), means, information,
        [FactorKind.ODOMETRY] * (n - 1))))
    chain = OdometryChain()
    chain.extend(graph)
    chain.noise_factor = rng.uniform(1.0, 9.0)
    return chain


@settings(deadline=None, max_examples=50)
@given(seed=seeds, begin=st.integers(0, 9), end=st.integers(0, 9))
def test_a_track_moves_along_odometry(seed: int, begin: int, end: int) -> None:
    rng = np.random.default_rng(seed)
    chain, track = random_chain(rng, 10), random_track(rng, begin)
    moved = track.moved(chain, end)
    motion, noise = (each[0] for each in chain.between(np.array((begin,)), np.array((end,))))
    assert moved.node == end
    pose = se2.compose(track.pose, motion)
    assert_allclose(moved.pose[:2], pose[:2], atol=1e-9)
    assert_allclose(se2.wrap(moved.pose[2] - pose[2]), 0.0, atol=1e-12)
    if begin <= end:
        assert_allclose(moved.cov, covariance.propagated(track.pose, track.cov, motion, noise),
                        rtol=1e-9, atol=1e-9)
    assert_allclose(moved.cov, moved.cov.T, atol=0.0)


@settings(deadline=None, max_examples=100)
@given(seed=seeds, size=st.sampled_from((2, 3)))
def test_an_observation_is_taken_in(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    track = random_track(rng)
    seen = Observation(0, rng.normal(size=3), random_track(rng).pose,
                       random_covariance(rng, size))
    expected = se2.compose(track.pose, seen.offset)
    error = (seen.mean - expected)[:size]
    error[2:] = se2.wrap(error[2:])
    jacobian = np.eye(size, 3)
    jacobian[:2, 2] = -(expected - track.pose)[1], (expected - track.pose)[0]
    cov = jacobian @ track.cov @ jacobian.T + seen.noise
    innovation = track.innovation(seen)
    assert_allclose(innovation.error, error, rtol=1e-9, atol=1e-9)
    assert_allclose(innovation.jacobian, jacobian, atol=1e-12)
    assert_allclose(innovation.cov, cov, rtol=1e-9, atol=1e-12)
    assert innovation.d2 == pytest.approx(float(error @ np.linalg.solve(cov, error)), rel=1e-7)
    assert innovation.spread == pytest.approx(float(np.linalg.slogdet(cov)[1]), rel=1e-7)
    updated = track.updated(innovation)
    gain = track.cov @ jacobian.T @ np.linalg.inv(cov)
    pose = track.pose + gain @ error
    assert_allclose(updated.pose[:2], pose[:2], rtol=1e-7, atol=1e-7)
    assert_allclose(se2.wrap(updated.pose[2] - pose[2]), 0.0, atol=1e-7)
    assert_allclose(updated.cov, track.cov - gain @ cov @ gain.T, rtol=1e-6, atol=1e-7)


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_observations_have_their_covariances_in_map_axes_with_floors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    kinds = rng.choice([FactorKind.POSITION, FactorKind.GLOBAL_POSE], 6)
    covs = np.array([random_covariance(rng, 3, rng.choice((1e-6, 1.0))) for _ in kinds])
    covs[kinds == FactorKind.POSITION, 2, :2] = covs[kinds == FactorKind.POSITION, :2, 2] = 0.0
    means = np.array([random_track(rng).pose for _ in kinds])
    table = Factors.on(np.arange(6), np.zeros((6, 3)), means, np.linalg.inv(covs), kinds)
    least = np.square((LEAST_SIGMA[0], LEAST_SIGMA[0], LEAST_SIGMA[1]))
    for k, seen in enumerate(observations(table)):
        size = 2 if kinds[k] == FactorKind.POSITION else 3
        expected = BELIEF.stated * covariance.turned(covs[k, :size, :size], -means[k, 2])
        expected = covariance.floored(expected, least[:size])
        assert (seen.node, seen.size) == (k, size)
        assert_allclose(seen.noise, expected, rtol=1e-7, atol=1e-9)


def test_an_observation_of_a_biased_edge_has_the_variance_of_the_bias_as_well() -> None:
    information = np.array((np.eye(3), np.diag((4.0, 4.0, 0.0)), np.diag((0.0, 0.0, 1.0))))
    edges = Factors([1, 2, 3], [4, 4, 4], np.zeros((3, 3)), information, [FactorKind.BIAS] * 3,
                  constants=np.tile((0.1, 0.2, 2.0, 0.5 * STRETCH), (3, 1)))
    pose, position, heading = observations(edges)
    assert heading is None
    assert pose is not None
    assert position is not None
    assert_allclose(pose.noise, np.diag((5.0, 5.0, 1.25)))
    assert_allclose(position.noise, np.diag((4.25, 4.25)))
    assert (pose.node, position.node) == (1, 2)
    assert_allclose(pose.offset, (0.1, 0.2, 0.0))
