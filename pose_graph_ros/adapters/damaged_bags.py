# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Copy what can still be read of damaged bags, as after the recorder was killed.

An mcap file and a bag of ROS 1 are walked through from their start, as the index is at the end;
where a record makes no sense, the next one that does is looked for. The rows of an sqlite3 file
are read in their order; those on damaged pages are left out. The copy is a whole bag, which is
read like any other.
"""

from bz2 import BZ2Decompressor
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from io import BytesIO
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
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import metadata, storage_mcap, StoragePlugin, Writer
from rosbags.typesys.msg import normalize_msgtype
import yaml

zstd = storage_mcap.zstd

ROS1_SUFFIXES = '.bag', '.active'     # `record` adds the second one until it has ended
LONGEST_CHUNK = 2**30   # as much is made of one at most [bytes]
MISSING_NS = 100_000_000  # a bag that ends less than this too early counts as whole [ns]
NO_HASH = 'RIHS01_' + 64 * '0'  # of a type whose definition is unknown
# Kinds of records of an mcap file, and what they begin with.
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = range(2, 7)
_ANY, _IN_CHUNK = range(1, 16), range(_SCHEMA, _CHUNK)
_CHUNK_HEAD = struct.Struct('<QQQII')   # first and last stamp, size, checksum, length of a name
_MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, number, when recorded, when published
# Kind and length of a record that may have content: no message has 16 MB, and no chunk 4 GB.
_RECORD = re.compile(rb'[\x03-\x05].{3}\0{5}|\x06.{4}\0{4}', re.DOTALL)
# Kinds of records of a bag of ROS 1, and the header of a chunk, whose fields have any order.
_ROS1_MESSAGE, _ROS1_CHUNK, _ROS1_CHUNK_INFO, _ROS1_CONNECTION = 2, 5, 6, 7
_ROS1_CHUNK_HEAD = re.compile(
    rb'[\x28\x29]\0{3}(?:\x04\0{3}op=\x05|[\x0f\x10]\0{3}compression=|\x09\0{3}size=)')
_DECOMPRESSORS = {'zstd': zstd.ZstdDecompressor, 'lz4': LZ4FrameDecompressor,
                  'bz2': BZ2Decompressor}
_ZSTD = b'\x28\xb5\x2f\xfd'    # begin of a message that was compressed; CDR begins otherwise
Connect = Callable[..., Connection]
"""
Return the connection of the copy by topic, type, form, definition of the type, and quality.

