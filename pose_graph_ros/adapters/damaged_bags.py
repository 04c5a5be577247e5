# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What can still be read of a damaged .mcap or .db3 file, as after the recorder was killed.

An mcap file is walked through from its start, as its index is at the end. Where a record makes no
sense, the next chunk that does is looked for; a chunk whose content is damaged is left out. The
rows of an sqlite3 file are read in their order; those on damaged pages are left out.
"""

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
import heapq
import importlib
import logging
import mmap
from pathlib import Path
import re
import shutil
import sqlite3
import struct
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2 import metadata, storage_mcap
import yaml

logger = logging.getLogger(__name__)

_MAGIC = b'\x89MCAP0\r\n'
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _FOOTER, _LAST = 3, 4, 5, 6, 2, 15
_CHUNK_HEAD = struct.Struct('<QQQII')   # first and last stamp, size, checksum, length of a name
_MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, number, when recorded, when published
_RECORD = re.compile(rb'[\x03-\x05].{3}\0\0\0\0\0', re.DOTALL)  # in a chunk
_LOOSE = 1000   # messages outside of chunks that are read together
_ROWS = 1000    # rows of a table that are read together
MOST_PADDED = 1000  # length of a file by its head, in lengths that it has, that may be right
_FAR = 10**6    # a row whose number is so much larger than the one before has a wrong number
_INVALID = (struct.error, ValueError, IndexError, EOFError)
_FORMATS = {'ros2msg': MessageDefinitionFormat.MSG, 'ros2idl': MessageDefinitionFormat.IDL,
            'omgidl': MessageDefinitionFormat.IDL}


class _Message(NamedTuple):
    recorded_ns: int
    channel: int
    data: bytes


class Salvaged:
    """What a damaged file still has; used like a reader of rosbags."""

    complete = False
    """Whether the end is there."""

    def __init__(self) -> None:
        self.connections: list[Connection] = []
        self.n_damaged = 0
        """Number of places that were left out."""
        self.start_time, self.end_time = 2**63 - 1, 0
        self._count: Counter[int] = Counter()

    def _add(self, message: _Message) -> None:
        self._count[message.channel] += 1
        self.start_time = min(self.start_time, message.recorded_ns)
        self.end_time = max(self.end_time, message.recorded_ns + 1)

    def messages(
        self, connections: Collection[Connection], start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """
        Iterate over messages, in the order in which they were recorded.

        Parameters
        ----------
        connections : collection of Connection
        start, stop : int, optional, stamps of recording from which on and before which [ns]

        """
        known = {connection.id: connection for connection in connections}
        for recorded_ns, channel, data in self._in_order():
            if channel in known and (start is None or recorded_ns >= start) and (
                    stop is None or recorded_ns < stop):
                yield known[channel], recorded_ns, data

    def _in_order(self) -> Iterator[_Message]:
        raise NotImplementedError

    def close(self) -> None:
        """Close the file."""


class SalvagedMcap(Salvaged):
    """An mcap file, cut short or with damaged bytes."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        with path.open('rb') as file:
            self._file = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._size = len(self._file)
        self._blocks: list[tuple[int, int]] = []
        """Least stamp of a chunk, or of messages outside of one, and where it begins."""
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, tuple[int, str, str, bytes]] = {}
        self.complete = self._walk()
        for number, (schema, topic, encoding, more) in self._channels.items():
            name, kind, text = self._schemas.get(schema, ('', '', ''))
            quality: list[Any] = []
            with suppress(Exception):   # the parser can raise anything
                quality = storage_mcap.get_qos(more)
            self.connections.append(Connection(
                number, topic, name, MessageDefinition(
                    _FORMATS.get(kind, MessageDefinitionFormat.NONE), text),
                '', self._count[number], ConnectionExtRosbag2(encoding, quality), self))

    def _walk(self) -> bool:
        """Find all that can be read; return whether the file has an end."""
        at, n_loose = len(_MAGIC), 0
        while at + 9 <= self._size:
            kind, length = self._file[at], int.from_bytes(self._file[at + 1:at + 9], 'little')
            end = at + 9 + length
            if kind == _CHUNK and end > self._size:
                self._take(at)   # what is there of it
                return False
            if not 0 < kind <= _LAST or end > self._size:
                self.n_damaged += 1
                if (at := self._next_chunk(at + 1)) < 0:
                    return False
                continue
            if kind == _FOOTER:
                return True
            if kind == _MESSAGE:
                n_loose += 1
            if kind == _CHUNK or (kind == _MESSAGE and n_loose % _LOOSE == 1):
                self._take(at)
            elif kind in {_SCHEMA, _CHANNEL}:
                self._define(kind, self._file[at + 9:end])
            at = end
        return False

    def _take(self, at: int) -> None:
        """Count what is in a chunk, or in the messages from here on."""
        found = list(self._read(at, define=True))
        for message in found:
            self._add(message)
        if len(found) > 0:
            self._blocks.append((min(found).recorded_ns, at))
        elif self._file[at] == _CHUNK:
            self.n_damaged += 1

    def _next_chunk(self, at: int) -> int:
        """Return where the next chunk begins whose numbers fit together, or -1."""
        for match in re.finditer(rb'\x06', self._file[at:]):
            head = at + match.start()
            with suppress(*_INVALID):
                first, last, _, _, n = _CHUNK_HEAD.unpack_from(self._file, head + 9)
                length = int.from_bytes(self._file[head + 1:head + 9], 'little')
                inside = int.from_bytes(self._file[head + 41 + n:head + 49 + n], 'little')
                if first <= last and n <= 4 and length == 40 + n + inside:
                    return head
        return -1

    def _read(self, at: int, *, define: bool = False) -> Iterator[_Message]:
        """Iterate over the messages of a block; none if its content is damaged."""
        if self._file[at] == _CHUNK:
            with suppress(Exception):   # decompression can raise anything
                first, last, *_ = _CHUNK_HEAD.unpack_from(self._file, at + 9)
                for message in self._records(self._content(at), 0, define):
                    if first <= message.recorded_ns <= last:
                        yield message
        else:
            yield from self._records(self._file, at, define, most=_LOOSE)

    def _content(self, at: int) -> bytes:
        end = at + 9 + int.from_bytes(self._file[at + 1:at + 9], 'little')
        _, _, size, checksum, n = _CHUNK_HEAD.unpack_from(self._file, at + 9)
        name, data = self._file[at + 41:at + 41 + n].decode(), self._file[at + 49 + n:end]
        if end > self._size:
            return _begin_of(name, data)
        content: bytes = storage_mcap.decompress(data, name, size, checksum)
        return content

    def _records(
        self, data: bytes | mmap.mmap, at: int, define: bool, most: int | None = None,
    ) -> Iterator[_Message]:
        n, in_chunk = 0, most is None
        while at + 9 <= len(data) and n != most:
            kind, end = data[at], at + 9 + int.from_bytes(data[at + 1:at + 9], 'little')
            if in_chunk and (kind not in {_SCHEMA, _CHANNEL, _MESSAGE} or end > len(data)):
                # no record is as long as the seven bytes could say
                following = _RECORD.search(data, at + 1)
                if following is None:
                    return
                at = following.start()
                continue
            if end > len(data) or not 0 < kind <= _LAST or (not in_chunk and kind == _CHUNK):
                return
            if kind == _MESSAGE and end >= at + 9 + _MESSAGE_HEAD.size:
                channel, _, recorded_ns, _ = _MESSAGE_HEAD.unpack_from(data, at + 9)
                yield _Message(recorded_ns, channel, data[at + 9 + _MESSAGE_HEAD.size:end])
                n += 1
            elif kind in {_SCHEMA, _CHANNEL} and define:
                self._define(kind, data[at + 9:end])
            at = end

    def _define(self, kind: int, data: bytes) -> None:
        try:
            number = int.from_bytes(data[:2], 'little')
            if kind == _SCHEMA:
                name, at = _text(data, 2)
                encoding, at = _text(data, at)
                self._schemas.setdefault(number, (name, encoding, _text(data, at)[0]))
            else:
                topic, at = _text(data, 4)
                encoding, at = _text(data, at)
                self._channels.setdefault(number, (
                    int.from_bytes(data[2:4], 'little'), topic, encoding, data[at + 4:]))
        except _INVALID:
            self.n_damaged += 1

    def _in_order(self) -> Iterator[_Message]:
        # a chunk may begin before the one that was written before it ends
        waiting: list[_Message] = []
        for first, at in sorted(self._blocks):
            while len(waiting) > 0 and waiting[0].recorded_ns < first:
                yield heapq.heappop(waiting)
            for message in self._read(at):
                heapq.heappush(waiting, message)
        while len(waiting) > 0:
            yield heapq.heappop(waiting)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = at + 4 + int.from_bytes(data[at:at + 4], 'little')
    if end > len(data):
        raise ValueError('cut short')
    return data[at + 4:end].decode(), end


