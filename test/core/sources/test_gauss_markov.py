# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Correlated errors: the estimate is that of the full covariance, in any order of arrival."""


from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import (
    BackendConfig,
    Loss,
    MeasurementSource,
    NodePolicy,
    OdometryNoise,
    OdometrySource,
)
from pose_graph_ros.core.graph.constraints import ObservedNodes
from pose_graph_ros.core.graph.graph import NextIds
from pose_graph_ros.core.measurements import (
    GlobalPose,
    HeadingOnly,
    Measurement,
    OdometrySample,
    Position,
)
from pose_graph_ros.core.odometry.motion import Attachment
from pose_graph_ros.core.sources.gauss_markov import Additions, CorrelatedErrors, GaussMarkovBias
from pose_graph_ros.core.sources.measurement_constraints import absolute_constraint
from pose_graph_ros.core.sources.settings import SOURCES

SECOND = 1_000_000_000
TAU = float(SOURCES.bins)
"""Time constant for which a bin is one second [s]."""
NOWHERE = Attachment(0, np.zeros(3), np.zeros((3, 3)))
NO_NOISE = np.zeros(2)
ERRORS = CorrelatedErrors(TAU, 1.0, 0.05)


def observed(seconds: float) -> ObservedNodes:
    return absolute_constraint(position(seconds), NOWHERE)


def position(seconds: float, x: float = 0.0, y: float = 0.0, sigma: float = 1.0) -> Position:
    return Position(round(seconds * SECOND), np.array((x, y)), sigma**2 * np.eye(2), np.zeros(2))


def transitions(stamps: list[float]) -> set[tuple[object, ...]]:
    """Return the edges, transitions and priors of states for fixes that arrive one by one."""
    chain = GaussMarkovBias(ERRORS)
    rows: dict[int, int] = {}
    edges: dict[int, tuple[object, ...]] = {}
    priors: dict[int, int] = {}
    sizes = NextIds(1, 0, 0)
    for stamp in stamps:
        additions = Additions(sizes)
        chain.begin()
        edge = chain.add(round(stamp * SECOND), observed(stamp), NO_NOISE, additions)
        for number, table in enumerate(additions.edges, sizes.edge):
            edges[number] = (int(table.i[0]), int(table.j[0]), table.information.tobytes(),
                             table.bias.tobytes())
        rows[edges[edge][1]] = round(stamp)
        for number, table in enumerate(additions.observed, sizes.observed):
            priors[number] = int(table.node[0])
        for number in additions.remove_edges:
            del edges[number]
        for number in additions.remove_observed:
            del priors[number]
        sizes = NextIds(sizes.node + len(additions.biases),
                          sizes.edge + len(additions.edges),
                          sizes.observed + len(additions.observed))
    return ({(rows.get(i, 'pose'), rows[j], *rest) for i, j, *rest in edges.values()}
            | {('prior', rows[node]) for node in priors.values()})


STIFF = OdometrySource(
    noise=OdometryNoise(sigma_distance=0.05, sigma_lateral=0.05, sigma_heading_distance=1e-4,
                        sigma_heading_turn=1e-4, sigma_floor_position=1e-3,
                        sigma_floor_heading=1e-5), reorder_window=0.0)
"""With a known heading a straight drive is linear, and the expected estimate has a closed form."""


def run(measurements: list[Measurement], source: MeasurementSource, seconds: int = 40,
        **settings: object) -> PoseGraphBackend:
    backend = PoseGraphBackend(BackendConfig(
        nodes=NodePolicy(minimum_travel_distance=0.9), odometry={'odom': STIFF},
        measurements={'fix': source}, **settings))
    for second in range(1, seconds + 1):
        backend.add_odometry(OdometrySample(second * SECOND, np.array((second - 1.0, 0.0, 0.0))))
    # the map frame is the odometry frame, whose heading is known
    backend.add_measurement(GlobalPose(
        SECOND, np.zeros(3), np.diag((100.0**2, 100.0**2, 1e-8))), 'start')
    for measurement in measurements:
        backend.add_measurement(measurement, 'fix')
    return backend


