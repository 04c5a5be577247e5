# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The journal: whatever happens to process and file, the drive goes on from what was accepted."""

from collections.abc import Iterator
from dataclasses import replace
import os
from pathlib import Path
import resource
import shutil
import sqlite3
import tempfile

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from saved_graphs import Event, feed, LINE_ODOMETRY, line_sample
from test_delay_invariance import CONFIGS, drive, SAME_PATH

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, WindowConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.io import journal_file
from pose_graph_ros.core.io.journal import Journal
from pose_graph_ros.core.io.journal_file import Entry, Found, JournalFile, KnownPath, plain
from pose_graph_ros.core.measurements import OdometrySample, Position
from pose_graph_ros.core.recovery import recovered

PERIOD = 0.02   # [s]
FLIPS = int(os.environ.get('POSE_GRAPH_FLIPS', '40'))


def no_place(*_: float) -> np.ndarray:
    raise AssertionError('there is no fix')


class Drive:
    """An engine whose worker keeps a journal."""

    def __init__(self, folder: Path, config: BackendConfig) -> None:
        self.config, self.path = config, folder / 'state.db'
        self.journal = Journal(self.path, PERIOD)
        found = self.journal.take()
        self.chapter = self.journal.begin()
        self.backend = recovered(config, found, no_place)
        self.found = found

    def feed(self, event: Event) -> None:
        self.chapter.measured(event.source, event.what)
        feed(self.backend, event)
        self.chapter.taken += 1

    def update(self) -> None:
        self.chapter.act('update')
        self.backend.update()

    def checkpoint(self) -> None:
        self.chapter.checkpoint(self.backend.saved(), self.backend.pending)

    def keep_path(self) -> None:
        """Let the journal have the path, and wait until it is on the disk, however busy."""
        assert self.journal.put_at_once(self.chapter, path_of(self.backend)).wait(60.0)

    def killed(self) -> 'Drive':
        """Return the drive that goes on with what is on the disk now."""
        folder = self.path.parent / 'next'
        folder.mkdir()
        for path in self.path.parent.glob('state.db*'):
            shutil.copy(path, folder)
        self.journal.close(5.0)
        return Drive(folder, self.config)


def path_of(backend: PoseGraphBackend) -> KnownPath:
    nodes = backend.parts.nodes
    return KnownPath(nodes.stamps_ns.copy(), nodes.poses(backend.graph),
                     backend.parts.alignment.is_aligned)


def events(kind: str) -> list[Event]:
    odometry, measurements = drive(0, kind)
    return sorted(odometry + measurements)


@given(st.sampled_from(list(CONFIGS)), st.lists(st.integers(60, 1000), min_size=1, max_size=3),
       st.integers(20, 400))
@settings(max_examples=5, deadline=None)
def test_a_drive_with_kills_ends_like_one_without(
    tmp_path_factory: pytest.TempPathFactory, kind: str, kills: list[int], every: int,
) -> None:
    stream, config = events(kind), CONFIGS[kind]
    whole = PoseGraphBackend(config)
    one = Drive(tmp_path_factory.mktemp('drive'), config)
    for k, event in enumerate(stream):
        feed(whole, event)
        one.feed(event)
        if k % 10 == 0:
            whole.update()
            one.update()
        if k % every == every - 1:
            one.checkpoint()
        if k in kills:
            one.keep_path()
            before, pending = path_of(one.backend), len(one.backend.pending)
            one = one.killed()
            assert one.found.trouble == ''
            np.testing.assert_array_equal(path_of(one.backend).stamps_ns, before.stamps_ns)
            np.testing.assert_allclose(path_of(one.backend).poses, before.poses, rtol=0, atol=1e-9)
            assert len(one.backend.pending) == pending
    one.journal.close(5.0)
    for backend in (whole, one.backend):
        backend.optimize()
    np.testing.assert_allclose(
        path_of(one.backend).poses, path_of(whole).poses, rtol=0, atol=SAME_PATH)


# --- files that are not whole, or cannot be written ----------------------------------------------