The form is the serialization format of ROS 2, or the MD5 sum of a type of ROS 1; the quality is a
list of QoS profiles of ROS 2, or whether a topic of ROS 1 is latched.
"""
_Message = tuple[Connection, int, bytes]    # and when it was recorded [ns]


class _Walked:
    """A file that is walked through from its start."""

    def __init__(self, path: Path, connect: Connect) -> None:
        self.complete, self.n_damaged, self._connect = False, 0, connect
        self._types: dict[int, tuple[str, str]] = {}    # names and definitions, of mcap
        self._topics: dict[int, Connection] = {}
        with path.open('rb') as file:
            self._file = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.close = self._file.close


class _Mcap(_Walked):
    """An mcap file, cut short or with damaged bytes."""

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
        # let the head say how many pages are left, else SQLite does not open what was cut short
        with copy.open('r+b') as file:
            head, size = file.read(32), copy.stat().st_size
            page = int.from_bytes(head[16:18], 'big')
            pages = size // (65536 if page == 1 else max(page, 512))
            if pages < int.from_bytes(head[28:32], 'big'):
                self.n_damaged += 1
                file.seek(28)
                file.write(pages.to_bytes(4, 'big'))
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


class _Ros1(_Walked):
    """A bag of ROS 1, cut short or with damaged bytes."""

    def messages(self) -> Iterator[_Message]:
        """Yield all messages; what defines them may also stand behind them, at the index."""
        begin = len(b'#ROSBAG V2.0\n')
        for _ in self._messages(self._file, begin, unpack=False):
            pass
        self.n_damaged = 0
        return self._messages(self._file, begin)

    def _messages(self, data: bytes | mmap.mmap, at: int, *,
                  unpack: bool = True) -> Iterator[_Message]:
        """Yield the messages of the records that make sense."""
        while at < len(data):
            begin = at + 8 + _number(data[at:at + 4])
            end = begin + _number(data[begin - 4:begin])
            fields = _fields(data[at + 4:begin - 4])
            kind = _number(fields.get(b'op', b''))
            if kind not in range(2, 8) or begin > len(data) or (
                    end > len(data) and kind != _ROS1_CHUNK):
                self.n_damaged += 1
                if (following := _ROS1_CHUNK_HEAD.search(data, at + 1)) is None:
                    return
                at = following.start()
                continue
            if kind == _ROS1_CHUNK:
                form = fields.get(b'compression', b'').decode(errors='replace')
                if end == begin and form != 'none':     # it was being written
                    end = len(data)
                if unpack:
                    yield from self._in_chunk(form, data[begin:end])
            number = _number(fields.get(b'conn', b''))
            if kind == _ROS1_CONNECTION and number not in self._topics:
                about = {**fields, **_fields(data[begin:end])}
                with suppress(KeyError, UnicodeDecodeError):
                    self._topics[number] = self._connect(*(about[name].decode() for name in (
                        b'topic', b'type', b'md5sum', b'message_definition')),
                        about.get(b'latching') == b'1')
            elif kind == _ROS1_MESSAGE and number in self._topics:
                seconds, nanoseconds = (_number(fields.get(b'time', b'')[k:k + 4]) for k in (0, 4))
                yield self._topics[number], seconds * 10**9 + nanoseconds, bytes(data[begin:end])
            self.complete |= kind == _ROS1_CHUNK_INFO
            at = end

    def _in_chunk(self, form: str, data: bytes) -> Iterator[_Message]:
        """Yield the messages of a chunk; none if its content cannot be decompressed."""
        try:
            content = data if form == 'none' else bytes(
                _DECOMPRESSORS[form]().decompress(data, LONGEST_CHUNK))
        except Exception:   # decompression can raise anything
            self.n_damaged += 1
            return
        yield from self._messages(content, 0)


def _number(data: bytes) -> int:
    return int.from_bytes(data, 'little')


def _fields(head: bytes) -> dict[bytes, bytes]:
    """Return the fields of a header of ROS 1 by name; none if it makes no sense."""
    fields, at = dict[bytes, bytes](), 0
    while at < len(head):
        end = at + 4 + _number(head[at:at + 4])
        name, _, value = head[at + 4:end].partition(b'=')
        fields[name], at = value, end
    return fields if at == len(head) else {}


def _unpack(path: Path, copy: Path) -> Path:
    """Return a copy of a file that rosbag2 has compressed, as far as it goes."""
    unpacked = zstd.ZstdDecompressor()
    with path.open('rb') as source, copy.open('wb') as target, suppress(zstd.ZstdError):
        while not unpacked.eof and (part := source.read(2**20)):
            target.write(unpacked.decompress(part))
    return copy


def _connector(writer: Writer | Rosbag1Writer) -> Connect:
    """Return what adds each connection once."""
    connections: dict[tuple[object, ...], Connection] = {}

    def connect(topic: str, of_type: str, form: str, definition: str,
                qualities: Any) -> Connection:
        if (key := (topic, of_type, form)) not in connections:
            connections[key] = writer.add_connection(
                topic, normalize_msgtype(of_type), md5sum=form, msgdef=definition,
                latching=int(qualities)) if isinstance(writer, Rosbag1Writer) else (
                    writer.add_connection(
                        topic, of_type, msgdef=definition, rihs01=NO_HASH,
                        serialization_format=form, offered_qos_profiles=qualities))
        return connections[key]
    return connect


def _messages_in(file: Path, connect: Connect,
                 found: list[_Mcap | _Sqlite | _Ros1]) -> Iterator[_Message]:
    """Yield the messages of a file, also if rosbag2 has compressed it or each of them."""
    with TemporaryDirectory() as folder, suppress(sqlite3.Error, ValueError):
        name = file.name.removesuffix('.zstd')
        if name != file.name:
            file = _unpack(file, Path(folder, name))
        kind = _Ros1 if file.suffix in ROS1_SUFFIXES else (
            _Sqlite if file.suffix == '.db3' else _Mcap)
        with closing(kind(file, connect)) as damaged:
            found.append(damaged)
            for connection, recorded_ns, data in damaged.messages():
                if not 0 <= recorded_ns < 2**63:
                    continue
                if kind is not _Ros1 and data.startswith(_ZSTD):
                    try:
                        yield connection, recorded_ns, zstd.ZstdDecompressor().decompress(
                            data, LONGEST_CHUNK)
                    except zstd.ZstdError:
                        damaged.n_damaged += 1
                else:
                    yield connection, recorded_ns, data


def repair(path: Path, reason: str, copy: Path) -> str:
    """
    Write what can be read of a file or a folder of .mcap or .db3 files as a bag, if anything can.

    Returns a sentence that says how much time is missing, as far as the metadata beside the files
    tell; an empty one if nothing can be read.
    """
    about: Any = {}
    with suppress(OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        text = ((path if path.is_dir() else path.parent) / 'metadata.yaml').read_text('utf-8')
        about = dict(yaml.safe_load(text)['rosbag2_bagfile_information'])
    if about.get('compression_format') not in {None, '', 'zstd'}:
        return ''   # rosbag2 has none but zstd, and its messages cannot be unpacked here
    listed = [Path(str(name)).name for name in about.get('relative_file_paths') or ()]
    files = [path] if path.is_file() else [each for each in [
        path / name for name in listed if (path / name).is_file()] or sorted(path.iterdir())
        if each.name.removesuffix('.zstd').endswith(('.mcap', '.db3'))]
    n, begin_ns, end_ns = 0, 2**63, 0
    found: list[_Mcap | _Sqlite | _Ros1] = []
    with (Rosbag1Writer(copy) if path.suffix in ROS1_SUFFIXES else
          Writer(copy, version=9, storage_plugin=StoragePlugin.MCAP)) as writer:
        connect = _connector(writer)
        for file in files:
            for connection, recorded_ns, data in _messages_in(file, connect, found):
                writer.write(connection, recorded_ns, data)
                n, begin_ns, end_ns = n + 1, min(begin_ns, recorded_ns), max(end_ns, recorded_ns)
    if n == 0:
        return ''
    is_whole = len(found) == len(files) and all(each.complete for each in found)
    missing = 'its end is there' if is_whole else 'how much is missing is not known'
    if path.is_dir() or listed == [path.name]:
        with suppress(KeyError, TypeError, ValueError):
            wanted_ns = (int(about['starting_time']['nanoseconds_since_epoch'])
                         + int(about['duration']['nanoseconds']))
            if wanted_ns > end_ns + MISSING_NS or not is_whole:
                missing = f'{max(1e-9 * (wanted_ns - end_ns), 0.0):.1f} s at the end are missing'
    return (f'{path}: {reason}; what can be read of it is used: {n} messages in '
            f'{1e-9 * (end_ns + 1 - begin_ns):.1f} s, {sum(each.n_damaged for each in found)} '
            f'damaged parts are left out, {missing}')
