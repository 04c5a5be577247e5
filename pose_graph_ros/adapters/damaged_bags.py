# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What can still be read of a damaged .mcap or .db3 file, as after the recorder was killed.

An mcap file is walked through from its start, as its index is at the end; where a record makes no
sense, the next one that does is looked for. The rows of an sqlite3 file are read in their order;
those on damaged pages are left out.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from functools import partial
import heapq
from io import BytesIO
import logging
import mmap
from pathlib import Path
import re
import shutil
import sqlite3
import struct
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    Qos,
)
from rosbags.rosbag2 import metadata, ReaderError, storage_mcap
import yaml

from pose_graph_ros.core.quantities import StampNs

logger = logging.getLogger(__name__)

# Kinds of records of an mcap file, and what they begin with.
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = range(2, 7)
_ANY, _IN_CHUNK = range(1, 16), range(_SCHEMA, _CHUNK)
_CHUNK_HEAD = struct.Struct('<QQQII')   # first and last stamp, size, checksum, length of a name
_MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, number, when recorded, when published
# Kind and length of a record that may have content: no message has 16 MB, and no chunk 4 GB.
_RECORD = re.compile(rb'[\x03-\x05].{3}\0{5}|\x06.{4}\0{4}', re.DOTALL)
_INVALID = (struct.error, ValueError, IndexError, EOFError)
_NO_SCHEMA = storage_mcap.Schema(0, '', '', '')


class _Message(NamedTuple):
    recorded_ns: int
    topic: int  # its number in the file
    data: bytes


