# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The simulated drive: its sensors err as promised, its bag says what the drive says."""

from pathlib import Path

import numpy as np
import pytest

from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.cli.simulate import simulate_drive, write_drive
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.offline.simulation.recording import Recording
from pose_graph_ros.offline.simulation.settings import Closures, FalseClosures, Fixes
from pose_graph_ros.offline.simulation.worlds import REFLECTED

OLD = Path(__file__).parents[1] / 'data' / 'drive_2.npz'
FIX_PERIOD_S, FIX_SIGMA = Fixes().period_s, Fixes().sigma
LOOP_SIGMAS = Closures().sigmas
FALSE_SINGLE, FALSE_GROUP, FALSE_MIN_DISTANCE = 4, 4, FalseClosures().min_distance
MULTIPATH_OFFSET = np.array(REFLECTED.step[:2])
MULTIPATH_S = REFLECTED.at_s, REFLECTED.at_s + REFLECTED.seconds


@pytest.fixture(scope='module')
def drive() -> Recording:
    return simulate_drive(seed=1)


def test_the_drive_is_the_one_of_the_first_version() -> None:
    # every 50th or 500th number of what the first version made, and all of its fixes and closures
    drive, old = simulate_drive(2, gyro=True, heading_drift=0.002), np.load(OLD)
    for name in ('fix_stamps_ns', 'loop_stamps_ns', 'fix_is_wrong', 'loop_is_false'):
        np.testing.assert_array_equal(getattr(drive, name), old[name])
    for name, path in (('odometry', drive.odometry), ('truth', drive.truth)):
        np.testing.assert_array_equal(path.stamps_ns[::50], old[f'{name}_stamps_ns'])
        np.testing.assert_allclose(path.poses[::50], old[name], rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(drive.rate_stamps_ns[::500], old['rate_stamps_ns'])
    np.testing.assert_allclose(drive.rates[::500], old['rates'], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(drive.fixes[:, :2], old['fixes'][:, :2], rtol=0.0, atol=1e-12)
    # heights may differ by the rounding of geocentric coordinates, as from one PROJ to another
    np.testing.assert_allclose(drive.fixes[:, 2], old['fixes'][:, 2], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(drive.loop_poses, old['loop_poses'], rtol=0.0, atol=1e-9)


def test_equal_seeds_give_equal_drives_and_others_do_not(drive) -> None:
    again, other = simulate_drive(seed=1), simulate_drive(seed=2)
    np.testing.assert_array_equal(again.odometry.poses, drive.odometry.poses)
    np.testing.assert_array_equal(again.fixes, drive.fixes)
    np.testing.assert_array_equal(again.loop_poses, drive.loop_poses)
    assert not np.array_equal(other.fixes[:10], drive.fixes[:10])


def test_the_car_moves_like_a_car(drive) -> None:
    steps = se2.between(drive.truth.poses[:-1], drive.truth.poses[1:])
    period = np.diff(drive.truth.stamps_ns) * 1e-9
    speed = steps[:, 0] / period
    yaw_rate = steps[:, 2] / period
    assert 1500.0 < np.sum(speed * period) < 2600.0
    assert -1e-3 < speed.min() < 1e-3
    assert speed.max() < 8.0
    assert np.abs(np.diff(speed) / period[1:]).max() < 3.0
    assert np.abs(steps[:, 1]).max() < 0.01  # it does not move sideways
    assert np.abs(yaw_rate * speed).max() < 3.0
    assert 0.02 < np.mean(speed < 0.01) < 0.3  # it stops at lights


def test_odometry_is_good_over_seconds_and_drifts_over_minutes(drive) -> None:
    stamps = drive.odometry.stamps_ns
    stamps = stamps[drive.truth.covers(stamps)]
    odometry, truth = drive.odometry.at(stamps), drive.truth.at(stamps)
    for seconds, least, most in ((1, 0.001, 0.1), (60, 2.0, 40.0)):
        k = seconds * 20
        error = se2.between(
            se2.between(truth[:-k], truth[k:]), se2.between(odometry[:-k], odometry[k:]))
        assert least < np.median(np.linalg.norm(error[:, :2], axis=1)) < most
    assert abs(se2.wrap(truth[0, 2] - odometry[0, 2] - 2.0)) < 0.05


def test_fixes_err_by_their_sigma_but_for_reflected_ones(drive) -> None:
    errors = []
    for seed in range(1, 6):
        other = simulate_drive(seed)
        inside = other.truth.covers(other.fix_stamps_ns) & ~other.fix_is_wrong
        positions = TangentPlane(*other.fixes[0].tolist()).to_map(*other.fixes.T)
        errors.append(positions[inside]
                       - other.truth.at(other.fix_stamps_ns[inside])[:, :2])
    rms = np.sqrt(np.mean(np.concatenate(errors) ** 2))
    assert rms == pytest.approx(FIX_SIGMA, rel=0.25)

    positions = TangentPlane(*drive.fixes[0].tolist()).to_map(*drive.fixes.T)
    wrong = drive.fix_is_wrong
    off = positions[wrong] - drive.truth.at(drive.fix_stamps_ns[wrong])[:, :2]
    assert len(off) == pytest.approx((MULTIPATH_S[1] - MULTIPATH_S[0]) / FIX_PERIOD_S, abs=1)
    assert np.all(np.hypot(*off.T) > 5.0 * FIX_SIGMA)
    assert np.all(np.hypot(*(off - MULTIPATH_OFFSET).T) < 10.0)    # to one side


def test_fixes_pause_once(drive) -> None:
    gaps = np.diff(drive.fix_stamps_ns) * 1e-9
    assert 68.0 < gaps.max() < 72.0
    assert np.sum(gaps > 1.0) == 1


def test_loop_closures_are_true_up_to_their_noise(drive) -> None:
    true = ~drive.loop_is_false
    old, new = drive.loop_stamps_ns[true].T
    assert np.sum(true) >= 24
    assert np.all(new - old >= 15e9)
    truth = se2.between(drive.truth.at(old), drive.truth.at(new))
    assert np.linalg.norm(truth[:, :2], axis=1).max() < 2.2
    error = se2.between(truth, drive.loop_poses[true])
    sigmas = np.array(LOOP_SIGMAS)
    assert np.std(error / sigmas) == pytest.approx(1.0, rel=0.25)

    gap = np.argmax(np.diff(drive.fix_stamps_ns))
    outage = drive.fix_stamps_ns[gap:gap + 2]
    assert np.sum((new > outage[0]) & (new < outage[1])) >= 4


def test_false_loop_closures_tie_places_that_are_far_apart(drive) -> None:
    ends = drive.loop_stamps_ns[drive.loop_is_false]
    assert len(ends) == FALSE_SINGLE + FALSE_GROUP
    assert np.all(np.diff(drive.loop_stamps_ns[:, 1]) >= 0)
    true = se2.between(drive.truth.at(ends[:, 0]), drive.truth.at(ends[:, 1]))
    measured = drive.loop_poses[drive.loop_is_false]
    assert np.all(np.hypot(*true[:, :2].T) > FALSE_MIN_DISTANCE)
    assert np.all(np.hypot(*measured[:, :2].T) < 5.0)
    # some of them agree: the car seems to drive along the same street again
    new = np.argsort(ends[:, 1])
    seconds = np.diff(ends[new], axis=0) * 1e-9
    assert np.sum(np.all((seconds > 0.0) & (seconds < 10.0), axis=1)) >= FALSE_GROUP - 1


def test_a_short_drive_needs_no_second_lap() -> None:
    short = simulate_drive(duration_s=20.0)
    assert short.loop_poses.shape == (0, 3)
    assert short.truth.stamps_ns[-1] - short.truth.stamps_ns[0] > 19e9


def test_the_bag_says_what_the_drive_says(tmp_path) -> None:
    drive = simulate_drive(duration_s=200.0)
    write_drive(drive, tmp_path / 'drive')
    seen: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
    with open_bag(tmp_path / 'drive') as bag:
        for record in bag.messages(bag.topics):
            message = record.decode()
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            assert stamp < record.recorded_ns < stamp + 10**9
            if record.topic == '/gps/fix':
                value = (message.latitude, message.longitude, message.altitude)
                assert message.status.status == 0
                assert message.position_covariance[0] == pytest.approx(FIX_SIGMA**2)
            else:
                pose = message.pose.pose
                theta = 2.0 * np.arctan2(pose.orientation.z, pose.orientation.w)
                value = (pose.position.x, pose.position.y, float(se2.wrap(theta)))
            seen.setdefault(record.topic, []).append((stamp, value))
            if record.topic == '/loop_closure':
                second, _, fraction = message.header.frame_id[1:].partition('.')
                assert message.header.frame_id.startswith('@')
                assert len(fraction) == 9
                assert int(second + fraction) in drive.loop_stamps_ns[:, 0]

    for topic, stamps, values in (
        ('/odom', drive.odometry.stamps_ns, drive.odometry.poses),
        ('/ground_truth', drive.truth.stamps_ns, drive.truth.poses),
        ('/gps/fix', drive.fix_stamps_ns, drive.fixes),
        ('/loop_closure', drive.loop_stamps_ns[:, 1], drive.loop_poses),
    ):
        np.testing.assert_array_equal([stamp for stamp, _ in seen[topic]], stamps)
        np.testing.assert_allclose([value for _, value in seen[topic]], values, atol=1e-12)