@pytest.fixture(scope='module')
def written(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Drive]:
    """Yield a drive that was killed, with a checkpoint and a log in its file."""
    stream = events('plain')
    one = Drive(tmp_path_factory.mktemp('written'), CONFIGS['plain'])
    for k, event in enumerate(stream):
        one.feed(event)
        if k % 10 == 0:
            one.update()
        if k == 300:
            one.checkpoint()
        if k % 100 == 99:
            one.keep_path()
    one.keep_path()
    yield one
    one.journal.close(5.0)


def copied(of: Drive, folder: Path) -> list[Path]:
    return [Path(shutil.copy(path, folder)) for path in sorted(of.path.parent.glob('state.db*'))]


def opened(folder: Path) -> Found:
    file = JournalFile(folder / 'state.db')
    try:
        found = file.read(lambda _: None)
        file.take(found)
        return found
    finally:
        file.close()


def test_flipped_bits_are_noticed_or_without_effect(written: Drive, tmp_path: Path) -> None:
    copied(written, tmp_path)
    whole, rng = opened(tmp_path), np.random.default_rng(0)
    assert whole.trouble == ''
    assert whole.state is not None
    assert len(whole.path.poses) > 0
    n_bad = 0
    for k in range(FLIPS):
        folder = tmp_path / str(k)
        folder.mkdir()
        paths = copied(written, folder)
        sizes = [path.stat().st_size for path in paths]
        at = int(rng.integers(sum(sizes)))
        path = next(path for path, end in zip(paths, np.cumsum(sizes), strict=True) if at < end)
        content = bytearray(path.read_bytes())
        content[at % len(content)] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)
        before = {path.name: path.read_bytes() for path in paths}
        found = opened(folder)
        # what is read is right
        n = len(found.entries)
        assert [*found.entries] == [*whole.entries[:n]] or found.state is None
        if found.trouble == '':
            assert (n, found.last) == (len(whole.entries), whole.last)
            np.testing.assert_array_equal(found.path.poses, whole.path.poses)
        else:
            n_bad += 1
            aside = {path.name.partition('.bad-')[0] + (
                '-wal' if path.name.endswith('-wal') else ''): path.read_bytes()
                for path in folder.glob('*.bad-*')}
            assert aside['state.db'] == before['state.db'], 'the bad file is as it was'
            again = opened(folder)
            assert (again.trouble, len(again.entries), again.last) == ('', n, found.last)
        shutil.rmtree(folder)
    assert n_bad > FLIPS // 2


def driven(one: Drive, n: int) -> None:
    """Drive a straight line of n samples on, and wait until that is on the disk."""
    begin = one.chapter.taken
    for k in range(begin, begin + n):
        one.feed(Event('odom', line_sample(1.0 + 0.1 * k)))
    one.update()
    one.keep_path()


@pytest.fixture
def begun(tmp_path: Path) -> Iterator[Drive]:
    one = Drive(tmp_path, LINE_ODOMETRY)
    driven(one, 50)
    yield one
    one.journal.close(5.0)


