# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`pose-graph replay` of bags of ROS 1 and ROS 2, compressed, in parts, and wrong ones."""

import json
from pathlib import Path
import sys

from bag_of_messages import write_bag
from circle_bag import circle, fixes, NOETIC, odometry, replayed_bag, write_compressed, write_ros1
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionMode
from tum_files import read_tum

from pose_graph_ros.adapters.bags import choose_inputs, open_bag
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import source_list
from pose_graph_ros.cli.drive import HELD_OUT
from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.shared import watched_bag
from pose_graph_ros.cli.simulate import Message

START = int(circle().stamps_ns[0])


def drive() -> list[Message]:
    return [*odometry(), *fixes(np.zeros(2))]


def replayed(out: Path, *words: object) -> bytes:
    """Return the path of a replay, as it is in its file."""
    assert main(['replay', *map(str, words), '-o', str(out)]) == 0
    return (out / 'path.tum').read_bytes()


def error_of(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Return the one line that a replay of wrong input ends with."""
    capsys.readouterr()
    assert main(['replay', *map(str, words)]) == 2
    text = capsys.readouterr().err
    assert text.startswith('error: ')
    assert text.count('\n') == 1
    return text


def path_of(*bags: Path) -> list[bytes]:
    """Return stamps and poses of the path of the engine that a replay fills."""
    values = checked({})
    with open_bag(*bags) as bag:
        inputs = choose_inputs(bag, source_list(values), {})
        estimate = replayed_bag(bag, inputs, values).backend.estimate()
    assert estimate is not None
    assert len(estimate.path) == 81
    return [estimate.path.stamps_ns.tobytes(), estimate.path.poses.tobytes()]


def test_the_path_is_the_same_bit_for_bit_whatever_the_bag_is(tmp_path) -> None:
    write_bag(tmp_path / 'bag', drive())
    expected = path_of(tmp_path / 'bag')
    for form in (None, Rosbag1Writer.CompressionFormat.BZ2, Rosbag1Writer.CompressionFormat.LZ4):
        assert path_of(write_ros1(tmp_path / f'{form}.bag', drive(), form)) == expected
    for mode in (CompressionMode.FILE, CompressionMode.MESSAGE, CompressionMode.STORAGE):
        assert path_of(write_compressed(tmp_path / mode.name, drive(), mode)) == expected


def test_several_bags_are_one_recording_whatever_their_order(tmp_path) -> None:
    messages, middle = drive(), START + 20 * 10**9
    write_bag(tmp_path / 'whole', messages)
    expected = path_of(tmp_path / 'whole')
    write_bag(tmp_path / 'first', [each for each in messages if each[2] < middle])
    last = write_ros1(tmp_path / 'last.bag', [each for each in messages if each[2] >= middle])
    assert path_of(last, tmp_path / 'first') == expected
    # recorded side by side
    write_bag(tmp_path / 'odom', odometry())
    fix = write_ros1(tmp_path / 'fix.bag', fixes(np.zeros(2)))
    assert path_of(tmp_path / 'odom', fix) == expected


def test_only_what_was_recorded_in_a_span_is_used(tmp_path) -> None:
    write_bag(tmp_path / 'bag', drive())
    replayed(tmp_path / 'a', tmp_path / 'bag', '--from', 5, '--until', 15.05)
    part = read_tum(tmp_path / 'a' / 'path.tum')
    assert part.stamps_ns[[0, -1]].tolist() == [START + 5 * 10**9, START + 15 * 10**9]
    inside = [each for each in drive() if 5.0 <= (each[2] - START) * 1e-9 < 15.05]
    write_bag(tmp_path / 'inside', inside)
    assert replayed(tmp_path / 'b', tmp_path / 'inside') == (
        tmp_path / 'a' / 'path.tum').read_bytes()


def test_wrong_bags_are_one_line_that_names_them(tmp_path, capsys) -> None:
    good = tmp_path / 'good'
    write_bag(good, drive())
    whole = write_ros1(tmp_path / 'whole.bag', drive()).read_bytes()
    for name, data in (('cut.bag', whole[:4000]), ('text.bag', b'something else')):
        (tmp_path / name).write_bytes(data)
        text = error_of(capsys, good, tmp_path / name)
        assert text.startswith(f'error: {tmp_path / name}: damaged, cut short or not supported')
    metadata = write_compressed(
        tmp_path / 'packed', drive(), CompressionMode.MESSAGE) / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('zstd', 'gzip'))
    assert f'{tmp_path}/packed: damaged, cut short or not supported: Compression format' in (
        error_of(capsys, tmp_path / 'packed'))
    assert '/gps/fix is of type sensor_msgs/msg/NavSatFix, expected nav_msgs' in error_of(
        capsys, good, '--odom', '/gps/fix')
    point = NOETIC.types['geometry_msgs/msg/Point'](1.0, 2.0, 3.0)
    other = write_ros1(tmp_path / 'other.bag', [('/odom', 'geometry_msgs/msg/Point', 1, point)])
    assert '--odom /odom is of type geometry_msgs/msg/Point | nav_msgs/msg/Odometry' in error_of(
        capsys, good, other, '--odom', '/odom')
    assert 'nothing was recorded between --from and --until; the recording is 39.9' in error_of(
        capsys, good, '--from', 50)
    assert 'expected one .g2o file alone' in error_of(capsys, good, 'graph.g2o')


def test_a_terminal_sees_how_far_a_bag_is_read(tmp_path, capsys, monkeypatch) -> None:
    write_bag(tmp_path / 'bag', drive())
    monkeypatch.setattr('pose_graph_ros.cli.shared.DELAY', 0.0)
    with open_bag(tmp_path / 'bag') as bag:
        plain = [message.raw for message in bag.messages(['/odom'])]
        assert [each.raw for each in watched_bag(bag, 'reading').messages(['/odom'])] == plain
        assert capsys.readouterr().err == ''
        monkeypatch.setattr(sys.stderr, 'isatty', lambda: True)
        assert [each.raw for each in watched_bag(bag, 'reading').messages(['/odom'])] == plain
    assert 'reading:   0%|' in capsys.readouterr().err


def test_live_poses_do_not_know_what_came_later(tmp_path) -> None:
    write_bag(tmp_path / 'bag', drive())
    tables = []
    for name, part in (('whole', ()), ('part', ('--until', 12))):
        replayed(tmp_path / name, tmp_path / 'bag', '--live', *part)
        tables.append((tmp_path / name / 'live.csv').read_text().splitlines())
    whole, part = tables
    assert 50 < len(part) < len(whole)
    assert whole[:len(part)] == part


@pytest.mark.parametrize('named', ['wheel/odometry', '/wheel/odometry'])
def test_topics_of_ros_1_without_a_slash_can_be_named(named, tmp_path) -> None:
    messages = [(topic, *rest) for topic in ('wheel/odometry', 'other') for _, *rest in odometry()]
    bag = write_ros1(tmp_path / 'bag.bag', messages)
    by_option = replayed(tmp_path / 'option', bag, '--odom', named)
    by_parameter = replayed(tmp_path / 'parameter', bag, '-p', f'odom.topic:={named}')
    assert by_option == by_parameter


def test_whole_stretches_of_the_drive_are_held_out(tmp_path, capsys) -> None:
    write_bag(tmp_path / 'bag', drive())
    replayed(tmp_path / 'out', tmp_path / 'bag', '--hold-out', 4, '--stretch', 5)
    told = json.loads((tmp_path / 'out' / 'run.json').read_text())
    assert not any('no messages' in each['text'] for each in told['findings'])
    (fixes_there,) = told['fixes']
    # the fourth stretch and the eighth, of 5 s each
    assert [state == HELD_OUT for state in fixes_there['state']] == [
        15.0 <= t < 20.0 or t >= 35.0 for t in fixes_there['t']]
    assert fixes_there['state'].count(HELD_OUT) == 20
    for words, said in ((('--stretch', 5), 'expected --hold-out N'),
                        (('--hold-out', 4, '--stretch', 11), 'at most 10 s'),
                        (('--hold-out', 1000), 'fixes none is held out')):
        assert said in error_of(capsys, tmp_path / 'bag', *words)
