# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags: what is written is read back, and whatever is wrong is said in one line with the path."""

from contextlib import suppress
import logging
from pathlib import Path
import re
import shutil
import sqlite3
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from ruamel.yaml import YAML

from pose_graph_ros.adapters.bag_writer import BagWriter, message_types
from pose_graph_ros.adapters.bags import BagError, MessageError, open_bag

POINT = 'geometry_msgs/msg/Point'
STRING = 'std_msgs/msg/String'
TYPES = message_types()


def point(x: float) -> Any:
    return TYPES[POINT](x, 2.0, 3.0)


def write_points(folder: Path, storage: str = 'mcap', count: int = 5) -> Path:
    with BagWriter(folder) as bag:
        for k in range(count):
            bag.write('/a', POINT, 100 + k, point(k))
        bag.write('/b', STRING, 102, TYPES[STRING]('hello'))
    return folder if storage == 'mcap' else in_sqlite3(folder)


def in_sqlite3(folder: Path) -> Path:
    """Write a bag anew as sqlite3."""
    with open_bag(folder) as bag:
        messages = list(bag.messages(list(bag.topics)))
    shutil.rmtree(folder)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        types = dict.fromkeys((each.topic, each.type) for each in messages)
        topics = {topic: writer.add_connection(
            topic, of_type, typestore=get_typestore(Stores.ROS2_JAZZY))
            for topic, of_type in types}
        for each in messages:
            writer.write(topics[each.topic], each.recorded_ns, each.raw)
    return folder


def files_below(folder: Path) -> list[Path]:
    return sorted(folder.rglob('*'))


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_what_is_written_is_read_back(tmp_path: Path, storage: str) -> None:
    folder = write_points(tmp_path / 'deep' / 'bag', storage)
    with open_bag(folder) as bag:
        assert {name: (t.type, t.count) for name, t in bag.topics.items()} == {
            '/a': (POINT, 5), '/b': (STRING, 1)}
        messages = list(bag.messages(['/a', '/b']))
    assert [m.recorded_ns for m in messages] == [100, 101, 102, 102, 103, 104]
    assert [m.decode().x for m in messages if m.topic == '/a'] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert all(type(m.raw) is bytes for m in messages)
    assert files_below(tmp_path / 'deep') == [folder, *files_below(folder)]  # no scratch left
    # a lone file is a bag, too, with and without its folder
    (inside,) = (path for path in folder.iterdir() if path.suffix != '.yaml')
    for path in (inside, shutil.copy(inside, tmp_path)):
        with open_bag(str(path)) as bag:
            assert [m.decode().x for m in bag.messages({'/a'})] == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_metadata_is_what_jazzy_expects(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'bag', latched=['/path']) as bag:
        bag.write('/a', POINT, 1, point(1))
        bag.write('/path', POINT, 2, point(2))
        bag.write('/tf_static', POINT, 3, point(3))
    text = (tmp_path / 'bag' / 'metadata.yaml').read_text()
    information = YAML(typ='safe').load(text)['rosbag2_bagfile_information']
    assert information['version'] == 9
    assert information['storage_identifier'] == 'mcap'
    topics = [t['topic_metadata'] for t in information['topics_with_message_count']]
    assert all(t['type_description_hash'].startswith('RIHS01_') for t in topics)
    with Reader(tmp_path / 'bag') as reader:
        durability = {}
        for connection in reader.connections:
            assert isinstance(connection.ext, ConnectionExtRosbag2)
            durability[connection.topic] = connection.ext.offered_qos_profiles[0].durability
    assert durability == {
        '/a': QosDurability.VOLATILE,
        '/path': QosDurability.TRANSIENT_LOCAL,
        '/tf_static': QosDurability.TRANSIENT_LOCAL,
    }


def test_a_bad_message_does_not_end_the_iteration(tmp_path: Path) -> None:
    good = get_typestore(Stores.ROS2_JAZZY).serialize_cdr(point(1), POINT).tobytes()
    with BagWriter(tmp_path / 'bag') as bag:
        for k, raw in enumerate([good, good[:-5], b'', b'\xff' * 40, good]):
            bag.write('/a', POINT, k, raw)
    outcome = []
    with open_bag(tmp_path / 'bag') as reader:
        for message in reader.messages(['/a']):
            try:
                outcome.append(message.decode().x)
            except MessageError:
                outcome.append(None)
                with pytest.raises(MessageError, match=f'^/a: .* is no {POINT}'):
                    message.decode()
    assert outcome == [1.0, None, None, None, 1.0]


