# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tool `pose-graph replay` without ROS: its files, counts, comparisons and exit codes."""

import json
import os
from pathlib import Path
import sys
from typing import Any

from bag_of_messages import write_bag
from circle_bag import circle, fixes, odometry, replayed_bag
import numpy as np
import pytest
from run_schema import problems
from tum_files import read_tum

from pose_graph_ros.adapters.bag_writer import message_types
from pose_graph_ros.adapters.bags import BagError, choose_inputs, open_bag
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import source_list
from pose_graph_ros.cli import replay
from pose_graph_ros.cli.drive import drive_in, REFUSED
from pose_graph_ros.cli.main import guarded, main
from pose_graph_ros.cli.simulate import (
    loop_closure_messages,
    Message,
    odometry_messages,
)
from pose_graph_ros.cli.truth import read_truth
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.io.g2o import read_g2o

TYPES = message_types()
POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
ANTENNA = np.array([1.5, -0.5])


def pose_messages(topic: str, type_name: str, frame: str = 'map') -> list[Message]:
    """The circle once a second, in messages of a type with a stamped pose."""
    path = circle()
    made = []
    for (_, _, stamp, message), in zip(odometry_messages(
            topic, frame, path, (0.01, 0.01, 0.0, 0.0, 0.0, 1e-4)), strict=True):
        pose = message.pose.pose if type_name.endswith('PoseStamped') else message.pose
        made.append((topic, type_name, stamp, TYPES[type_name](message.header, pose)))
    return made[::10]


def run(*words: object) -> int:
    return main(['replay', *map(str, words)])


def summary_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / 'summary.json').read_text(encoding='utf-8'))


def rms(content: dict[str, Any]) -> dict[str, float]:
    return {row['name']: row['rms'] for row in content['errors']}


def test_global_poses_correct_the_path_and_all_files_are_written(tmp_path, capsys) -> None:
    path = circle()
    closed = path.stamps_ns[[0, 314]]
    relative = se2.between(path.poses[[0]], path.poses[[314]])
    write_bag(tmp_path / 'bag', (
        *odometry(), *pose_messages('/pose', POSE),
        *loop_closure_messages('/loop_closure', closed[None], relative, 0.01 * np.eye(3)),
        *odometry_messages('/truth', 'map', path, (0.0,) * 6)))
    out = tmp_path / 'deep' / 'out'
    assert run(tmp_path / 'bag', '--odom', '/odom', '--truth', '/truth', '-o', out) == 0
    printed = capsys.readouterr().out
    assert 'odom: /odom\nglobal_pose: /pose\nloop_closure: /loop_closure\n' in printed
    assert sorted(each.name for each in out.iterdir()) == [
        'drive.png', 'graph.g2o', 'path.tum', 'run.json', 'summary.json']
    content = summary_of(out)
    assert content['counts'] == {
        'odom.accepted': 400, 'global_pose.accepted': 40, 'loop_closure.accepted': 1}
    assert (content['status'], content['alignment']) == ('converged', 'aligned')
    assert (content['loop_closures'], content['fixes_used'], content['odometry']) == (1, 40, 400)
    assert content['truth'] is True
    assert content['hidden_nodes'] == read_g2o(out / 'graph.g2o').graph.n_nodes
    told = json.loads((out / 'run.json').read_text(encoding='utf-8'))
    assert list(problems(told)) == []
    assert told['subtitle'] == 'replay of bag'
    assert {each['name']: each['used'] for each in told['sources']} == {
        'odom': content['hidden_nodes'] - 1, 'global_pose': 40, 'loop_closure': 1}
    assert told['updates']['nodes'][-1] <= content['hidden_nodes']
    assert [row['rms'] for row in told['error_table']] == pytest.approx(
        [row['rms'] for row in content['errors']], rel=1e-4)
    # the path is as long as the drive, at its place, and better than odometry at its best
    corrected = read_tum(out / 'path.tum')
    expected = path.at(corrected.stamps_ns)
    assert np.max(np.hypot(*(corrected.poses - expected)[:, :2].T)) < 0.1
    errors = rms(content)
    assert errors['corrected path to truth'] < 0.03 < errors['odometry alone to truth']
    assert 'corrected path to truth' in printed
    assert 'NEES of the pose: ' in printed
    assert [content[f'nees_{name}']['expected'] for name in ('position', 'pose')] == [2, 3]
    assert 'counts: global_pose.accepted 40, loop_closure.accepted 1, odom.accepted 400' in printed