def test_a_full_disk_is_told_and_nothing_is_missing_when_there_is_room_again(
    begun: Drive, caplog: pytest.LogCaptureFixture,
) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (begun.journal.size // 2, hard))
    try:
        driven(begun, 50)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert begun.journal.failure != ''
    assert 'the journal cannot be written' in caplog.text
    driven(begun, 50)
    begun.checkpoint()
    driven(begun, 50)
    assert begun.journal.failure == ''
    then = begun.killed()
    assert then.found.trouble == ''
    np.testing.assert_array_equal(path_of(then.backend).poses, path_of(begun.backend).poses)
    then.journal.close(5.0)


@pytest.mark.parametrize('memory', ['/dev/shm', '/nowhere'])
def test_without_room_for_a_copy_it_is_read_all_the_same(
    begun: Drive, memory: str, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tempfile, 'tempdir', '/nowhere')
    monkeypatch.setattr(journal_file, 'MEMORY', memory)
    then = begun.killed()
    np.testing.assert_array_equal(path_of(then.backend).poses, path_of(begun.backend).poses)
    driven(then, 10)
    assert then.journal.failure == ''
    then.journal.close(5.0)


def test_what_can_be_read_of_a_damaged_file_is_used_though_no_new_one_can_be_made(
    written: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / 'state.db'
    copied(written, tmp_path)
    wal = file.with_name('state.db-wal')
    content = bytearray(wal.read_bytes())
    content[-2000] ^= 1
    wal.write_bytes(content)
    before = file.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(journal_file.os, 'replace', refuse)
        one = Drive(tmp_path, written.config)
    assert one.found.trouble != ''
    assert len(path_of(one.backend).poses) > 50
    assert 'no room' in one.journal.failure
    one.checkpoint()
    one.keep_path()
    assert one.journal.failure == ''
    one.journal.close(5.0)
    assert before in [path.read_bytes() for path in tmp_path.glob('*.bad-*')]
    assert opened(tmp_path).trouble == ''


def refuse(*_: object) -> None:
    raise OSError('no room')


def test_another_file_that_is_put_there_is_set_aside(begun: Drive, tmp_path: Path) -> None:
    (tmp_path / 'backup').write_bytes(b'of a person')
    (tmp_path / 'backup').replace(begun.path)
    driven(begun, 10)
    begun.checkpoint()
    driven(begun, 10)
    assert b'of a person' in [path.read_bytes() for path in tmp_path.glob('*.bad-*')]
    then = begun.killed()
    np.testing.assert_array_equal(path_of(then.backend).poses, path_of(begun.backend).poses)
    then.journal.close(5.0)


@pytest.mark.parametrize('has_gap', [False, True])
def test_what_waits_for_the_engine_at_a_checkpoint_is_in_the_log(
    begun: Drive, has_gap: bool,
) -> None:
    if has_gap:
        begun.journal._fail(OSError('no room'))
    for k in range(50, 80):
        begun.chapter.measured('odom', line_sample(1.0 + 0.1 * k))
        if k < 60:
            begun.backend.add_odometry(line_sample(1.0 + 0.1 * k), 'odom')
    begun.chapter.taken += 10
    begun.update()
    begun.keep_path()
    begun.checkpoint()
    for k in range(80, 90):
        begun.chapter.measured('odom', line_sample(1.0 + 0.1 * k))
    then_at = path_of(begun.backend)
    begun.journal.put_at_once(begun.chapter, then_at).wait(60.0)
    then = begun.killed()
    assert then.found.trouble == ''
    assert [entry.number for entry in then.found.entries] == [*range(61, 91)]
    then.journal.close(5.0)


def test_a_file_that_is_removed_is_written_anew(begun: Drive) -> None:
    for path in begun.path.parent.iterdir():
        path.unlink()
    driven(begun, 50)
    begun.checkpoint()
    driven(begun, 50)
    then = begun.killed()
    np.testing.assert_array_equal(path_of(then.backend).poses, path_of(begun.backend).poses)
    then.journal.close(5.0)


def test_a_file_in_use_is_left_alone(begun: Drive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_file, 'ENDING', 1)
    other = Drive(begun.path.parent, LINE_ODOMETRY)
    driven(other, 10)
    other.checkpoint()
    other.keep_path()
    assert 'another process uses it' in other.journal.failure
    other.journal.close(5.0)
    driven(begun, 50)
    then = begun.killed()
    np.testing.assert_array_equal(path_of(then.backend).poses, path_of(begun.backend).poses)
    then.journal.close(5.0)


def test_a_folder_that_cannot_be_written_to_is_told(caplog: pytest.LogCaptureFixture) -> None:
    one = Drive(Path('/proc'), LINE_ODOMETRY)
    driven(one, 10)
    assert '/proc/state.db: ' in one.journal.failure
    assert caplog.text.count('the journal cannot be written') == 1
    one.journal.close(5.0)


@pytest.mark.parametrize(('change', 'said'), [
    ('PRAGMA user_version = 2', 'expected a journal of version 1, got one of version 2'),
    ('PRAGMA application_id = 5', 'got another SQLite file')])
def test_files_of_others_are_set_aside(
    begun: Drive, tmp_path: Path, change: str, said: str,
) -> None:
    folder = tmp_path / 'other'
    folder.mkdir()
    begun.journal.close(5.0)
    copied(begun, folder)
    with sqlite3.connect(folder / 'state.db') as connection:
        connection.execute(change)
    connection.close()
    content = (folder / 'state.db').read_bytes()
    found = opened(folder)
    assert said in found.trouble
    assert found.last == (0, 0)
    aside, = folder.glob('*.bad-*')
    assert aside.read_bytes() == content


def test_the_file_shrinks_with_the_graph(tmp_path: Path) -> None:
    one = Drive(tmp_path, LINE_ODOMETRY)

    def size_after(n: int) -> int:
        driven(one, n)
        one.checkpoint()
        one.keep_path()
        return one.journal.size
    before = size_after(10_000)
    one.backend.configure(replace(LINE_ODOMETRY, window=WindowConfig(nodes=50)))
    for _ in range(20):
        size_after(20)
    assert size_after(10) < before // 2
    one.journal.close(5.0)


def test_a_chapter_with_a_state_replaces_the_one_before_with_its_first_checkpoint(
    begun: Drive,
) -> None:
    length = len(path_of(begun.backend).poses)
    begun.chapter = begun.journal.begin(has_state=True)
    driven(begun, 10)
    then = begun.killed()
    assert len(path_of(then.backend).poses) == length
    then.journal.close(5.0)


def test_a_chapter_that_is_replaced_before_its_first_checkpoint_holds_nothing_up(
    begun: Drive,
) -> None:
    replaced = begun.journal.begin(has_state=True)
    replaced.measured('odom', line_sample(99.0))
    begun.journal.put_at_once(begun.chapter, path_of(begun.backend)).wait(0.2)
    begun.chapter, begun.backend = begun.journal.begin(), PoseGraphBackend(LINE_ODOMETRY)
    driven(begun, 20)
    then = begun.killed()
    assert [entry.number for entry in then.found.entries if entry.act == 0] == [*range(1, 21)]
    then.journal.close(5.0)


def test_what_comes_while_a_graph_is_loaded_at_the_first_start_is_not_taken_for_a_drive(
    tmp_path: Path,
) -> None:
    journal = Journal(tmp_path / 'state.db', PERIOD)
    journal.take()
    chapter = journal.begin(has_state=True)
    chapter.measured('odom', line_sample(1.0))
    journal.put_at_once(chapter, KnownPath()).wait(0.2)
    journal.close(5.0)
    assert opened(tmp_path).last == (0, 0)


def test_a_path_from_before_the_alignment_is_not_put_on_the_map() -> None:
    whole, path = PoseGraphBackend(LINE_ODOMETRY), KnownPath()
    entries, rng = list[Entry](), np.random.default_rng(1)
    T_map_odom, n_updates = np.array([500.0, -300.0, 2.8]), 0
    for k in range(500):
        pose = np.array([0.1 * k, 0.2 * np.sin(0.05 * k), 0.1 * np.cos(0.05 * k)])
        events = [Event('odom', OdometrySample(k * 100_000_000, pose))]
        if k > 200 and k % 10 == 0:
            mean = se2.compose(T_map_odom, pose)[:2] + rng.normal(0.0, 0.5, 2)
            events.append(Event('fix', Position(
                k * 100_000_000, mean, 0.25 * np.eye(2), np.zeros(2))))
        for event in events:
            feed(whole, event)
            entries.append(Entry(len(entries) + 1 - n_updates, 0, event.source, plain(event.what)))
        if k % 2 == 1:
            whole.update()
            n_updates += 1
            entries.append(Entry(len(entries) + 1 - n_updates, n_updates, 'update', []))
        if k == 200:
            path = path_of(whole)
    assert whole.parts.alignment.is_aligned
    again = recovered(LINE_ODOMETRY, Found(None, entries, path, (0, 0)), no_place)
    np.testing.assert_allclose(path_of(again).poses, path_of(whole).poses, rtol=0, atol=1e-6)


def test_a_checkpoint_of_a_drive_that_goes_on_is_written_like_the_first(tmp_path: Path) -> None:
    one = Drive(tmp_path, BackendConfig())
    for event in events(next(iter(CONFIGS)))[:300]:
        one.feed(event)
    one.checkpoint()
    one.keep_path()
    one = one.killed()
    one.checkpoint()
    one.keep_path()
    assert one.journal.failure == ''
    one.journal.close(5.0)