def test_the_bags_own_definitions_win(tmp_path: Path) -> None:
    types = get_typestore(Stores.EMPTY)
    types.register(get_types_from_msg('float32 q\nstring name', POINT))
    with Writer(tmp_path / 'bag', version=9) as writer:
        connection = writer.add_connection('/a', POINT, typestore=types)
        writer.write(connection, 7, types.serialize_cdr(types.types[POINT](0.5, 'own'), POINT))
    with open_bag(tmp_path / 'bag') as bag:
        assert next(bag.messages(['/a'])).decode().name == 'own'


@pytest.mark.parametrize(('definition', 'warnings'), [
    ('', 0), ('no definition at all ?!', 1), ('unknown_msgs/Thing x', 1)])
def test_without_a_usable_definition_that_of_jazzy_serves(
    tmp_path: Path, definition: str, warnings: int, caplog: pytest.LogCaptureFixture,
) -> None:
    types = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection('/a', POINT, msgdef=definition, rihs01='RIHS01_0')
        for stamp in (7, 8):
            writer.write(connection, stamp, types.serialize_cdr(point(1.5), POINT))
    with open_bag(tmp_path / 'bag') as bag, caplog.at_level(logging.WARNING):
        assert [m.decode().x for m in bag.messages(['/a'])] == [1.5, 1.5]
    assert len(caplog.records) == warnings


def test_unknown_topics_are_refused_at_once_with_those_that_exist(tmp_path: Path) -> None:
    with open_bag(write_points(tmp_path / 'bag')) as bag, pytest.raises(
        BagError, match=r'no topic /c; the bag has /a \(geometry_msgs/msg/Point\), /b',
    ):
        bag.messages(['/a', '/c'])


def assert_clear(path: Path, words: str) -> None:
    with pytest.raises(BagError, match=words) as caught:
        open_bag(path)
    assert str(caught.value).startswith(str(path))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(('storage', 'suffix'), [('mcap', '.mcap'), ('sqlite3', '.db3')])
def test_a_damaged_bag_is_read_as_far_as_it_goes_wherever_it_is_damaged(
    tmp_path: Path, storage: str, suffix: str,
) -> None:
    whole = (write_points(tmp_path / 'bag', storage, 2000) / f'bag{suffix}').read_bytes()
    cut = tmp_path / f'cut{suffix}'
    generator = np.random.default_rng(0)
    shares: tuple[list[float], list[float]] = ([], [])
    for k in range(40):
        data = bytearray(whole)
        if k % 2 == 0:
            del data[generator.integers(len(data)):]
        else:
            at = int(generator.integers(len(data) - 64))
            data[at:at + 64] = generator.bytes(64)
        cut.write_bytes(data)
        n = 0
        with suppress(BagError), open_bag(cut) as bag:
            for message in bag.messages(list(bag.topics)):
                n += 1
                with suppress(MessageError):
                    message.decode()
        shares[k % 2].append(n / (2001 * len(data) / len(whole)))
    # cut short, the end of the last part is lost; wrong bytes cost what is around them
    assert np.median(shares[0]) > 0.6
    assert np.median(shares[1]) > 0.7


