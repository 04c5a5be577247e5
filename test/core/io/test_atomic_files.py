# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several files at once: written completely or not at all, whatever fails and when."""

import errno
import os
from pathlib import Path
import resource

import pytest

from pose_graph_ros.core.exceptions import FileWriteError
from pose_graph_ros.core.io import atomic_files
from pose_graph_ros.core.io.atomic_files import write_files

NAMES = ('map.g2o', 'map.tum', 'map.json')
OLD = {name: f'the old {name}'.encode() for name in NAMES}
NEW = {name: f'the new {name}, '.encode() * 200 for name in NAMES}


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def write(folder: Path, files: dict[str, bytes]) -> None:
    write_files({folder / name: content for name, content in files.items()})


def failing_at(call: int, error: BaseException) -> object:
    """Return `os.replace` that fails once, at a call that is counted from 1."""
    real, calls = os.replace, []

    def replace(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == call:
            raise error
        real(source, target)

    return replace


def test_files_are_written_into_a_new_folder_and_over_old_ones(tmp_path: Path) -> None:
    folder, others = tmp_path / 'new' / 'deep', {'.map.json.old': b'mine', 'map.json.new': b'too'}
    write(folder, others)
    for files in (OLD, NEW, {**OLD, 'map.tum': b''}):
        write(folder, files)
        assert contents(folder) == {**files, **others}


@pytest.mark.parametrize('error', [
    OSError(errno.EIO, 'the disk is gone'), KeyboardInterrupt(), MemoryError()])
@pytest.mark.parametrize('old', [{}, {'map.tum': OLD['map.tum']}, OLD])
@pytest.mark.parametrize('call', [1, 2, 3])
def test_if_a_file_cannot_be_renamed_all_are_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: int, old: dict[str, bytes],
    error: BaseException,
) -> None:
    if old:
        write(tmp_path, old)
    with monkeypatch.context() as patch:
        patch.setattr(atomic_files.os, 'replace', failing_at(call, error))
        # what is no failure of the disk goes through as it is
        expected = FileWriteError if isinstance(error, OSError) else type(error)
        with pytest.raises(expected, match='disk is gone' if expected is FileWriteError else None):
            write(tmp_path, NEW)
    assert contents(tmp_path) == old
    write(tmp_path, NEW)
    assert contents(tmp_path) == NEW


@pytest.mark.parametrize('share', [0.0, 0.5, 0.9])
@pytest.mark.parametrize('name', NAMES)
def test_a_disk_that_is_full_leaves_the_old_files(tmp_path: Path, name: str, share: float) -> None:
    """Those before the largest one are whole by then."""
    write(tmp_path, OLD)
    new = {**NEW, name: 3 * NEW[name]}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    largest = len(new[name])
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * largest), limits[1]))
    try:
        with pytest.raises(FileWriteError, match='too large'):
            write(tmp_path, new)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert contents(tmp_path) == OLD
