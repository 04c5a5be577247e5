# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recordings that were cut off anywhere are read to where they end, of whatever kind they are."""

from pathlib import Path
from typing import Any

from lz4.frame import compress as lz4_compress
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

from pose_graph_ros.adapters.bags import BagError, open_bag

STRING = 'std_msgs/msg/String'
JAZZY, NOETIC = get_typestore(Stores.ROS2_JAZZY), get_typestore(Stores.ROS1_NOETIC)
CHUNK = 0.35    # of a file that its largest chunk is at most, of 1 MB where not compressed
LETTERS = np.frombuffer(b'abcdefghijklmnopqrstuvwxyz', dtype=np.uint8)


def texts() -> list[str]:
    """Return 3 MB of texts that compression leaves half of."""
    rows = np.random.default_rng(7).choice(LETTERS, (750, 4200))
    return [bytes(row).decode() for row in rows]


def write_ros1(path: Path, form: str) -> Path:
    writer = Rosbag1Writer(path)
    if form != 'none':
        writer.set_compression(Rosbag1Writer.CompressionFormat[form.upper()])
    with writer:
        topic = writer.add_connection('/text', STRING, typestore=NOETIC)
        for k, text in enumerate(texts()):
            message = NOETIC.types[STRING](text)
            writer.write(topic, 10**18 + k, NOETIC.serialize_ros1(message, STRING))
    return path


def write_rosbag2(folder: Path, form: str) -> Path:
    """Write an sqlite3 file or an mcap with chunks that are compressed, or the bag in a way."""
    writer = Writer(folder, version=9, storage_plugin=(
        StoragePlugin.SQLITE3 if form == 'sqlite3' else StoragePlugin.MCAP))
    modes = {'zstd': CompressionMode.STORAGE, 'message': CompressionMode.MESSAGE,
             'file': CompressionMode.FILE}
    if form in modes:
        writer.set_compression(modes[form], CompressionFormat.ZSTD)
    with writer:
        if form == 'lz4':
            storage: Any = writer.storage
            storage.compression, storage.compressor = 'lz4', lz4_compress
        topic = writer.add_connection('/text', STRING, typestore=JAZZY)
        for k, text in enumerate(texts()):
            message = JAZZY.types[STRING](text)
            writer.write(topic, 10**18 + k, JAZZY.serialize_cdr(message, STRING))
    (file,) = (each for each in folder.iterdir() if each.suffix != '.yaml')
    return file


def read(path: Path) -> list[tuple[int, str]]:
    """Return number and text of all messages; none if the bag is refused."""
    try:
        with open_bag(path) as bag:
            return [(each.recorded_ns - 10**18, each.decode().data)
                    for each in bag.messages(list(bag.topics))]
    except BagError:
        return []


@pytest.mark.parametrize('form', ['sqlite3', 'mcap', 'zstd', 'lz4', 'message', 'file',
                                  'ros1 none', 'ros1 bz2', 'ros1 lz4'])
def test_all_before_the_part_that_was_cut_is_read_as_it_was(form, tmp_path, caplog) -> None:
    file = write_ros1(tmp_path / 'bag.bag', form.split()[1]) if form.startswith('ros1') else (
        write_rosbag2(tmp_path / 'bag', form))
    path = file if form.startswith('ros1') else file.parent
    whole, sent = file.read_bytes(), list(enumerate(texts()))
    assert read(path) == sent
    for k, cut in enumerate(np.random.default_rng(3).integers(len(whole), size=8).tolist()):
        file.write_bytes(whole[:cut])
        if k == 4 and path != file:     # as of a recorder that was killed
            (path / 'metadata.yaml').unlink()
        elif k == 4:
            path = file = file.rename(tmp_path / 'bag.bag.active')
        caplog.clear()
        found, share = read(path), cut / len(whole)
        if form == 'sqlite3':   # pages need not be in the order of their rows
            assert set(found) <= set(sent)
            assert len(found) > (share - 0.1) * len(sent)
        else:
            assert found == sent[:len(found)]
            assert len(found) > (share - CHUNK) * len(sent)
        assert len(found) == 0 or 'what can be read of it is used' in caplog.text


def test_ros_1_is_read_without_its_first_chunk_which_defines_the_topics(tmp_path) -> None:
    path = write_ros1(tmp_path / 'bag.bag', 'bz2')
    data = bytearray(path.read_bytes())
    at = data.index(b'compression=bz2') + 1000
    data[at:at + 1000] = bytes(1000)
    path.write_bytes(data)
    found, sent = read(path), list(enumerate(texts()))
    assert found == sent[len(sent) - len(found):]
    assert len(found) > (1.0 - CHUNK) * len(sent)


@pytest.mark.parametrize('form', ['none', 'lz4', 'bz2'])
def test_the_chunk_that_ros_1_was_writing_is_read(form, tmp_path) -> None:
    """Its header gets the length only when it is full."""
    path = write_ros1(tmp_path / 'bag.bag', form)
    data = bytearray(path.read_bytes())
    at = data.rindex(b'compression=' + form.encode())
    begin = data.rindex(b'\4\0\0\0op=\5', 0, at) - 4
    content = begin + 8 + int.from_bytes(data[begin:begin + 4], 'little')
    length = int.from_bytes(data[content - 4:content], 'little')
    data[content - 4:content] = bytes(4)
    path.write_bytes(data[:content + length])
    assert read(path) == list(enumerate(texts()))


def test_what_the_recorder_had_compressed_before_it_was_killed_is_read(tmp_path) -> None:
    first = write_rosbag2(tmp_path / 'first', 'file')
    last = write_rosbag2(tmp_path / 'last', 'mcap')
    killed = tmp_path / 'killed'
    killed.mkdir()
    first.rename(killed / 'bag_0.mcap.zstd')
    (killed / 'bag_1.mcap').write_bytes(last.read_bytes()[:-100])
    assert len(read(killed)) == 1500
