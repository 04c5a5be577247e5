# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Sensors of a simulation: statistics over long runs, and independence of each other."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.offline.simulation import sensors
from pose_graph_ros.offline.simulation.recording import course, record, Recording
from pose_graph_ros.offline.simulation.settings import (
    ClaimedSigma,
    ClockOffset,
    CLOSURES,
    Closures,
    Delay,
    Duplicates,
    FalseClosures,
    FIXES,
    Fixes,
    GlobalPoses,
    GYRO,
    Gyro,
    Jump,
    OdometryErrors,
    Outage,
    POSES,
    Setup,
    START_NS,
    Wheels,
)
from pose_graph_ros.offline.simulation.worlds import PERIOD_S, WORLDS

FIELDS = {
    'odometry': lambda drive: (drive.odometry.stamps_ns, drive.odometry.poses),
    'truth': lambda drive: (drive.truth.stamps_ns,),
    'fixes': lambda drive: drive.measured[FIXES],
    'poses': lambda drive: (drive.measured[POSES].stamps_ns,),
    'closures': lambda drive: drive.measured[CLOSURES],
    'gyro': lambda drive: drive.measured[GYRO],
}
ALL = Setup(gyro=Gyro(), fixes=Fixes(), poses=GlobalPoses(),
            closures=Closures(spacing=5.0, radius=1.5, min_distance=20.0, first_s=3.0,
                              false=FalseClosures(share=0.2, min_distance=5.0, spacing=1.0)))
CHANGES: dict[str, Callable[[Setup], Setup]] = {
    'odometry': lambda s: replace(s, wheels=replace(s.wheels, errors=OdometryErrors.MODEL)),
    'gyro': lambda s: replace(s, gyro=None),
    'fixes': lambda s: replace(s, fixes=Fixes(period_s=0.2, white=2.0)),
    'poses': lambda s: replace(s, poses=None),
    'closures': lambda s: replace(s, closures=replace(s.closures, rate=0.5)),
}


def drives(world: str, seed: int = 1, seconds: float = 200.0) -> Callable[..., Recording]:
    """Return what records with all sensors, after a change of them."""
    return lambda change=lambda s: s: record(course(
        WORLDS[world], seed, seconds, lambda usual: change(replace(ALL, wheels=usual.wheels))))


@pytest.mark.parametrize('world', WORLDS)
def test_a_sensor_changes_no_other(world: str) -> None:
    simulate = drives(world)
    usual = simulate()
    for changed, change in CHANGES.items():
        other = simulate(change)
        for name, values in FIELDS.items():
            same = all(np.array_equal(a, b) for a, b in zip(
                values(usual), values(other), strict=True))
            assert same == (name != changed), (changed, name)


@pytest.mark.parametrize('world', WORLDS)
def test_disturbances_change_only_what_they_name(world: str) -> None:
    simulate = drives(world)
    usual = simulate()
    other = simulate(lambda s: replace(
        s, outages=(Outage('/gps/fix', 50.0, 90.0),), jumps=(
            Jump('/gps/fix', 100.0, (5.0, 6.0, 0.0), 20.0),), delays=(Delay('/odom', 1.0, 0.5),),
        duplicates=(Duplicates('/loop_closure', 0.5),), offsets=(ClockOffset('/imu/data', 0.1),),
        claims=(ClaimedSigma('/gps/fix', 0.3),)))
    for name in ('odometry', 'truth', 'poses', 'closures'):
        for a, b in zip(FIELDS[name](usual), FIELDS[name](other), strict=True):
            np.testing.assert_array_equal(a, b)
    before, after = (each.measured[GYRO] for each in (usual, other))
    np.testing.assert_array_equal(before.stamps_ns + 100_000_000, after.stamps_ns)
    np.testing.assert_array_equal(before.values, after.values)
    before, after = (each.measured[FIXES] for each in (usual, other))
    time = (before.stamps_ns - START_NS) * 1e-9
    kept = (time < 50.0) | (time >= 90.0)
    np.testing.assert_array_equal(before.stamps_ns[kept], after.stamps_ns)
    moved = (time >= 100.0) & (time < 120.0)
    np.testing.assert_array_equal(after.wrong >= 0, moved[kept])
    np.testing.assert_array_equal(before.values[kept & ~moved], after.values[after.wrong == -1])
    assert other.silenced == (int(np.sum(~kept)),)


