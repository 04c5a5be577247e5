# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The SQLite file of a journal: the state of an engine at a checkpoint, and a log of what came since.

Arrays of the state are cut into parts, each stored by its SHA-256, so that a checkpoint writes
only the parts that are new. All that is read is checked by its SHA-256. A file that is damaged, or
of something else, is renamed and never written to; what can be read of it is in the new one.
"""

from collections.abc import Callable, Sequence
import contextlib
from dataclasses import dataclass, field
import fcntl
import hashlib
import json
import logging
import os
from pathlib import Path
import shutil
import sqlite3
from tempfile import TemporaryDirectory
import time
from typing import Any, IO, NamedTuple

import numpy as np

from pose_graph_ros.core import measurements as ms, saved_columns as sc
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.io.graph_files import SavedGraph

logger = logging.getLogger(__name__)

APPLICATION, VERSION = 0x506F4752, 1  # in the header of the file
PART = 16_384   # largest size of a part of an array [bytes]
INLINE = 64     # arrays of at most so many numbers are not cut out
LARGEST_WAL = 2_000_000     # of the file beside it, in which SQLite writes first [bytes]
ENDING = 100    # tenths of a second for which who ends may still write the file
MEMORY = '/dev/shm'     # where there is room for a copy on a full disk
PARTS = '#parts'    # key of the digests of an array's parts
SCHEMA = '''
    CREATE TABLE part (digest BLOB PRIMARY KEY, content BLOB NOT NULL);
    CREATE TABLE state (row INTEGER PRIMARY KEY, digest BLOB NOT NULL, content BLOB NOT NULL);
    CREATE TABLE log (row INTEGER PRIMARY KEY, number INTEGER, act INTEGER, digest BLOB NOT NULL,
                      content BLOB NOT NULL, moved BLOB NOT NULL);
'''
MOVED = np.dtype([('node', '<i8'), ('stamp_ns', '<i8'), ('pose', '<f8', 3)])
NOT_MOVED = np.empty(0, MOVED)

Measured = ms.OdometrySample | ms.Measurement
Place = Callable[[float, float, float], FloatArray]
"""As `Fix.place`, which is not in the file."""
TUPLES = 'twist', 'coordinates'     # fields of measurements that are no arrays
MEASURED: dict[str, Any] = {kind.__name__: kind for kind in (
    ms.OdometrySample, ms.YawRate, ms.GlobalPose, ms.Position, ms.Fix, ms.HeadingOnly,
    ms.LoopClosure, ms.Range)}


class Entry(NamedTuple):
    """A measurement that came, or an act of the engine; they are ordered by their numbers."""

    number: int  # of the measurement; for an act, of the last one that the engine had taken
    act: int     # 0 for a measurement, else the number of the act
    name: str    # of the source, or of the act
    values: Any  # the measurement as `plain` returns it, or the arguments of the act


class KnownPath(NamedTuple):
    """A path that was published."""

    stamps_ns: IntArray = np.empty(0, np.int64)
    poses: FloatArray = np.empty((0, 3))
    is_aligned: bool = False  # whether the poses are in the map, not in the odometry frame


class Found(NamedTuple):
    """What a file holds; all of it is empty for a new one."""

    state: 'Checkpoint | None' = None
    entries: Sequence[Entry] = ()  # since then
    path: KnownPath = KnownPath()  # the newest, if one was published since then
    last: tuple[int, int] = (0, 0)  # numbers of the last measurement and act
    trouble: str = ''  # why it is not all that there should be


class Checkpoint(NamedTuple):
    """The whole state of an engine."""

    saved: SavedGraph
    pending: Sequence[tuple[str, Any]]  # what waits, by source, as `plain` returns it
    last: tuple[int, int]  # numbers of the last measurement and act that are in it


@dataclass(slots=True)
class Batch:
    """What one transaction writes."""

    cleared: bool = False  # whether all that is in the file goes first
    entries: list[Entry] = field(default_factory=list)
    path: KnownPath | None = None
    checkpoint: Checkpoint | None = None

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to write."""
        return not self.cleared and len(self.entries) == 0 and (
            self.path is None and self.checkpoint is None)


def plain(measurement: Measured) -> list[Any]:
    """Return a measurement as JSON values."""
    return [type(measurement).__name__, {
        name: sc.encoded(getattr(measurement, name))
        for name in type(measurement).__annotations__
        if name != 'place' or not isinstance(measurement, ms.Fix)}]


def measurement_of(values: Any, place: Place) -> Any:
    """Return the measurement that `plain` was given; raises one of `MISMATCHES` if it is none."""
    name, fields = values
    known = {key: tuple(each) if key in TUPLES else np.array(each) if isinstance(each, list)
             else each for key, each in fields.items() if each is not None}
    kind = MEASURED[name]
    return kind(**known, **({'place': place} if kind is ms.Fix else {}))


