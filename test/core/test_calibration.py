# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives with wheels of the wrong size and a bias of the yaw rate, which the graph estimates."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    MeasurementSource,
    OdometrySource,
    ThinningConfig,
    WindowConfig,
    WindowPrior,
)
from pose_graph_ros.core.estimate import predict
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.io.graph_files import read_graph, write_graph
from pose_graph_ros.core.measurements import OdometrySample, Position

SECOND = 1_000_000_000
STEP, SIGMA_FIX = 0.2, 0.5
"""Time between samples [s], and sigma of a coordinate of the fixes [m], of which one a second."""
RATE, SCALE = 0.002, 0.02
"""What odometry does not say of its yaw rate [rad/s], and of its way."""
CALIBRATED = BackendConfig(
    odometry={'odom': OdometrySource(calibrate=True)}, measurements={'fix': MeasurementSource()})
UNCALIBRATED = replace(CALIBRATED, odometry={})


class Drive:
    """A drive that is simulated, and fed into engines."""

    def __init__(self, seed: int, turns: FloatArray, blackout: tuple[float, float]) -> None:
        rng, n = np.random.default_rng(seed), len(turns) + 1
        self.truth, self.odometry = np.zeros((n, 3)), np.zeros((n, 3))
        self.truth[0] = 40.0, -30.0, 0.7
        noise = rng.normal(size=(n, 3)) * np.sqrt(2.0 * STEP) * (0.01, 0.005, 0.001)
        for k, turn in enumerate(turns.tolist()):
            moved = np.array((2.0 * STEP, 0.0, turn * STEP))
            self.truth[k + 1] = se2.compose(self.truth[k], moved)
            moved = moved / (1.0 + SCALE, 1.0, 1.0) - (0.0, 0.0, RATE * STEP) + noise[k]
            self.odometry[k + 1] = se2.compose(self.odometry[k], moved)
        self.fixes = self.truth[:, :2] + rng.normal(0.0, SIGMA_FIX, (n, 2))
        self.blackout = blackout

    def sample(self, k: int) -> OdometrySample:
        return OdometrySample(SECOND + round(k * STEP * 1e9), self.odometry[k])

    def fed(self, backend: PoseGraphBackend, begin: float, end: float) -> PoseGraphBackend:
        """Return an engine after some time of the drive [s]."""
        for k in range(round(begin / STEP), round(end / STEP)):
            backend.add_odometry(self.sample(k))
            if k % 5 == 0 and not self.blackout[0] <= k * STEP < self.blackout[1]:
                backend.add_measurement(Position(
                    self.sample(k).stamp_ns, self.fixes[k], SIGMA_FIX**2 * np.eye(2),
                    np.zeros(2)), 'fix')
            if k % 10 == 9:
                backend.update()
        return backend

    def error(self, backend: PoseGraphBackend, time: float) -> FloatArray:
        return se2.wrapped(backend.estimate().T_map_base - self.truth[round(time / STEP) - 1])


def winding(seed: int) -> Drive:
    """Return ten minutes with fixes and 400 s without, of bends to both sides."""
    times = np.arange(0.0, 1000.0, STEP)
    return Drive(seed, 0.12 * np.sin(0.07 * times + 1.0) + 0.08 * np.sin(0.021 * times),
                 (600.0, np.inf))


@pytest.mark.parametrize('seed', [0, 1])
def test_a_calibrated_odometry_bridges_a_blackout(seed: int) -> None:
    drive = winding(seed)
    without = drive.error(drive.fed(PoseGraphBackend(UNCALIBRATED), 0.0, 1000.0), 1000.0)
    assert np.hypot(*without[:2]) > 25.0
    assert abs(without[2]) > 0.6
    backend = drive.fed(PoseGraphBackend(CALIBRATED), 0.0, 1000.0)
    error, found = drive.error(backend, 1000.0), backend.calibrations()['odom']
    assert np.hypot(*error[:2]) < 8.0
    assert abs(error[2]) < 0.1
    covariance = backend.estimate().covariance
    assert error @ np.linalg.solve(covariance, error) < 16.3
    assert abs(found.rate - RATE) < 3.0 * found.rate_sigma < 0.004
    assert abs(found.scale - SCALE) < 3.0 * found.scale_sigma < 0.02
    assert backend.calibrations().keys() == {'odom'}
    assert backend.gyro_biases(backend.graph) == {}
    # between updates as well, and from one of them to the next sample
    predicted = predict(backend.estimate(), drive.sample(5000))
    np.testing.assert_allclose(predicted.T_map_base - drive.truth[5000], error, atol=0.03)
    # states are its own: what the whole graph is optimised to is near, for its covariance
    backend.optimize()
    moved = drive.error(backend, 1000.0) - error
    assert moved @ np.linalg.solve(covariance, moved) < 1e-4


