# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Copy what can still be read of damaged .mcap or .db3 files, as after the recorder was killed.

An mcap file is walked through from its start, as its index is at the end; where a record makes no
sense, the next one that does is looked for. The rows of an sqlite3 file are read in their order;
those on damaged pages are left out. The copy is a whole bag, which is read like any other.
"""

from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from io import BytesIO
import logging
import mmap
from pathlib import Path
import re
import shutil
import sqlite3
import struct
from tempfile import TemporaryDirectory
from typing import Any

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import metadata, storage_mcap, StoragePlugin, Writer
import yaml

logger = logging.getLogger(__name__)

NO_HASH = 'RIHS01_' + 64 * '0'  # of a type whose definition is unknown
# Kinds of records of an mcap file, and what they begin with.
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = range(2, 7)
_ANY, _IN_CHUNK = range(1, 16), range(_SCHEMA, _CHUNK)
_CHUNK_HEAD = struct.Struct('<QQQII')   # first and last stamp, size, checksum, length of a name
_MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, number, when recorded, when published
# Kind and length of a record that may have content: no message has 16 MB, and no chunk 4 GB.
_RECORD = re.compile(rb'[\x03-\x05].{3}\0{5}|\x06.{4}\0{4}', re.DOTALL)
_DECOMPRESSORS = {'zstd': storage_mcap.zstd.ZstdDecompressor, 'lz4': LZ4FrameDecompressor}
Connect = Callable[..., Connection]
"""Return the connection of the copy, by its topic, type, encoding, definition and quality."""
_Message = tuple[Connection, int, bytes]    # and when it was recorded [ns]


class _Mcap:
    """An mcap file, cut short or with damaged bytes."""

    def __init__(self, path: Path, connect: Connect) -> None:
        self.complete, self.n_damaged, self._connect = False, 0, connect
        self._types: dict[int, tuple[str, str]] = {}    # names and definitions
        self._topics: dict[int, Connection] = {}
        with path.open('rb') as file:
            self._file = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.close = self._file.close

    def messages(self) -> Iterator[_Message]:
        """Yield all messages."""
        return self._messages(self._file, 8, _ANY)

    def _messages(self, data: bytes | mmap.mmap, at: int, kinds: range) -> Iterator[_Message]:
        """Yield the messages; what defines them may stand behind them, where the index is."""
        blocks = []
        for kind, begin, end in self._records(data, at, kinds):
            self.complete |= kind == _FOOTER
            if kind in {_CHUNK, _MESSAGE}:
                blocks.append((kind, begin, end))
            else:
                self._define(kind, data[begin:end])
        for kind, begin, end in blocks:
            yield from (self._in_chunk if kind == _CHUNK else self._message)(data[begin:end])

    def _records(self, data: bytes | mmap.mmap, at: int,
                 kinds: range) -> Iterator[tuple[int, int, int]]:
        """Yield kind, begin and end of the content of each record that makes sense."""
        while at + 9 <= len(data):
            kind, end = data[at], at + 9 + int.from_bytes(data[at + 1:at + 9], 'little')
            if kind in kinds and (end <= len(data) or kind == _CHUNK):
                yield kind, at + 9, min(end, len(data))     # also what is left of the last chunk
                at = end
                continue
            self.n_damaged += 1
            if (following := _RECORD.search(data, at + 1)) is None:
                return
            at = following.start()

    def _in_chunk(self, chunk: bytes) -> Iterator[_Message]:
        """Yield the messages of a chunk; none if its content cannot be decompressed."""
        try:
            first, last, size, checksum, n = _CHUNK_HEAD.unpack_from(chunk)
            name, data = chunk[32:32 + n].decode(), chunk[40 + n:]
            is_whole = len(data) >= int.from_bytes(chunk[32 + n:40 + n], 'little')
            content = (storage_mcap.decompress(data, name, size, checksum) if is_whole else
                       bytes(_DECOMPRESSORS[name]().decompress(data)) if name else data)
        except Exception:   # decompression can raise anything
            self.n_damaged += 1
            return
        yield from (message for message in self._messages(content, 0, _IN_CHUNK)
                    if first <= message[1] <= last)

    def _define(self, kind: int, data: bytes) -> None:
        """Note what a record of a schema or a channel says, unless another one said it."""
        with suppress(Exception):   # the parsers can raise anything on a damaged one
            stream, number = BytesIO(data[2:]), int.from_bytes(data[:2], 'little')
            if kind == _SCHEMA:
                name, _, text = (storage_mcap.read_string(stream) for _ in range(3))
                self._types.setdefault(number, (name, text))
            elif kind == _CHANNEL and number not in self._topics:
                of_type, text = self._types[int.from_bytes(stream.read(2), 'little')]
                name, form = (storage_mcap.read_string(stream) for _ in range(2))
                self._topics[number] = self._connect(
                    name, of_type, form, text,
                    storage_mcap.get_qos(storage_mcap.read_bytes(stream)))

    def _message(self, data: bytes) -> Iterator[_Message]:
        """Yield the message in a record, if it is of a known topic."""
        if len(data) >= _MESSAGE_HEAD.size:
            channel, _, recorded_ns, _ = _MESSAGE_HEAD.unpack_from(data)
            if channel in self._topics:
                yield self._topics[channel], recorded_ns, data[_MESSAGE_HEAD.size:]


class _Sqlite:
    """An sqlite3 file, cut short, with damaged bytes, or with a journal that was not applied."""

    def __init__(self, path: Path, connect: Connect) -> None:
        self.complete, self.n_damaged, self._connect = False, 0, connect
        self._folder = TemporaryDirectory()
        copy = Path(self._folder.name, path.name)
        # SQLite writes to the file where it applies what a recorder has left beside it
        for end in ('', '-wal', '-journal'):
            with suppress(FileNotFoundError):
                shutil.copyfile(path.with_name(path.name + end), copy.with_name(copy.name + end))
        # make a file that was cut short as long as its head says, else SQLite does not open it
        with copy.open('r+b') as file:
            head = file.read(32)
            page = int.from_bytes(head[16:18], 'big')
            length = int.from_bytes(head[28:32], 'big') * (65536 if page == 1 else page)
            size = copy.stat().st_size
            if size < length <= 1000 * max(size, 1):    # else the head is wrong
                file.truncate(length)   # the rest takes no room on the disk
        self._database = sqlite3.connect(copy)
        self._database.text_factory = lambda text: text.decode(errors='replace')

    def close(self) -> None:
        """Close the file, and remove the copy."""
        self._database.close()
        self._folder.cleanup()

    def messages(self) -> Iterator[_Message]:
        """Yield all messages; where rows cannot be read, the next ones are looked for."""
        select, definitions, topics = self._database.execute, dict[str, str](), {}
        with suppress(sqlite3.Error):   # older ones have none
            definitions = dict(select(
                'SELECT topic_type, encoded_message_definition FROM message_definitions'))
        for number, name, of_type, form, profiles in select(
                'SELECT id, name, type, serialization_format, offered_qos_profiles FROM topics'):
            qualities: list[Qos] = []
            with suppress(Exception):   # the parser can raise anything
                qualities = metadata.parse_qos(profiles)
            topics[number] = self._connect(
                name, of_type, form, definitions.get(of_type, ''), qualities)
        last, step = 0, 1
        while step < 2**40:
            try:
                with closing(select('SELECT id, timestamp, topic_id, data FROM messages '
                                    'WHERE id >= ? ORDER BY id LIMIT 1000', (last + 1,))) as rows:
                    n = 0
                    for number, recorded_ns, topic, data in rows:
                        if number > last + 10**6:   # it is wrong
                            continue
                        if number <= last:
                            raise sqlite3.DatabaseError('rows are not in their order')
                        n, step, last = n + 1, 1, number
                        if topic in topics and type(recorded_ns) is int and type(data) is bytes:
                            yield topics[topic], recorded_ns, data
                    if n == 0:
                        break
            except (sqlite3.Error, OverflowError):
                self.n_damaged += step == 1
                last, step = last + step, 2 * step
        self.complete = self.n_damaged == 0


def repair(path: Path, reason: str, copy: Path) -> bool:
    """
    Write what can be read of an .mcap or .db3 file or a folder of them as a bag, if anything can.

    A warning says how much time is missing, as far as the metadata beside the files tell.
    """
    about: Any = {}
    with suppress(OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        text = ((path if path.is_dir() else path.parent) / 'metadata.yaml').read_text('utf-8')
        about = dict(yaml.safe_load(text)['rosbag2_bagfile_information'])
    if about.get('compression_format'):
        return False    # what rosbag2 itself has compressed is not unpacked here
    listed = [Path(str(name)).name for name in about.get('relative_file_paths') or ()]
    files = [path] if path.is_file() else [
        path / name for name in listed if (path / name).is_file()] or sorted(path.iterdir())
    files = [each for each in files if each.suffix in {'.mcap', '.db3'}]
    found: list[_Mcap | _Sqlite] = []
    connections: dict[tuple[str, str], Connection] = {}

    def connect(topic: str, of_type: str, encoding: str, definition: str,
                qualities: list[Qos]) -> Connection:
        if (topic, of_type) not in connections:
            connections[topic, of_type] = writer.add_connection(
                topic, of_type, msgdef=definition, rihs01=NO_HASH, serialization_format=encoding,
                offered_qos_profiles=qualities)
        return connections[topic, of_type]

    with Writer(copy, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for file in files:
            with suppress(sqlite3.Error, ValueError), closing(
                    (_Sqlite if file.suffix == '.db3' else _Mcap)(file, connect)) as damaged:
                found.append(damaged)
                for connection, recorded_ns, data in damaged.messages():
                    if 0 <= recorded_ns < 2**63:
                        writer.write(connection, recorded_ns, data)
    n, end_ns = sum(writer.counts.values()), writer.max_timestamp + 1
    if n == 0:
        return False
    missing = 'how much is missing is not known'
    if path.is_dir() or listed == [path.name]:
        with suppress(KeyError, TypeError, ValueError):
            wanted_ns = (int(about['starting_time']['nanoseconds_since_epoch'])
                         + int(about['duration']['nanoseconds']))
            missing = f'{max(1e-9 * (wanted_ns + 1 - end_ns), 0.0):.1f} s at the end are missing'
    if len(found) == len(files) and all(each.complete for each in found):
        missing = 'its end is there'
    logger.warning('%s: %s; what can be read of it is used: '
                   '%d messages in %.1f s, %d damaged parts are left out, %s', path, reason, n,
                   1e-9 * (end_ns - writer.min_timestamp), sum(each.n_damaged for each in found),
                   missing)
    return True