class Salvaged(ABC):
    """What a damaged file still has; used like a reader of rosbags."""

    complete = False  # whether the end is there
    n_damaged = 0  # number of places that were left out

    def __init__(self) -> None:
        self.connections: list[Connection] = []
        self.start_time, self.end_time = 2**63 - 1, 0

    def _count(self) -> Counter[int]:
        """Read all messages for the first time; return their numbers by topic."""
        count: Counter[int] = Counter()
        for recorded_ns, topic, _ in self._in_order():
            count[topic] += 1
            self.start_time = min(self.start_time, recorded_ns)
            self.end_time = max(self.end_time, recorded_ns + 1)
        return count

    def _connect(
        self, number: int, topic: str, serialization: str, schema: storage_mcap.Schema,
        *, qualities: Callable[[], list[Qos]], count: int,
    ) -> None:
        definition, found = storage_mcap.get_msgdef(None), list[Qos]()
        with suppress(Exception):   # the parsers can raise anything
            definition = storage_mcap.get_msgdef(schema)
        with suppress(Exception):
            found = qualities()
        self.connections.append(Connection(
            number, topic, schema.name, definition, '', count,
            ConnectionExtRosbag2(serialization, found), self))

    def messages(
        self, connections: Collection[Connection], start: StampNs | None = None,
        stop: StampNs | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Iterate over messages, in the order in which they were recorded."""
        known = {connection.id: connection for connection in connections}
        for recorded_ns, topic, data in self._in_order():
            if topic in known and (start is None or recorded_ns >= start) and (
                    stop is None or recorded_ns < stop):
                yield known[topic], recorded_ns, data

    @abstractmethod
    def _in_order(self) -> Iterator[_Message]:
        """Iterate over all messages, in the order in which they were recorded."""

    @abstractmethod
    def close(self) -> None:
        """Close the file."""


class SalvagedMcap(Salvaged):
    """An mcap file, cut short or with damaged bytes."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        with path.open('rb') as file:
            self._file = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        # least stamp of a chunk, or of a message outside of one, and where that begins and ends
        self._blocks: list[tuple[int, int, int, int]] = []
        self._schemas: dict[int, storage_mcap.Schema] = {}
        self._channels: dict[int, tuple[int, str, str, bytes]] = {}
        for kind, begin, end in self._records(self._file, 8, _ANY):
            self.complete |= kind == _FOOTER
            if kind in {_SCHEMA, _CHANNEL}:
                self._define(kind, self._file[begin:end])
            elif kind in {_CHUNK, _MESSAGE}:
                with suppress(*_INVALID):
                    first = (_CHUNK_HEAD.unpack_from(self._file, begin)[0] if kind == _CHUNK
                             else _MESSAGE_HEAD.unpack_from(self._file, begin)[2])
                    self._blocks.append((first, kind, begin, end))
        count = self._count()
        for number, (schema, topic, serialization, more) in self._channels.items():
            self._connect(
                number, topic, serialization, self._schemas.get(schema, _NO_SCHEMA),
                qualities=partial(storage_mcap.get_qos, more), count=count[number])

    def _records(
        self, data: bytes | mmap.mmap, at: int, kinds: range,
    ) -> Iterator[tuple[int, int, int]]:
        """Yield kind, begin and end of the content of each record that makes sense."""
        while at + 9 <= len(data):
            kind, end = data[at], at + 9 + int.from_bytes(data[at + 1:at + 9], 'little')
            if kind in kinds and (end <= len(data) or kind == _CHUNK):
                yield kind, at + 9, min(end, len(data))     # also what is left of the last chunk
                at = end
                continue
            self.n_damaged += 1
            following = _RECORD.search(data, at + 1)
            if following is None:
                return
            at = following.start()

    def _in_chunk(self, begin: int, end: int) -> Iterator[_Message]:
        """Iterate over the messages of a chunk; none if its content cannot be decompressed."""
        try:
            first, last, size, checksum, n = _CHUNK_HEAD.unpack_from(self._file, begin)
            name, at = self._file[begin + 32:begin + 32 + n].decode(), begin + 40 + n
            data = self._file[at:end]
            if len(data) < int.from_bytes(self._file[at - 8:at], 'little'):
                content = _begin_of(name, data)
            else:
                content = storage_mcap.decompress(data, name, size, checksum)
        except Exception:   # decompression can raise anything
            self.n_damaged += 1
            return
        for kind, start, stop in self._records(content, 0, _IN_CHUNK):
            if kind != _MESSAGE:
                self._define(kind, content[start:stop])
            elif (message := _message(content[start:stop])) is not None and (
                    first <= message.recorded_ns <= last):
                yield message

    def _define(self, kind: int, data: bytes) -> None:
        """Note what a record of a schema or a channel says, unless another one said it."""
        with suppress(ReaderError, struct.error, ValueError):   # a damaged one
            stream, number = BytesIO(data[2:]), int.from_bytes(data[:2], 'little')
            if kind == _SCHEMA:
                name, form, text = (storage_mcap.read_string(stream) for _ in range(3))
                self._schemas.setdefault(number, storage_mcap.Schema(number, name, form, text))
            else:
                schema = int.from_bytes(stream.read(2), 'little')
                topic, form = (storage_mcap.read_string(stream) for _ in range(2))
                self._channels.setdefault(
                    number, (schema, topic, form, storage_mcap.read_bytes(stream)))

    def _in_order(self) -> Iterator[_Message]:
        # a chunk may begin before the one that was written before it ends
        waiting: list[_Message] = []
        for first, kind, begin, end in sorted(self._blocks):
            while len(waiting) > 0 and waiting[0].recorded_ns < first:
                yield heapq.heappop(waiting)
            messages = self._in_chunk(begin, end) if kind == _CHUNK else filter(
                None, [_message(self._file[begin:end])])
            for message in messages:
                heapq.heappush(waiting, message)
        while len(waiting) > 0:
            yield heapq.heappop(waiting)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _message(data: bytes) -> _Message | None:
    if len(data) < _MESSAGE_HEAD.size:
        return None
    channel, _, recorded_ns, _ = _MESSAGE_HEAD.unpack_from(data)
    return _Message(recorded_ns, channel, data[_MESSAGE_HEAD.size:])


def _begin_of(name: str, data: bytes) -> bytes:
    """Return what a part of compressed data holds."""
    if name == 'zstd':
        return bytes(storage_mcap.zstd.ZstdDecompressor().decompress(data))
    return bytes(LZ4FrameDecompressor().decompress(data)) if name == 'lz4' else data


class SalvagedSqlite(Salvaged):
    """An sqlite3 file, cut short, with damaged bytes, or with a journal that was not applied."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._folder = TemporaryDirectory()
        copy = Path(self._folder.name, path.name)
        # SQLite writes to the file where it applies what a recorder has left beside it
        for end in ('', '-wal', '-journal'):
            with suppress(FileNotFoundError):
                shutil.copyfile(path.with_name(path.name + end), copy.with_name(copy.name + end))
        _pad(copy)
        self._database = sqlite3.connect(copy)
        self._database.row_factory = sqlite3.Row
        self._database.text_factory = lambda text: text.decode(errors='replace')
        topics = [dict(row) for row in self._database.execute('SELECT * FROM topics')]
        count = self._count()
        self.complete = self.n_damaged == 0
        schemas: dict[str, storage_mcap.Schema] = {}
        with suppress(sqlite3.Error):
            schemas = {name: storage_mcap.Schema(0, name, form, text) for name, form, text in (
                self._database.execute('SELECT topic_type, encoding, encoded_message_definition '
                                       'FROM message_definitions'))}
        for topic in topics:
            self._connect(
                topic['id'], topic['name'], topic['serialization_format'],
                schemas.get(topic['type'], _NO_SCHEMA._replace(name=topic['type'])),
                qualities=partial(metadata.parse_qos, topic.get('offered_qos_profiles', '')),
                count=count[topic['id']])

    def _in_order(self) -> Iterator[_Message]:
        last, step = 0, 1
        self.n_damaged = 0
        while step < 2**40:
            try:
                with closing(self._database.execute(
                        'SELECT id, timestamp, topic_id, data FROM messages WHERE id >= ? '
                        'ORDER BY id LIMIT 1000', (last + 1,))) as rows:
                    n = 0
                    for number, recorded_ns, topic, data in rows:
                        if number > last + 10**6:   # it is wrong
                            continue
                        if number <= last:
                            raise sqlite3.DatabaseError('rows are not in their order')
                        n, step, last = n + 1, 1, number
                        if all(isinstance(each, int) for each in (recorded_ns, topic)) and (
                                isinstance(data, bytes)):
                            yield _Message(recorded_ns, topic, data)
                    if n == 0:
                        return
            except (sqlite3.Error, OverflowError):
                self.n_damaged += step == 1
                last, step = last + step, 2 * step

    def close(self) -> None:
        """Close the file, and remove the copy."""
        self._database.close()
        self._folder.cleanup()


def _pad(path: Path) -> None:
    """Make a file that was cut short as long as its head says, else SQLite does not open it."""
    with path.open('r+b') as file:
        head = file.read(32)
        page = int.from_bytes(head[16:18], 'big')
        length = int.from_bytes(head[28:32], 'big') * (65536 if page == 1 else page)
        size = path.stat().st_size
        if size < length <= 1000 * max(size, 1):    # else the head is wrong
            file.truncate(length)   # the rest takes no room on the disk


def salvage(path: Path, reason: str) -> list[Salvaged]:
    """
    Return what can be read of an .mcap or .db3 file or a folder of them, file by file.

    A warning says how much time is missing, as far as the metadata beside the files tell.
    """
    about: Any = {}
    with suppress(OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        text = ((path if path.is_dir() else path.parent) / 'metadata.yaml').read_text('utf-8')
        about = dict(yaml.safe_load(text)['rosbag2_bagfile_information'])
    if about.get('compression_format'):
        return []   # what rosbag2 itself has compressed is not unpacked here
    listed = [Path(str(name)).name for name in about.get('relative_file_paths') or ()]
    files = [path]
    if path.is_dir():
        files = [path / name for name in listed if (path / name).is_file()] or sorted(
            path.iterdir())
    files = [each for each in files if each.suffix in {'.mcap', '.db3'}]
    found: list[Salvaged] = []
    for each in files:
        with suppress(sqlite3.Error, *_INVALID):
            found.append((SalvagedSqlite if each.suffix == '.db3' else SalvagedMcap)(each))
    end_ns = max((each.end_time for each in found), default=0)
    if end_ns == 0 or not any(each.connections for each in found):
        for file in found:
            file.close()
        return []
    missing = 'how much is missing is not known'
    if path.is_dir() or listed == [path.name]:
        with suppress(KeyError, TypeError, ValueError):
            wanted_ns = (int(about['starting_time']['nanoseconds_since_epoch'])
                         + int(about['duration']['nanoseconds']))
            missing_s = max(1e-9 * (wanted_ns + 1 - end_ns), 0.0)
            missing = f'{missing_s:.1f} s at the end are missing'
    if len(found) == len(files) and all(each.complete for each in found):
        missing = 'its end is there'
    logger.warning(
        '%s: %s; what can be read of it is used: %d messages in %.1f s, %d damaged parts are left '
        'out, %s', path, reason, sum(one.msgcount for each in found for one in each.connections),
        1e-9 * (end_ns - min(each.start_time for each in found)),
        sum(each.n_damaged for each in found), missing)
    return found