class JournalFile:
    """The file, for one thread; raises sqlite3.Error or OSError if it cannot be used."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock: IO[bytes] | None = None  # of the process that uses the file
        self._connection: sqlite3.Connection | None = None
        self._identity: tuple[int, int] | None = None  # of the file whose content is known
        self._parts: set[bytes] = set()  # digests of those in the file
        self._path = KnownPath()  # the last one in the file

    @property
    def size(self) -> int:
        """Size of the file and of those that SQLite has beside it [bytes]."""
        return sum(each.stat().st_size for each in _files(self.path) if each.exists())

    def read(self, refusal: Callable[[SavedGraph], str | None]) -> Found:
        """
        Return what is in the file, as far as it can be read and is not refused.

        A copy is read, as SQLite would change a file that it opens. Where the file cannot be
        written, or there is no room for a copy, it is read all the same.
        """
        try:
            self._claim(ENDING)
        except BlockingIOError:
            raise
        except OSError:     # which the first `write` will tell
            pass
        if not any(path.exists() for path in _files(self.path)):
            return Found()
        for place in (None, MEMORY):
            with contextlib.suppress(OSError), TemporaryDirectory(dir=place) as folder:
                found = _found(_copied(self.path, Path(folder)))
                break
        else:
            found = _found(self.path)
        if found.state is not None and (refused := refusal(found.state.saved)) is not None:
            found = Found(trouble=refused)
        return found

    def take(self, found: Found) -> None:
        """Go on with the file that was read; if it was bad, with a new one beside it."""
        if found.trouble != '':
            self.set_aside(found.trouble)
            self.write(Batch(
                entries=[*found.entries], path=found.path, checkpoint=found.state))
        self._identity = _identity(self.path)

    def close(self) -> None:
        """Close the file, which the next `write` opens again."""
        if self._connection is not None:
            with contextlib.suppress(sqlite3.Error):
                self._connection.close()
        if self._lock is not None:
            self._lock.close()
        self._connection = self._lock = None

    @property
    def is_lost(self) -> bool:
        """Whether the file is no longer where it was."""
        return self._connection is not None and self._identity != _identity(self.path)

    def write(self, batch: Batch) -> None:
        """Write a batch in one transaction."""
        connection = self._connection
        if connection is None:
            self._claim()
            if self.path.exists() and _identity(self.path) != self._identity:
                self.set_aside('it is not the file that was read')
            connection, self._parts = _connected(self.path)
            self._connection, self._identity = connection, _identity(self.path)
        parts = self._parts
        try:
            connection.execute('BEGIN IMMEDIATE')
            if batch.cleared:
                for table in ('part', 'state', 'log'):
                    connection.execute(f'DELETE FROM {table}')
                parts, self._path = set(), KnownPath()
            if batch.checkpoint is not None:
                parts = _write_state(connection, batch.checkpoint, parts)
                self._path = KnownPath(
                    batch.checkpoint.saved.nodes.stamps_ns, batch.checkpoint.saved.path)
            if len(batch.entries) > 0:
                # an act comes after measurements that the engine had not taken
                self._log(connection, max(each[:2] for each in batch.entries), batch.entries)
            if batch.path is not None:
                # a row of its own, so that the next checkpoint removes it
                self._log(connection, (0, batch.path.is_aligned), [],
                          _moved(self._path, batch.path))
                self._path = batch.path
            connection.execute('COMMIT')
        except BaseException:
            self.close()    # which rolls back
            raise
        self._parts = parts
        if batch.checkpoint is not None:
            # `execute` would give one page back, as it does one step
            connection.executescript('PRAGMA incremental_vacuum')
        if batch.checkpoint is not None or _files(self.path)[1].stat().st_size > LARGEST_WAL:
            connection.execute('PRAGMA wal_checkpoint(TRUNCATE)').fetchall()

    def _log(self, connection: sqlite3.Connection, last: tuple[int, int],
             entries: Sequence[Entry], moved: Any = NOT_MOVED) -> None:
        content, change = json.dumps(entries).encode(), moved.tobytes()
        connection.execute(
            'INSERT INTO log (number, act, digest, content, moved) VALUES (?, ?, ?, ?, ?)',
            (*last, _digest(content + change), content, change))

    def _claim(self, tries: int = 1) -> None:
        """Keep other processes from using the file, as long as this one does."""
        if self._lock is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            lock = self.path.with_name(self.path.name + '.lock').open('ab')
            for left in range(tries - 1, -1, -1):
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError as error:
                    if left == 0:
                        lock.close()
                        raise BlockingIOError('another process uses it') from error
                    time.sleep(0.1)
            self._lock = lock

    def set_aside(self, why: str) -> None:
        """Rename the file, which is not open."""
        stamp = time.strftime('%Y%m%dT%H%M%S', time.gmtime())
        names = (f'{self.path.name}.bad-{stamp}' + ('' if k == 0 else f'-{k}')
                 for k in range(1000))
        aside = next(each for each in map(self.path.with_name, names) if not each.exists())
        for old, new in zip(_files(self.path), _files(aside), strict=True):
            if old.exists():
                os.replace(old, new)
        logger.error('%s: %s: it is kept as %s, and a new journal is begun', self.path, why,
                     aside.name)


def _connected(path: Path) -> tuple[sqlite3.Connection, set[bytes]]:
    """Return a connection to a file that may be new, and the digests of its parts."""
    connection = sqlite3.connect(path, timeout=1.0, isolation_level=None)
    try:
        # without files shared with others, and giving the space back that becomes free
        for pragma in ('locking_mode = EXCLUSIVE', 'auto_vacuum = INCREMENTAL',
                       'journal_mode = WAL', 'synchronous = FULL', 'wal_autocheckpoint = 0'):
            connection.execute(f'PRAGMA {pragma}').fetchall()
        application, version, n_tables = (
            connection.execute(query).fetchone()[0] for query in (
                'PRAGMA application_id', 'PRAGMA user_version',
                'SELECT count(*) FROM sqlite_master'))
        if n_tables == 0:
            connection.executescript(
                f'BEGIN;{SCHEMA} PRAGMA application_id = {APPLICATION};'
                f'PRAGMA user_version = {VERSION}; COMMIT')
        elif (application, version) != (APPLICATION, VERSION):
            raise FileFormatError(f'expected a journal of version {VERSION}, got ' + (
                f'one of version {version}' if application == APPLICATION else
                'another SQLite file'))
        return connection, {digest for digest, in connection.execute('SELECT digest FROM part')}
    except BaseException:
        connection.close()
        raise


def _found(path: Path) -> Found:
    """Return what is in a file, which SQLite may change."""
    n_commits = _n_commits(_files(path)[1])
    try:
        connection, _ = _connected(path)
    except (sqlite3.Error, ValueError) as error:    # its texts may be no UTF-8
        return Found(trouble=f'it is damaged, or no journal: {error}')
    with contextlib.closing(connection):
        try:
            found = _read(connection)
            # what is behind a bad frame of the log is for SQLite a commit that was not ended
            _, n_whole, _ = connection.execute('PRAGMA wal_checkpoint(PASSIVE)').fetchone()
        except (sqlite3.Error, ValueError) as error:
            return Found(trouble=f'it is damaged: {error}')
    return found if found.trouble != '' or n_whole >= n_commits else found._replace(
        trouble=f'its newest part is damaged: of {n_commits} pages {n_whole} are whole')


def _copied(path: Path, folder: Path) -> Path:
    copy = folder / path.name
    for each, other in zip(_files(path), _files(copy), strict=True):
        if each.exists():
            shutil.copy(each, other)
    return copy


def _files(path: Path) -> list[Path]:
    return [path.with_name(path.name + suffix) for suffix in ('', '-wal', '-shm')]


def _n_commits(wal: Path) -> int:
    """Return the number of frames in a write-ahead log up to the last one that ends a commit."""
    content = wal.read_bytes() if wal.exists() else b''
    page = int.from_bytes(content[8:12])
    if not 512 <= page <= 65_536:
        return len(content)     # a damaged header, or an empty file
    ends = range(32 + 24 + page, len(content) + 1, 24 + page)
    return max((k for k, end in enumerate(ends, 1) if any(
        content[end - page - 20:end - page - 16])), default=0)


def _identity(path: Path) -> tuple[int, int] | None:
    with contextlib.suppress(OSError):
        status = os.stat(path)
        return status.st_dev, status.st_ino
    return None


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()


def _write_state(connection: sqlite3.Connection, checkpoint: Checkpoint,
                 parts: set[bytes]) -> set[bytes]:
    """Replace state and log; return the digests of the parts that are in the file then."""
    fresh: dict[bytes, bytes] = {}

    def cut(array: Any) -> Any:
        if array.size <= INLINE:
            return array.tolist()
        content = np.ascontiguousarray(array).tobytes()
        pieces = [content[k:k + PART] for k in range(0, len(content), PART)]
        digests = list(map(_digest, pieces))
        fresh.update(zip(digests, pieces, strict=True))
        return {'dtype': array.dtype.str, 'shape': array.shape,
                PARTS: [digest.hex() for digest in digests]}
    tree = {'saved': sc.encoded(checkpoint.saved, cut), 'pending': checkpoint.pending,
            'last': checkpoint.last}
    content = json.dumps(tree).encode()
    connection.executemany('INSERT INTO part VALUES (?, ?)', [
        each for each in fresh.items() if each[0] not in parts])
    connection.executemany('DELETE FROM part WHERE digest = ?', [
        (digest,) for digest in parts - fresh.keys()])
    connection.execute('INSERT OR REPLACE INTO state VALUES (1, ?, ?)', (
        _digest(content), content))
    connection.execute(
        'DELETE FROM log WHERE number < :number OR (number = :number AND act <= :act)',
        dict(zip(('number', 'act'), checkpoint.last, strict=True)))
    return set(fresh)


def _moved(before: KnownPath, after: KnownPath) -> Any:
    """Return the nodes of a path that another one, of no more nodes, does not have like that."""
    n = min(len(before.stamps_ns), len(after.stamps_ns))
    same = (before.stamps_ns[:n] == after.stamps_ns[:n]) & np.all(
        before.poses[:n] == after.poses[:n], axis=1)
    nodes = np.concatenate((np.flatnonzero(~same), np.arange(n, len(after.stamps_ns))))
    moved = np.empty(len(nodes), MOVED)
    moved['node'], moved['stamp_ns'] = nodes, after.stamps_ns[nodes]
    moved['pose'] = after.poses[nodes]
    return moved


def _with(path: KnownPath, moves: Any, is_aligned: bool) -> KnownPath:
    """Return a path in which some nodes have moved or are new."""
    n = max(len(path.stamps_ns), int(moves['node'][-1]) + 1)
    changed = KnownPath(np.zeros(n, np.int64), np.zeros((n, 3)), is_aligned)
    for new, old, name in zip(changed[:2], path[:2], ('stamp_ns', 'pose'), strict=True):
        new[:len(old)] = old
        new[moves['node']] = moves[name]
    return changed


def _read(connection: sqlite3.Connection) -> Found:
    """Return what is in a file, as far as it is whole."""
    check = ' '.join(connection.execute('PRAGMA integrity_check(1)').fetchone()[0].split())
    trouble = '' if check == 'ok' else f'it is damaged: {check}'
    try:
        state = _read_state(connection)
    except (*sc.MISMATCHES, FileFormatError, sqlite3.Error) as error:
        return Found(trouble=trouble or f'its state is damaged: {error!r}')
    known = KnownPath() if state is None else KnownPath(
        state.saved.nodes.stamps_ns, state.saved.path)
    begin = (0, 0) if state is None else state.last
    (number, act), path, entries = begin, known, list[Entry]()
    try:
        for digest, content, change, is_aligned in connection.execute(
                'SELECT digest, content, moved, act FROM log ORDER BY row'):
            _check(digest, content + change)
            for entry in (Entry(*item) for item in json.loads(content)):
                if entry[:2] <= begin:
                    continue
                number, act = number + (entry.act == 0), act + (entry.act > 0)
                if entry.act not in (0, act) or entry.number > number:
                    raise FileFormatError(f'{entry[:2]} follows {number, act}')
                entries.append(entry)
            if len(change) > 0:
                path = _with(path, np.frombuffer(change, MOVED), bool(is_aligned))
    except (*sc.MISMATCHES, FileFormatError, sqlite3.Error) as error:
        trouble = trouble or f'its log is damaged: {error}'
    return Found(state, sorted(entries, key=lambda each: each[:2]),
                 KnownPath() if path is known else path, (number, act), trouble)


def _read_state(connection: sqlite3.Connection) -> Checkpoint | None:
    stored = connection.execute('SELECT digest, content FROM state').fetchone()
    if stored is None:
        return None
    _check(*stored)
    parts = dict(connection.execute('SELECT digest, content FROM part'))

    def joined(value: dict[str, Any]) -> Any:
        if PARTS not in value:
            return value
        digests = [*map(bytes.fromhex, value[PARTS])]
        for digest in digests:
            _check(digest, parts[digest])
        content = b''.join(parts[digest] for digest in digests)
        return np.frombuffer(content, value['dtype']).reshape(value['shape'])
    tree = json.loads(stored[1], object_hook=joined)
    number, act = tree['last']
    return Checkpoint(sc.decoded(SavedGraph, tree['saved']), tree['pending'], (number, act))


def _check(digest: bytes, content: bytes) -> None:
    if _digest(content) != digest:
        raise FileFormatError('a row does not have its SHA-256')