def generalised_least_squares(
    fixes: list[Position], n: int, correlation: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return estimate and deviation of the x of each node from the full covariance."""
    noise, which = STIFF.noise, [round(fix.stamp_ns / SECOND) - 1 for fix in fixes]
    step = noise.sigma_distance**2 + noise.sigma_floor_position**2
    prior = 100.0**2 + step * np.minimum.outer(np.arange(n), np.arange(n))
    design = np.zeros((len(fixes), n))
    design[np.arange(len(fixes)), which] = 1.0
    seen = np.array([fix.position[0] for fix in fixes])
    expected = np.arange(n, dtype=float)
    gain = prior @ design.T @ np.linalg.inv(design @ prior @ design.T + correlation)
    return (expected + gain @ (seen - design @ expected),
            np.sqrt(np.diagonal(prior - gain @ design @ prior)))


def test_poses_and_sigma_are_those_of_the_full_covariance() -> None:
    rng = np.random.default_rng(2)
    sigma, share = 2.0, SOURCES.white_share
    fixes = [position(second, second - 1.0 + rng.normal(0.0, sigma), 0.0, sigma)
             for second in range(1, 41)]
    source = MeasurementSource(correlation_time=TAU)
    backend = run(fixes, source)
    backend.optimize()
    estimate = backend.estimate()
    assert estimate is not None
    gap = np.abs(np.subtract.outer(np.arange(40), np.arange(40)))
    # the fixes lie at the ends of bins, where the states of bins are least accurate
    correlation = sigma**2 * (np.exp(-gap / TAU) + share * np.eye(40))
    expected, deviation = generalised_least_squares(fixes, 40, correlation)
    np.testing.assert_allclose(estimate.path.poses[:, 0], expected, atol=0.02 * sigma)
    assert np.sqrt(estimate.covariance[0, 0]) == pytest.approx(deviation[-1], rel=0.02)
    alone = run(fixes, MeasurementSource())
    alone.optimize()
    white = alone.estimate()
    assert white is not None
    assert np.sqrt(white.covariance[0, 0]) < 0.4 * deviation[-1]


def drive(seed: int) -> list[Measurement]:
    rng = np.random.default_rng(seed)
    return [
        *(position(2.03 + 0.7 * k, 1.03 + 0.7 * k + rng.normal(), rng.normal())
          for k in range(50)),
        *(GlobalPose(round((3.1 + 3 * k) * SECOND),
                     np.array((2.1 + 3 * k, 0.0, 0.0)) + rng.normal(0.0, (1.0, 1.0, 0.05)),
                     np.diag((1.0, 2.0, 0.0025))) for k in range(10)),
        *(HeadingOnly(round((4.3 + 3 * k) * SECOND), float(rng.normal(0.0, 0.1)), 0.01)
          for k in range(10))]


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10), data=st.data(),
       loss=st.sampled_from((Loss.NONE, Loss.HUBER, Loss.CAUCHY)))
def test_shuffled_measurements_give_the_same_path(
    seed: int, data: st.DataObject, loss: Loss,
) -> None:
    # with a threshold below 1 the loss acts on most of them
    source = MeasurementSource(correlation_time=5.0, loss=loss, rejection_threshold=0.7)
    measurements = drive(seed)
    paths = []
    for order in (measurements, data.draw(st.permutations(measurements))):
        backend = run([], source)
        for k, measurement in enumerate(order):
            backend.add_measurement(measurement, 'fix')
            if k % 7 == 3:
                assert backend.update().status is not Status.FAILED
        # for a loss that is not convex, 200 reweightings need not be enough
        assert backend.optimize().status in (Status.CONVERGED, *(
            [Status.MAX_ITERATIONS] if loss is Loss.CAUCHY else []))
        estimate = backend.estimate()
        assert estimate is not None
        paths.append(estimate.path.poses)
    np.testing.assert_allclose(*paths, atol=1e-9)