def test_a_calibrated_graph_is_saved_and_goes_on(tmp_path: Path) -> None:
    drive = winding(0)
    drive.blackout = 100.0, np.inf
    backend = drive.fed(PoseGraphBackend(CALIBRATED), 0.0, 150.0)
    write_graph(backend.saved(), tmp_path / 'graph')
    loaded = PoseGraphBackend.restored(CALIBRATED, read_graph(tmp_path / 'graph'))
    assert loaded.graph.dimension.tolist() == backend.graph.dimension.tolist()
    assert np.count_nonzero(loaded.graph.factors.k >= 0) > 100
    same = PoseGraphBackend.restored(CALIBRATED, backend.saved())
    for each in (loaded, same):
        drive.fed(each, 150.0, 200.0)
    np.testing.assert_array_equal(loaded.graph.poses, same.graph.poses)
    drive.fed(backend, 150.0, 200.0)
    for each in (same, backend):
        each.optimize()
    np.testing.assert_allclose(
        same.estimate().T_map_base, backend.estimate().T_map_base, atol=1e-3)
    # without it, states and edges stay, and new nodes have plain ones
    plain = PoseGraphBackend.restored(UNCALIBRATED, read_graph(tmp_path / 'graph'))
    drive.fed(plain, 150.0, 200.0)
    assert np.count_nonzero(plain.graph.factors.k >= 0) == np.count_nonzero(
        read_graph(tmp_path / 'graph').rows.factors.k >= 0)


@pytest.mark.parametrize('prior', WindowPrior)
def test_states_leave_by_the_window(prior: WindowPrior) -> None:
    drive = winding(0)
    drive.blackout = 200.0, np.inf
    whole = drive.fed(PoseGraphBackend(CALIBRATED), 0.0, 300.0)
    backend = drive.fed(PoseGraphBackend(replace(
        CALIBRATED, window=WindowConfig(nodes=100, prior=prior))), 0.0, 300.0)
    estimate = backend.estimate()
    assert estimate.n_frozen > 200
    assert estimate.n_biases < 12
    np.testing.assert_allclose(
        estimate.T_map_base, whole.estimate().T_map_base, atol=0.5)
    np.testing.assert_allclose(
        backend.calibrations()['odom'], whole.calibrations()['odom'], rtol=0.3)


def test_states_leave_where_a_place_is_driven_often() -> None:
    drive = Drive(0, np.full(round(600.0 / STEP), 0.1), (500.0, np.inf))
    backend = drive.fed(PoseGraphBackend(replace(
        CALIBRATED, thinning=ThinningConfig(cell=2.0))), 0.0, 600.0)
    estimate, found = backend.estimate(), backend.calibrations()['odom']
    assert estimate.n_thinned > 500
    assert estimate.n_biases < 30
    assert np.hypot(*drive.error(backend, 600.0)[:2]) < 3.0
    assert abs(found.rate - RATE) < 3.0 * found.rate_sigma


def test_a_robot_that_stands_does_not_turn() -> None:
    drive = winding(0)
    drive.odometry[1000:] = drive.odometry[1000]
    backend = drive.fed(PoseGraphBackend(CALIBRATED), 0.0, 195.0)
    drive.blackout = 0.0, np.inf
    heading = drive.fed(backend, 195.0, 205.0).estimate().T_map_base[2]
    n_biases = backend.estimate().n_biases
    drive.fed(backend, 205.0, 400.0)
    backend.update()
    assert backend.estimate().T_map_base[2] == pytest.approx(heading, abs=1e-4)
    assert backend.estimate().n_biases == n_biases
    assert predict(backend.estimate(), drive.sample(2000)).T_map_base[2] == pytest.approx(
        heading, abs=1e-4)


def test_settings_of_states_in_the_graph_do_not_change() -> None:
    backend = PoseGraphBackend(CALIBRATED)
    with pytest.raises(ConfigError, match=r'calibrate.*expected True, got False'):
        backend.configure(UNCALIBRATED)
    with pytest.raises(ConfigError, match='calibration_walk: expected positive ones'):
        OdometrySource(calibration_walk=(0.0, 1.0))