def test_distances_from_fixes_are_those_of_the_robot_not_of_the_antenna(tmp_path) -> None:
    write_bag(tmp_path / 'bag', (*odometry(), *fixes(ANTENNA)))
    assert run(tmp_path / 'bag', '--hold-out', 4, '-o', tmp_path, '-p',
               f'fix.lever_arm:={ANTENNA.tolist()}') == 0
    content = summary_of(tmp_path)
    assert (content['fixes_used'], content['fixes_held_out']) == (60, 20)
    assert content['counts']['fix.accepted'] == 60
    errors = rms(content)
    for kind in ('used', 'held out'):
        assert errors[f'corrected path to fixes {kind}'] < 0.1


def test_messages_without_a_measurement_are_counted_and_not_compared_with(tmp_path) -> None:
    bad = fixes(np.zeros(2))[:3]
    for _, _, _, message in bad:
        message.status.status = -1
    first = int(circle().stamps_ns[0])
    elsewhere = pose_messages('/pose', POSE, 'elsewhere')[:2]
    junk = [('/gps/fix', 'sensor_msgs/msg/NavSatFix', first + k, b'\0\1\0\0x') for k in range(4)]
    write_bag(tmp_path / 'bag', (*odometry(), *fixes(np.zeros(2))[3:], *bad, *junk, *elsewhere))
    assert run(tmp_path / 'bag', '--fix', '/gps/fix', '--global-pose', '/pose',
               '-o', tmp_path) == 0
    content = summary_of(tmp_path)
    assert content['counts'] == {
        'fix.accepted': 77, 'fix.malformed': 4, 'fix.no_fix': 3, 'global_pose.wrong_frame': 2,
        'odom.accepted': 400}
    assert content['fixes_used'] == 77


def test_a_loop_closure_to_a_node_is_used_but_has_no_stamp_to_be_drawn_at(tmp_path) -> None:
    path = circle()
    closures = list(loop_closure_messages(
        '/loop_closure', path.stamps_ns[[[0, 314]]], se2.between(
            path.poses[[0]], path.poses[[314]]), 0.01 * np.eye(3)))
    closures[0][3].header.frame_id = 'x0'
    write_bag(tmp_path / 'bag', (*odometry(), *closures))
    assert run(tmp_path / 'bag', '-o', tmp_path) == 0
    content = summary_of(tmp_path)
    assert content['counts']['loop_closure.accepted'] == 1
    assert content['loop_closures'] == 0


def test_a_loop_closure_to_a_node_that_has_left_is_not_drawn_as_used(tmp_path) -> None:
    truth = circle()
    ends = truth.stamps_ns[[50, -50]]
    relative = se2.between(*truth.at(ends))
    write_bag(tmp_path / 'bag', (
        *odometry(), *fixes(np.zeros(2)),
        *loop_closure_messages('/loop_closure', ends[None], relative[None], 0.01 * np.eye(3))))
    values = checked({'window.nodes': 8})
    with open_bag(tmp_path / 'bag') as bag:
        inputs = choose_inputs(bag, source_list(values), {})
        result = replayed_bag(bag, inputs, values)
        drive = drive_in(bag, inputs, values, result.backend, origin=None,
                         refused=result.refused)
    assert result.backend.counts['loop_closure', 'before_window'] == 1
    assert drive.loop_states.tolist() == [REFUSED]


@pytest.mark.parametrize(('datum', 'axes'), [
    ([], ('east', 'north')), ([50.7, 7.1], ('east', 'north')), ([50.7, 7.1, 0.5], ('x', 'y'))])
def test_the_axes_of_the_map_are_east_and_north_unless_it_is_turned(datum, axes, tmp_path) -> None:
    write_bag(tmp_path / 'bag', (*odometry(), *fixes(np.zeros(2))))
    values = checked({'datum': datum})
    with open_bag(tmp_path / 'bag') as bag:
        inputs = choose_inputs(bag, source_list(values), {})
        drive = drive_in(bag, inputs, values, replayed_bag(bag, inputs, values).backend,
                         origin=None)
    assert drive.map_axes == axes
    assert drive.truth is None
    np.testing.assert_array_equal(drive.odometry.stamps_ns, circle().stamps_ns)


@pytest.mark.parametrize('type_name', [
    'nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseStamped', POSE])
def test_truth_is_read_from_each_type_with_a_pose(type_name, tmp_path) -> None:
    path = circle()
    messages = list(odometry_messages('/truth', 'map', path, (0.0,) * 6))[::10]
    if type_name != 'nav_msgs/msg/Odometry':
        messages = pose_messages('/truth', type_name)
    broken = [('/truth', type_name, int(path.stamps_ns[5]), b'\0\1\0\0junk')]
    write_bag(tmp_path / 'bag', (*odometry(), *messages, *broken))
    with open_bag(tmp_path / 'bag') as bag:
        truth, heights = read_truth(bag, '/truth')
        np.testing.assert_array_equal(truth.stamps_ns, path.stamps_ns[::10])
        np.testing.assert_allclose(truth.poses, path.poses[::10], atol=1e-12)
        assert heights.tolist() == [0.0] * len(truth)
        with pytest.raises(BagError, match=r'no topic /nothing \(--truth\)'):
            read_truth(bag, '/nothing')


