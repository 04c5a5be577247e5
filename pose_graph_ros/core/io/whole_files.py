# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Files of which all are written whole, or none at all.

Each is written beside its place under another name and forced to the disk; then all take their
places, in order. If anything fails before the last one has, those that have are taken back. Only
where the machine itself stops in between are some of them new and some old: whoever reads them
must be able to tell, which is why the one that vouches for the others comes last.
"""

from collections.abc import Mapping
import contextlib
import os
from pathlib import Path
import secrets

from pose_graph_ros.core.exceptions import FileWriteError


def write_files(contents: Mapping[Path, bytes]) -> None:
    """
    Write files, all of them or none; folders that are missing are made.

    Parameters
    ----------
    contents : mapping of Path to bytes
        In the order in which they take their places; all in one folder.

    Raises
    ------
    FileWriteError
        If that fails; what was there before is as it was, and nothing else is left behind.

    """
    mark = f'.{secrets.token_hex(4)}'
    fresh = {path: path.with_name(f'.{path.name}{mark}.new') for path in contents}
    old = {path: path.with_name(f'.{path.name}{mark}.old') for path in contents}
    placed: list[Path] = []
    try:
        for path in contents:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir():
                raise IsADirectoryError(f'{path} is a folder')
        for path, content in contents.items():
            _write(fresh[path], content)
        for path in contents:
            if path.exists():
                _keep(path, old[path])
        for path in contents:
            os.replace(fresh[path], path)
            placed.append(path)
        _settle(next(iter(contents)).parent)
    except (OSError, ValueError) as error:
        _take_back(placed, old)
        names = ', '.join(str(path) for path in contents)
        raise FileWriteError(f'{names}: cannot be written: {error}') from error
    except BaseException:
        _take_back(placed, old)
        raise
    finally:
        for path in (*fresh.values(), *old.values()):
            with contextlib.suppress(OSError, ValueError):
                path.unlink(missing_ok=True)


def _write(path: Path, content: bytes) -> None:
    with path.open('xb') as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _keep(path: Path, name: Path) -> None:
    """Give a file a second name, or a copy where the file system knows no second names."""
    try:
        os.link(path, name)
    except OSError:
        _write(name, path.read_bytes())


def _take_back(placed: list[Path], old: Mapping[Path, Path]) -> None:
    for path in placed:
        with contextlib.suppress(OSError):
            if old[path].exists():
                os.replace(old[path], path)
            else:
                path.unlink()


def _settle(folder: Path) -> None:
    """Force the new names to the disk, where a folder can be opened."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