def _begin_of(name: str, data: bytes) -> bytes:
    """Return what a part of compressed data holds."""
    if name == 'zstd':
        return bytes(storage_mcap.zstd.ZstdDecompressor().decompress(data))
    if name == 'lz4':
        return bytes(importlib.import_module('lz4.frame').LZ4FrameDecompressor().decompress(data))
    return data


class SalvagedSqlite(Salvaged):
    """An sqlite3 file, cut short, with damaged bytes, or with a journal that was not applied."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._folder = TemporaryDirectory()
        copy = Path(self._folder.name, path.name)
        try:
            # SQLite writes to the file where it applies what a recorder has left beside it
            for each in (path, *(path.with_name(path.name + end) for end in ('-wal', '-journal'))):
                if each.exists():
                    shutil.copyfile(each, copy.with_name(each.name))
            _pad(copy)
            self._database = sqlite3.connect(copy)
            self._database.text_factory = lambda text: text.decode(errors='replace')
            topics = self._database.execute('SELECT * FROM topics')
            names = [column[0] for column in topics.description]
            rows = [dict(zip(names, row, strict=True)) for row in topics.fetchall()]
            for message in self._in_order():
                self._add(message)
        except BaseException:
            self._folder.cleanup()
            raise
        self.complete = self.n_damaged == 0
        definitions: dict[str, tuple[str, str]] = {}
        with suppress(sqlite3.Error):
            definitions = {name: (kind, text) for name, kind, text in self._database.execute(
                'SELECT topic_type, encoding, encoded_message_definition '
                'FROM message_definitions')}
        for row in rows:
            kind, text = definitions.get(row['type'], ('', ''))
            quality: list[Any] = []
            with suppress(Exception):   # the parser can raise anything
                quality = metadata.parse_qos(row.get('offered_qos_profiles', ''))
            self.connections.append(Connection(
                row['id'], row['name'], row['type'], MessageDefinition(
                    _FORMATS.get(kind, MessageDefinitionFormat.NONE), text),
                '', self._count[row['id']],
                ConnectionExtRosbag2(row['serialization_format'], quality), self))

    def _in_order(self) -> Iterator[_Message]:
        last, step = 0, 1
        self.n_damaged = 0
        while step < 2**40:
            try:
                with closing(self._database.execute(
                        'SELECT id, timestamp, topic_id, data FROM messages WHERE id >= ? '
                        'ORDER BY id LIMIT ?', (last + 1, _ROWS))) as rows:
                    n = 0
                    for number, recorded_ns, topic, data in rows:
                        if number > last + _FAR:
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
        if size < length <= MOST_PADDED * max(size, 1):
            file.truncate(length)   # the rest takes no room on the disk


class SalvagedFiles(Salvaged):
    """Several files of one recording."""

    def __init__(self, files: Collection[Path]) -> None:
        super().__init__()
        self._files: list[Salvaged] = []
        for path in files:
            with suppress(sqlite3.Error, *_INVALID):
                self._files.append(
                    (SalvagedSqlite if path.suffix == '.db3' else SalvagedMcap)(path))
        found: dict[tuple[str, str], Connection] = {}
        self.complete = len(self._files) == len(files)
        for file in self._files:
            self.complete &= file.complete
            self.n_damaged += file.n_damaged
            self.start_time = min(self.start_time, file.start_time)
            self.end_time = max(self.end_time, file.end_time)
            for connection in file.connections:
                key = connection.topic, connection.msgtype
                before = found.get(key, connection._replace(id=len(found), msgcount=0, owner=self))
                found[key] = before._replace(msgcount=before.msgcount + connection.msgcount)
        self.connections = list(found.values())

    def messages(
        self, connections: Collection[Connection], start: int | None = None,
        stop: int | None = None,
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """
        Iterate over the messages of all files, in the order in which they were recorded.

        Parameters
        ----------
        connections : collection of Connection
        start, stop : int, optional, stamps of recording from which on and before which [ns]

        """
        known = {(each.topic, each.msgtype): each for each in connections}

        def part(file: Salvaged) -> Iterator[tuple[Connection, int, bytes]]:
            chosen = [each for each in file.connections if (each.topic, each.msgtype) in known]
            for each, recorded_ns, data in file.messages(chosen, start, stop):
                yield known[each.topic, each.msgtype], recorded_ns, data

        return heapq.merge(*map(part, self._files), key=lambda message: message[1])

    def close(self) -> None:
        """Close the files."""
        for file in self._files:
            file.close()


def salvage(path: Path, reason: str) -> Salvaged | None:
    """
    Return what can be read of an .mcap or .db3 file or a folder of them; None if nothing can.

    A warning says how much time is missing, as far as the metadata beside the files tell.
    """
    about: Any = {}
    with suppress(OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        text = ((path if path.is_dir() else path.parent) / 'metadata.yaml').read_text('utf-8')
        about = dict(yaml.safe_load(text)['rosbag2_bagfile_information'])
    if about.get('compression_format'):
        return None     # what rosbag2 itself has compressed is not unpacked here
    listed = [Path(str(name)).name for name in about.get('relative_file_paths') or ()]
    if path.is_dir():
        files = [path / name for name in listed if (path / name).is_file()] or sorted(
            each for each in path.iterdir() if each.suffix in {'.mcap', '.db3'})
    else:
        files = [path]
    files = [each for each in files if each.suffix in {'.mcap', '.db3'}]
    found = SalvagedFiles(files)
    if len(found.connections) == 0 or found.end_time == 0:
        found.close()
        return None
    read_s = 1e-9 * (found.end_time - found.start_time)
    missing = 'how much is missing is not known'
    if path.is_dir() or listed == [path.name]:
        with suppress(KeyError, TypeError, ValueError):
            end_ns = (int(about['starting_time']['nanoseconds_since_epoch'])
                      + int(about['duration']['nanoseconds']))
            missing_s = max(1e-9 * (end_ns + 1 - found.end_time), 0.0)
            missing = f'{missing_s:.1f} s at the end are missing'
    if found.complete:
        missing = 'its end is there'
    logger.warning(
        '%s: %s; what can be read of it is used: %d messages in %.1f s, %d damaged parts are left '
        'out, %s', path, reason, sum(each.msgcount for each in found.connections), read_s,
        found.n_damaged, missing)
    return found