def straight(seconds: float) -> Trajectory:
    """Return a motion eastwards at 1 m/s."""
    time = np.arange(0.0, seconds, PERIOD_S)
    poses = np.column_stack((time, np.zeros((len(time), 2))))
    return Trajectory(np.round(time * 1e9).astype(np.int64), poses)


def test_fixes_have_the_white_and_the_correlated_errors_that_were_asked_for() -> None:
    truth = straight(20_000.0)
    settings = Fixes(period_s=1.0, white=0.5, correlated=1.5, correlation_s=20.0)
    stamps, positions = sensors.positions(np.random.default_rng(3), truth, settings)
    errors = positions - truth.at(stamps)[:, :2]
    # autocovariance of a first-order Gauss-Markov process with white noise on it
    lags = np.arange(60)
    found = np.array([np.mean(errors[:len(errors) - lag] * errors[lag:]) for lag in lags])
    expected = 1.5**2 * np.exp(-lags / 20.0) + 0.5**2 * (lags == 0)
    # 1000 correlation times, twice; the error of a variance is about sqrt(2 / 1000)
    assert np.max(np.abs(found - expected)) < 0.12 * 1.5**2
    white = found[0] - np.exp(np.polyfit(lags[1:15], np.log(found[1:15]), 1)[1])
    assert white == pytest.approx(0.25, abs=0.05)
    assert np.std(errors) == pytest.approx(settings.sigmas[0], rel=0.06)
    assert np.corrcoef(errors.T)[0, 1] == pytest.approx(0.0, abs=0.12)


def test_the_gyroscope_has_white_noise_and_a_bias_that_walks() -> None:
    gyro = Gyro(sigma=1e-3, bias=0.02, bias_walk=1e-3)
    n, runs = 20_000, 100
    heading = np.linspace(0.0, 5.0, n)
    rate = 5.0 / ((n - 1) * PERIOD_S)
    errors = np.array([sensors.yaw_rates(np.random.default_rng(k), heading, gyro) - rate
                       for k in range(runs)])
    white = np.diff(errors[0]) / np.sqrt(2.0)
    assert np.std(white) * np.sqrt(PERIOD_S) == pytest.approx(gyro.sigma, rel=0.05)
    begin, end = np.mean(errors[:, :500], axis=1), np.mean(errors[:, -500:], axis=1)
    assert np.std(begin) == pytest.approx(gyro.bias, rel=0.25)
    assert np.std(end - begin) == pytest.approx(
        gyro.bias_walk * np.sqrt((n - 500) * PERIOD_S), rel=0.25)


def test_odometry_by_the_model_has_the_noise_that_the_node_assumes() -> None:
    time = np.arange(0.0, 60.0, PERIOD_S)
    heading = 0.5 * np.sin(0.2 * time)
    poses = np.column_stack((
        np.cumsum(np.cos(heading)) * PERIOD_S, np.cumsum(np.sin(heading)) * PERIOD_S, heading))
    truth = Trajectory(np.round(time * 1e9).astype(np.int64), poses)
    wheels = Wheels(errors=OdometryErrors.MODEL)
    ends, variance = [], np.sum(sensors.model_variances(
        se2.between(poses[:-1], poses[1:])), axis=0)
    for seed in range(200):
        path = sensors.odometry(np.random.default_rng(seed), truth, wheels)
        ends.append(path.poses[-1, 2] - heading[np.searchsorted(
            truth.stamps_ns, path.stamps_ns[-1])])
    assert np.std(ends) == pytest.approx(np.sqrt(variance[2]), rel=0.15)


def test_without_fixes_the_map_begins_where_odometry_does() -> None:
    for world in ('hall', 'grid', 'drive'):
        drive = record(course(WORLDS[world], 2, 30.0, lambda s: replace(
            s, fixes=None, jumps=(), outages=())))
        np.testing.assert_allclose(drive.truth.poses[0], drive.odometry.poses[0], atol=1e-9)
        if world != 'drive':
            np.testing.assert_allclose(drive.odometry.poses[0], 0.0, atol=1e-9)
