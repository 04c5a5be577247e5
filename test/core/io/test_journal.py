# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The journal: whatever happens to process and file, the drive goes on from what was accepted."""

from collections.abc import Iterator
from pathlib import Path
import shutil

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from saved_graphs import Event, feed
from test_delay_invariance import CONFIGS, drive, SAME_PATH

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.io.journal import Journal
from pose_graph_ros.core.io.journal_file import Found, JournalFile, KnownPath
from pose_graph_ros.core.recovery import recovered

PERIOD = 0.02   # [s]


def no_place(*_: float) -> np.ndarray:
    raise AssertionError('there is no fix')


class Drive:
    """An engine whose worker keeps a journal."""

    def __init__(self, folder: Path, config: BackendConfig) -> None:
        self.config, self.path = config, folder / 'state.db'
        self.journal = Journal(self.path, PERIOD)
        found = self.journal.found.result()
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
        self.chapter.checkpoint(self.backend.saved(), self.backend.pending, 0.0)

    def keep_path(self) -> None:
        self.chapter.keep_path(path_of(self.backend))

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
    return KnownPath(nodes.stamps_ns.copy(), nodes.poses(backend.graph))


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
        return file.read(lambda _: None)
    finally:
        file.close()


def test_flipped_bits_are_noticed_or_without_effect(written: Drive, tmp_path: Path) -> None:
    copied(written, tmp_path)
    whole, rng = opened(tmp_path), np.random.default_rng(0)
    assert whole.trouble == ''
    assert whole.state is not None
    assert len(whole.path.poses) > 0
    n_bad = 0
    for k in range(1000):
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
    assert n_bad > 500
