# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Errors of hand-made drives are the ones that can be told by hand; the picture is a picture."""

from dataclasses import replace

from matplotlib.image import imread
import numpy as np
import pytest
from scipy.stats import chi2

from pose_graph_ros.cli.drive import (
    BELIEVED,
    consistency,
    distances,
    DOUBTED,
    Drive,
    HELD_OUT,
    place_truth,
    summary,
)
from pose_graph_ros.cli.picture import BLUE, draw_drive, GREEN, VERMILION
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import Trajectory

NOTHING = Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
SECOND = 10**9


def straight(offset: float = 0.0) -> Trajectory:
    """Drive 10 m east in 10 s, some metres to the left."""
    poses = np.column_stack((np.arange(11.0), np.full(11, offset), np.zeros(11)))
    return Trajectory(np.arange(11) * SECOND, poses)


def hand_made_drive() -> Drive:
    """Truth on the x axis, the result 0.5 m to its left, fixes 1 m (used) and 2 m (held out)."""
    odometry = straight()
    start = np.array([5.0, -3.0, 2.0])
    return Drive(
        odometry=Trajectory(odometry.stamps_ns, se2.compose(start, odometry.poses)),
        fix_stamps_ns=np.array([0, 15, 30, 90, 200]) * SECOND // 10,
        fix_positions=np.array([[0.0, 1.0], [1.5, 1.0], [3.0, -2.0], [9.0, 2.0], [20.0, 0.0]]),
        fix_states=np.array([BELIEVED, BELIEVED, HELD_OUT, HELD_OUT, BELIEVED]),
        fix_sources=['fix'] * 5, corrected=straight(0.5), truth=straight(),
        loop_stamps_ns=np.array([[1, 8]]) * SECOND, loop_states=np.array([BELIEVED]),
        loop_sources=['loop_closure'])


def without_truth(drive: Drive) -> Drive:
    return replace(drive, truth=None)


def without_fixes(drive: Drive) -> Drive:
    return replace(
        drive, fix_stamps_ns=np.zeros(0, dtype=np.int64), fix_positions=np.zeros((0, 2)),
        fix_states=np.zeros(0, dtype=np.int64), fix_sources=[])