@pytest.mark.parametrize(('storage', 'suffix'), [('mcap', '.mcap'), ('sqlite3', '.db3')])
def test_a_recording_that_was_cut_off_says_what_is_missing(
    tmp_path: Path, storage: str, suffix: str, caplog: pytest.LogCaptureFixture,
) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        for k in range(5000):
            writer.write('/a', POINT, 10**12 + k * 10**7, point(k))
    if storage == 'sqlite3':
        in_sqlite3(tmp_path / 'bag')
    path = tmp_path / 'bag' / f'bag{suffix}'
    path.write_bytes(path.read_bytes()[:path.stat().st_size // 2])
    with open_bag(tmp_path / 'bag') as bag:
        n = len(list(bag.messages(['/a'])))
    assert n > 1500
    missing = re.search(r'(\d+) messages .* ([\d.]+) s at the end are missing', caplog.text)
    assert missing is not None
    assert int(missing[1]) == n
    assert float(missing[2]) == pytest.approx(0.01 * (5000 - n), abs=0.06)
    # without metadata, as of a recorder that was killed, the files tell what they can
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    with open_bag(tmp_path / 'bag') as bag:
        assert len(list(bag.messages(['/a']))) == n
    assert 'how much is missing is not known' in caplog.text


@pytest.mark.parametrize('mode', ['wal', 'delete'])
def test_the_journal_beside_an_sqlite3_bag_is_applied(tmp_path: Path, mode: str) -> None:
    path = write_points(tmp_path / 'bag', 'sqlite3', 2000) / 'bag.db3'
    database = sqlite3.connect(path, isolation_level=None)
    database.execute(f'PRAGMA journal_mode={mode}')
    database.execute('PRAGMA cache_size=1')     # so that pages are written before the end
    database.execute('BEGIN')
    database.execute('DELETE FROM messages WHERE id > 1000')
    if mode == 'wal':
        database.execute('COMMIT')
    killed = tmp_path / 'killed'
    shutil.copytree(tmp_path / 'bag', killed)
    database.close()
    with open_bag(killed / 'bag.db3') as bag:
        assert len(list(bag.messages(['/a', '/b']))) == (1000 if mode == 'wal' else 2001)
    assert {each.name for each in killed.iterdir()} >= {'bag.db3', 'metadata.yaml'}


def test_nothing_is_overwritten_unless_asked_and_a_bag(tmp_path: Path) -> None:
    folder = write_points(tmp_path / 'bag')
    with pytest.raises(BagError, match='exists already'):
        BagWriter(folder)
    write_points(tmp_path / 'bag2')
    with BagWriter(folder, overwrite=True) as bag:
        bag.write('/new', POINT, 1, point(1))
    with open_bag(folder) as reader:
        assert list(reader.topics) == ['/new']

    for name in ('folder', 'bag2'):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / 'precious.txt').write_text('mine')
        with pytest.raises(BagError, match='holds other files'):
            BagWriter(tmp_path / name, overwrite=True)
    (tmp_path / 'file').write_text('mine')
    with pytest.raises(BagError, match='not overwritten'):
        BagWriter(tmp_path / 'file', overwrite=True)
    assert [p.name for p in sorted(tmp_path.iterdir())] == ['bag', 'bag2', 'file', 'folder']


def test_a_failure_leaves_the_old_bag_and_nothing_else(tmp_path: Path) -> None:
    folder = write_points(tmp_path / 'bag')
    before = files_below(tmp_path)
    with pytest.raises(RuntimeError), BagWriter(folder, overwrite=True):
        raise RuntimeError
    with pytest.raises(RuntimeError), BagWriter(tmp_path / 'new'):
        raise RuntimeError
    assert files_below(tmp_path) == before


def test_the_writer_refuses_what_it_cannot_write(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(BagError, match='cannot be written'):
        BagWriter(tmp_path / 'file' / 'bag')
    with BagWriter(tmp_path / 'bag') as bag:
        with pytest.raises(BagError, match='unknown to ROS 2 Jazzy'):
            bag.write('/a', 'my_msgs/msg/Thing', 1, b'')
        with pytest.raises(BagError, match=f'/a: no valid {POINT}'):
            bag.write('/a', POINT, 1, TYPES[STRING]('hello'))


def test_missing_messages_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    metadata = write_points(tmp_path / 'bag') / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('message_count: 5', 'message_count: 9'))
    with open_bag(tmp_path / 'bag') as bag, caplog.at_level(logging.WARNING):
        assert len(list(bag.messages(['/a']))) == 5
    assert '/a should have 9 messages, 5 were found' in caplog.text


def test_what_is_no_bag_is_said_so(tmp_path: Path) -> None:
    assert_clear(tmp_path / 'nothing', 'does not exist')
    assert_clear(tmp_path, 'no metadata.yaml$')
    (tmp_path / 'notes.txt').write_text('no bag')
    assert_clear(tmp_path / 'notes.txt', 'no bag, expected')
    for name in ('a.mcap', 'a.db3', 'a.bag'):
        for content in (b'', b'something else ' * 20):
            (tmp_path / name).write_bytes(content)
            assert_clear(tmp_path / name, 'damaged, cut short or not supported')
    assert_clear(tmp_path, 'name a file in it: a.bag, a.db3, a.mcap')
    for text in ('', '[1, 2]', '{ no yaml', 'rosbag2_bagfile_information: {version: 99}'):
        (tmp_path / 'metadata.yaml').write_text(text)
        assert_clear(tmp_path, 'damaged, cut short or not supported')