def test_lengths_are_those_in_the_plane_beside_those_with_heights(tmp_path, capsys) -> None:
    steep, truth = odometry(), pose_messages('/truth', POSE)
    for k, (_, _, _, message) in enumerate(steep):
        message.pose.pose.position.z = 0.02 * k     # of 0.2 m
    write_bag(tmp_path / 'bag', (*steep, *fixes(np.zeros(2)), *truth))
    words = tmp_path / 'bag', '-o', tmp_path / 'out'
    assert run(*words, '--truth', '/truth') == 0
    assert 'length of odometry: ' in (told := capsys.readouterr().out)
    assert 'length of truth' not in told
    found = summary_of(tmp_path / 'out')['lengths_m']
    assert found['path'] == pytest.approx(79.8, abs=0.2)
    assert found['odometry'] == pytest.approx(1.01 * 399 * 0.2, abs=0.01)
    assert found['odometry_with_heights'] == pytest.approx(
        399 * np.hypot(0.02, 1.01 * 0.2), abs=0.01)
    assert found['truth'] == pytest.approx(390 * 0.2 * np.sin(0.1) / 0.1, abs=0.01)
    assert found['truth_with_heights'] is None


def test_the_length_of_a_truth_with_heights_is_that_of_evo_while_the_path_lasts(tmp_path) -> None:
    evo = pytest.importorskip('evo.tools.file_interface', reason='evo is not there')
    write_bag(tmp_path / 'bag', odometry())
    file = tmp_path / 'truth.tum'
    file.write_text('1 0 0 0 0 0 0 1\n' + ''.join(
        f'{stamp / 1e9:.6f} {k} 0 {0.1 * k} 0 0 0 1\n' for k, stamp in enumerate(
            circle().stamps_ns[::10].tolist())))
    assert run(tmp_path / 'bag', '-o', tmp_path / 'out', '--truth', file) == 0
    truth = evo.read_tum_trajectory_file(str(file))
    truth.reduce_to_ids(range(1, 41))
    found = summary_of(tmp_path / 'out')['lengths_m']
    assert found['truth_with_heights'] == pytest.approx(truth.path_length, abs=1e-9)
    assert found['truth'] == pytest.approx(39.0, abs=1e-9)


def test_a_bag_without_usable_odometry_is_one_line_of_error(tmp_path, capsys) -> None:
    messages = odometry()[:5]
    for _, _, _, message in messages:
        message.pose.pose.position.x = np.nan
    write_bag(tmp_path / 'bag', messages)
    assert run(tmp_path / 'bag', '-o', tmp_path / 'out') == 2
    assert capsys.readouterr().err == (
        f'error: {tmp_path}/bag: no usable odometry on /odom: not_finite 5\n')
    assert not (tmp_path / 'out').exists()


def test_the_exit_code_says_whether_the_optimisation_converged(tmp_path, monkeypatch) -> None:
    write_bag(tmp_path / 'bag', odometry())
    with open_bag(tmp_path / 'bag') as bag:
        values = checked({})
        done = replayed_bag(bag, choose_inputs(bag, source_list(values), {}), values)
    assert done.report.status is Status.CONVERGED
    for status, code in ((Status.CONVERGED, 0), (Status.MAX_ITERATIONS, 1), (Status.FAILED, 1)):
        report = UpdateReport(status, '', 0, 0, 0.0)
        monkeypatch.setattr(replay, 'run', lambda *_, report=report: done._replace(report=report))
        assert run(tmp_path / 'bag', '-o', tmp_path / 'out') == code


@pytest.mark.parametrize(('error', 'code', 'said'), [
    (PoseGraphError('what is wrong'), 2, 'error: what is wrong\n'),
    (PermissionError('no entry'), 2, 'error: no entry\n'), (KeyboardInterrupt(), 130, '')])
def test_errors_of_the_user_are_one_line_and_an_exit_code(error, code, said, capsys) -> None:
    def execute() -> int:
        raise error

    assert guarded(execute) == code
    assert capsys.readouterr() == ('', said)


def test_a_pipe_whose_reader_has_ended_is_no_traceback(tmp_path, monkeypatch) -> None:
    def execute() -> int:
        raise BrokenPipeError

    with (tmp_path / 'out').open('w', encoding='utf-8') as stream:
        monkeypatch.setattr(sys, 'stdout', stream)
        assert guarded(execute) == 1
        # what is still in the buffer goes nowhere
        assert os.path.samestat(os.fstat(stream.fileno()), os.stat(os.devnull))
