# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`pose-graph tune` on bags, and what it says of wrong input."""

import contextlib
import io
import json
from pathlib import Path
import re
from typing import Any

from bag_of_messages import write_bag
from helpers.noisy_drive import made, write
import numpy as np
from public_data import needs, PUBLIC
import pytest
import yaml

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.simulate import fix_messages, odometry_messages
from pose_graph_ros.cli.tuned_parameters import changed, odometry_parameters
from pose_graph_ros.core.geometry.geodesy import TangentPlane
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.offline.noise import Found


@pytest.fixture(scope='module')
def overconfident(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag with fixes of 1 m that claim 3 cm."""
    return write(tmp_path_factory.mktemp('tune') / 'bag', *made(4, 120), claimed=0.03)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(scope='module')
def tuned(overconfident: Path) -> tuple[Path, dict[str, Any], str]:
    """Return the parameter file, the summary, and what a terminal has been told meanwhile."""
    out, text, told = overconfident.parent / 'tuned.yaml', io.StringIO(), Terminal()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(told):
        assert main(['tune', str(overconfident), '-o', str(out), '--folds', '2', '--json']) == 0
    return out, json.loads(text.getvalue()), told.getvalue()


def test_it_makes_errors_at_held_out_fixes_lower(tuned) -> None:
    _, facts, _ = tuned
    assert facts['verdict'] == 'better'
    assert facts['after']['rms'] < 0.99 * facts['before']['rms']
    assert facts['after']['nlpd'] < facts['before']['nlpd']
    assert 0.5 < facts['after']['nees'] < 2.0
    assert facts['before']['n'] == facts['after']['n'] > 100


def test_the_node_takes_the_file(tuned, tmp_path) -> None:
    path, facts, _ = tuned
    content = yaml.safe_load(path.read_text())['/**']['ros__parameters']
    assert 0.8 < content['fix']['covariance_scale'] * 0.03**2 < 1.25
    bag = facts['bags'][0]
    assert main(['replay', bag, '--params-file', str(path), '-o', str(tmp_path / 'out')]) == 0
    given = {each['name'] for each in facts['parameters'] if each['changed']}
    assert given == {f'{source}.{name}' for source, of in content.items() for name in of}


def test_no_file_is_written_where_nothing_becomes_better(tmp_path, capsys) -> None:
    bag, out = write(tmp_path / 'bag', *made(4, 60), claimed=1.0), tmp_path / 'tuned.yaml'
    out.write_text('from before')
    assert main(['tune', str(bag), '-o', str(out), '--folds', '2']) == 1
    assert out.read_text() == 'from before'
    assert 'nothing is written' in capsys.readouterr().out


def test_stretches_that_are_too_long_are_refused(overconfident, capsys) -> None:
    assert main(['tune', str(overconfident), '--folds', '2', '--stretch', '3600']) == 2
    assert re.search(r'at most \d+ s, as it lasts \d+ s in 2 parts, got 3600',
                     capsys.readouterr().err)


def test_a_part_may_have_all_fixes(tmp_path, capsys) -> None:
    odometry, fixes = made(4, 62)
    bag = write(tmp_path / 'bag', odometry, fixes[:25], claimed=1.0)
    assert main(['tune', str(bag), '--folds', '2', '--stretch', '30', '--json',
                 '-o', str(tmp_path / 'tuned.yaml')]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert facts['after']['n'] <= 25
    assert facts['file'] is None
    assert not (tmp_path / 'tuned.yaml').exists()


def test_a_part_of_the_bag_is_tuned_by(overconfident, tmp_path, capsys) -> None:
    words = 'tune', str(overconfident), '-o', str(tmp_path / 'tuned.yaml'), '--folds', '2'
    assert main([*words, '--from', '20', '--until', '80']) in (0, 1)
    assert '\n60 s of odometry, 60 of fix;' in capsys.readouterr().out
    assert main([*words, '--from', '80', '--until', '20']) == 2
    assert 'nothing was recorded between --from and --until' in capsys.readouterr().err


def test_progress_has_a_total(tuned) -> None:
    steps = re.findall(r'step (\d+) of (\d+): ', tuned[2])
    assert [int(step) for step, _ in dict.fromkeys(steps)] == list(range(1, len(set(steps)) + 1))
    assert steps[-1][0] == steps[-1][1]


@pytest.mark.parametrize(('args', 'message'), [
    (['missing'], 'missing'),
    (['{bag}', '-o', '{folder}'], 'is a folder'),
    (['{bag}', '-o', '{folder}/none/tuned.yaml'], 'no folder'),
    (['{bag}', '--fix', '/none'], 'no topic /none'),
    (['{bag}', '--truth', '/none'], 'no topic /none'),
    (['{bag}', '-p', 'sources:=[odom]'], 'nothing to tune by'),
])
def test_wrong_input_is_one_line(args, message, overconfident, tmp_path, capsys) -> None:
    assert main(['tune', *(each.format(bag=overconfident, folder=tmp_path) for each in args)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith('error: ')
    assert error.count('\n') == 1


def test_sigmas_follow_the_noise_of_way_and_turn_and_replace_a_scale_set_by_hand() -> None:
    values = checked({'odom.sigma_scale': 2.0})
    way, turn = Found(9.0, 4.0, 16.0, kept=False), Found(1.0, 0.5, 1.5, kept=True)
    after = changed(odometry_parameters('odom', way, turn, values))
    assert after == pytest.approx({'odom.sigma_distance': 3.0 * values['odom.sigma_distance'],
                                   'odom.sigma_lateral': 3.0 * values['odom.sigma_lateral'],
                                   'odom.sigma_scale': 1.0})
    twist = checked({'odom.noise': 'twist', 'odom.covariance_scale': 2.0})
    assert changed(odometry_parameters('odom', way, turn, twist)) == {
        'odom.covariance_scale': 18.0}


def test_loop_closures_alone_show_the_noise_of_odometry(tmp_path, capsys) -> None:
    bag, out = tmp_path / 'grid', tmp_path / 'tuned.yaml'
    assert main(['simulate', str(bag), '--world', 'grid', '--duration', '300', '--seed', '101',
                 '--closures', '1']) == 0
    capsys.readouterr()
    sure = ('sigma_heading_distance:=0.001', 'sigma_heading_turn:=0.005')
    assert main(['tune', str(bag), *(word for each in sure for word in ('-p', f'odom.{each}')),
                 '--folds', '2', '--json', '-o', str(out)]) in (0, 1)
    found = {each['name']: each for each in json.loads(capsys.readouterr().out)['parameters']}
    for each in ('odom.sigma_heading_distance', 'odom.sigma_heading_turn'):
        assert 1.5 < found[each]['after'] / found[each]['before'] < 6.0
    assert found['loop_closure.covariance_scale']['after'] >= 1.0


def test_a_truth_at_other_times_is_null_in_json(tmp_path, capsys) -> None:
    odometry, fixes = made(4, 40)
    path = Trajectory(np.array([each.stamp_ns for each in odometry]),
                      np.array([each.pose for each in odometry]))
    geodetic = TangentPlane(50.7, 7.1, 60.0).to_geodetic(
        np.array([each.position for each in fixes]), 60.0)
    write_bag(tmp_path / 'bag', (
        *odometry_messages('/odom', 'odom', path, (0.0,) * 6),
        *odometry_messages('/truth', 'map', Trajectory(path.stamps_ns + 10**12, path.poses),
                           (0.0,) * 6),
        *fix_messages('/fix', np.array([each.stamp_ns for each in fixes]), geodetic, 1.0)))
    assert main(['tune', str(tmp_path / 'bag'), '--odom', '/odom', '--truth', '/truth', '--json',
                 '--folds', '2', '-o', str(tmp_path / 'tuned.yaml')]) in (0, 1)
    facts = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert facts['to_truth'] == {'before': None, 'after': None}


HUSKY = PUBLIC / 'robot/husky_test1_ros2'


def facts_of(capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, Any]:
    capsys.readouterr()
    assert main(['tune', '--folds', '2', '--json', *args]) in (0, 1)
    return dict(json.loads(capsys.readouterr().out))


@needs('robot/husky_test1_ros2')
@pytest.mark.timeout(400)
def test_husky_is_nearer_to_fixes_held_out_by_the_noise_that_it_shows(tmp_path, capsys) -> None:
    """Found while it is driven, in 20 s without fixes: 3.3 m and a NEES of 2.5 as claimed."""
    facts = facts_of(capsys, str(HUSKY), '--odom', '/husky_velocity_controller/odom', '--fix',
                     '/fix', '--stretch', '20', '-o', str(tmp_path / 'tuned.yaml'))
    assert facts['stretch_s'] == 20.0
    assert facts['before']['rms'] < 2.5
    assert 0.6 < facts['before']['nees'] < 1.4
    assert facts['after']['rms'] < 1.02 * facts['before']['rms']
    assert (tmp_path / 'tuned.yaml').exists() == (facts['verdict'] == 'better')