def test_distances_interpolate_inside_the_time_of_the_path_only() -> None:
    stamps = np.array([-SECOND, 2 * SECOND, 2 * SECOND + SECOND // 4, 11 * SECOND])
    positions = np.array([[0.0, 0.0], [2.0, 3.0], [2.25, 4.0], [0.0, 0.0]])
    covered, errors = distances(straight(), stamps, positions)
    np.testing.assert_array_equal(covered, stamps[1:3])
    np.testing.assert_allclose(errors, [3.0, 4.0])


def test_the_nees_is_that_of_a_loop_over_the_poses() -> None:
    rng = np.random.default_rng(1)
    truth = Trajectory(np.arange(60) * SECOND, rng.normal(size=(60, 3)) + 3.0 * np.eye(3)[2])
    stamps = np.arange(-5, 50) * SECOND + SECOND // 2
    inside = truth.covers(stamps)
    poses = rng.normal(size=(55, 3))
    poses[inside] = truth.at(stamps[inside]) + 0.3 * rng.normal(size=(50, 3))
    roots = 0.2 * rng.normal(size=(55, 3, 3)) + 0.3 * np.eye(3)
    covariances = roots @ roots.transpose(0, 2, 1)
    covariances[7] = np.nan     # has left the graph
    drive = replace(without_fixes(hand_made_drive()), corrected=Trajectory(stamps, poses),
                    truth=truth)
    found = consistency(drive, covariances)
    for name, size in (('position', 2), ('pose', 3)):
        values = []
        for k in np.flatnonzero(inside & (np.arange(55) != 7)):
            error = poses[k] - truth.at(stamps[k:k + 1])[0]
            error[2] = np.arctan2(np.sin(error[2]), np.cos(error[2]))
            error, block = error[:size], covariances[k, :size, :size]
            values.append(error @ np.linalg.inv(block) @ error)
        each = found[name]
        assert each is not None
        assert (each['count'], each['expected']) == (len(values), size) == (49, size)
        assert each['mean'] == pytest.approx(np.mean(values))
        assert each['within'] == np.mean(np.array(values) < chi2.ppf(0.95, size))
        assert each['interval'] == pytest.approx(chi2.ppf((0.025, 0.975), 49 * size) / 49)
    assert consistency(drive, np.full((55, 3, 3), np.nan)) == {'position': None, 'pose': None}


def test_the_nees_of_a_path_from_a_fixed_node_does_not_depend_on_where_the_truth_is() -> None:
    rng = np.random.default_rng(2)
    path = Trajectory(np.arange(50) * SECOND, np.cumsum(rng.normal(size=(50, 3)), axis=0))
    covariances = 0.01 * np.arange(50)[:, None, None] * np.eye(3)
    errors = np.sqrt(0.01 * np.arange(50))[:, None] * rng.normal(size=(50, 3))
    drive = replace(without_fixes(hand_made_drive()), corrected=path)
    there, moved = (consistency(replace(drive, truth=Trajectory(
        path.stamps_ns[first:], se2.compose(pose, path.poses - errors)[first:])),
        covariances)['position']
        for first, pose in ((0, np.zeros(3)), (1, np.array((3.0, -2.0, 0.7)))))
    assert there is not None
    assert moved is not None
    assert there['count'] == moved['count'] == 49
    assert there['mean'] == pytest.approx(moved['mean'], rel=0.3)
    assert 1.0 < there['mean'] < 3.0


def test_odometry_is_laid_over_the_truth_or_else_the_fixes_or_else_the_result() -> None:
    drive = hand_made_drive()
    np.testing.assert_allclose(drive.placed_odometry.poses, straight().poses, atol=1e-9)
    fixes = without_truth(drive).placed_odometry
    inside = drive.fix_stamps_ns <= 10 * SECOND
    np.testing.assert_allclose(
        fixes.at(drive.fix_stamps_ns[inside])[:, :2].mean(axis=0),
        drive.fix_positions[inside].mean(axis=0))
    result = without_fixes(without_truth(drive)).placed_odometry
    np.testing.assert_allclose(result.poses, straight(0.5).poses, atol=1e-9)
    nothing = replace(without_fixes(without_truth(drive)), corrected=NOTHING)
    assert nothing.placed_odometry is drive.odometry


def test_rows_of_a_hand_made_drive() -> None:
    rows = {row.name: row for row in hand_made_drive().rows}
    assert list(rows) == [
        'odometry alone to truth', 'fixes to truth', 'corrected path to truth',
        'corrected heading to truth',
        'odometry alone to fixes used', 'corrected path to fixes used',
        'odometry alone to fixes held out', 'corrected path to fixes held out',
    ]
    assert rows['odometry alone to truth'].maximum == pytest.approx(0.0, abs=1e-9)
    assert rows['fixes to truth'].count == 4  # the fifth is after the end
    assert rows['fixes to truth'].median == pytest.approx(1.5)
    assert rows['corrected path to truth'].rms == pytest.approx(0.5)
    assert rows['corrected heading to truth'].unit == 'deg'
    assert rows['corrected path to fixes used'].median == pytest.approx(0.5)
    assert rows['corrected path to fixes held out'].median == pytest.approx(2.0)
    assert rows['corrected path to fixes held out'].maximum == pytest.approx(2.5)


def test_a_truth_in_another_map_gives_path_and_odometry_the_same_errors() -> None:
    """As where a part of a recording is replayed: the map begins at another fix."""
    drive = hand_made_drive()
    bent = drive.corrected.poses + np.column_stack((
        np.zeros(11), 0.3 * np.sin(np.arange(11.0)), np.zeros(11)))
    drive = replace(drive, corrected=Trajectory(drive.corrected.stamps_ns, bent))
    truth = straight()
    elsewhere = replace(drive, truth=Trajectory(
        truth.stamps_ns, se2.compose(np.array((280.0, -35.0, 2.0)), truth.poses)))
    placed = [place_truth(each) for each in (drive, elsewhere)]
    rows = [each.rows for each in placed]
    for one, other in zip(*rows, strict=True):
        assert one.rms == pytest.approx(other.rms, abs=1e-6)
    assert max(row.rms for row in rows[1] if row.name == 'corrected path to truth') < 0.3
    assert placed[1].truth_moved is not None
    assert placed[1].truth_moved[0] == pytest.approx(282.0, abs=15.0)
    assert placed[1].truth_moved[1] == pytest.approx(2.0, abs=0.1)
    assert place_truth(without_truth(drive)).truth_moved is None


def test_what_is_doubted_is_no_reference_and_counted_apart() -> None:
    drive = replace(
        hand_made_drive(),
        fix_states=np.array([BELIEVED, DOUBTED, HELD_OUT, HELD_OUT, BELIEVED]))
    rows = {row.name: row for row in drive.rows}
    assert rows['corrected path to fixes used'].count == 1
    assert rows['corrected path to fixes doubted'].count == 1
    assert (rows['fixes to truth'].count, rows['doubted fixes to truth'].count) == (3, 1)
    assert rows['corrected path to fixes held out'].count == 2
    result = summary(drive, {})
    assert (result['fixes_used'], result['fixes_doubted'], result['fixes_held_out']) == (2, 1, 2)


@pytest.mark.parametrize(('turn', 'shape'), [(0.0, 'wide'), (np.pi / 2.0, 'tall')])
def test_the_paths_are_drawn_in_their_colours(turn, shape, tmp_path) -> None:
    drive = hand_made_drive()
    pose = np.array([100.0, 50.0, turn])
    truth = Trajectory(straight().stamps_ns, se2.compose(pose, straight().poses))
    result = Trajectory(truth.stamps_ns, se2.compose(pose, straight(0.5).poses))
    turned = replace(drive, truth=truth, corrected=result,
                     fix_positions=se2.transform(pose, drive.fix_positions))
    draw_drive(turned, tmp_path / f'{shape}.png', shape)
    pixels = np.round(imread(tmp_path / f'{shape}.png')[..., :3] * 255.0)
    for colour in (BLUE, GREEN, VERMILION):
        rgb = [int(colour[k:k + 2], 16) for k in (1, 3, 5)]
        assert np.sum(np.all(np.abs(pixels - rgb) < 3.0, axis=-1)) > 20, colour
