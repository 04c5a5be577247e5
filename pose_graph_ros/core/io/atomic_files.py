# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Writing of several files at once, either all of them completely or none.

Each file is written into a temporary folder beside it and synchronised to the disk. Then all
are renamed in order; if that fails, the previous files are put back. Only if the machine stops
during the renaming may new files lie beside old ones. A reader can detect that if one file has
the checksums of the others.
"""

import contextlib
import os
from pathlib import Path
from tempfile import TemporaryDirectory

from pose_graph_ros.core.exceptions import FileWriteError


def write_files(contents: dict[Path, bytes]) -> None:
    """
    Write files of one folder, all of them or none; missing folders are created.

    They are renamed in the order of `contents`. After a FileWriteError previous files are
    unchanged, and no temporary ones are left.
    """
    folder = next(iter(contents)).parent
    renamed: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix='.new', dir=folder, ignore_cleanup_errors=True) as name:
            fresh, old = Path(name, 'fresh'), Path(name, 'old')
            fresh.mkdir()
            old.mkdir()
            for path, content in contents.items():
                if path.is_dir():
                    raise IsADirectoryError(f'{path} is a folder')
                _write(fresh / path.name, content)
            for path in contents:
                if path.exists():
                    try:
                        os.link(path, old / path.name)
                    except OSError:     # a file system without hard links
                        _write(old / path.name, path.read_bytes())
            try:
                for path in contents:
                    os.replace(fresh / path.name, path)
                    renamed.append(path)
                with contextlib.suppress(OSError):      # where folders can be opened
                    handle = os.open(folder, os.O_RDONLY)
                    try:
                        os.fsync(handle)
                    finally:
                        os.close(handle)
            except BaseException:
                # new files are replaced by the previous ones; those without one are removed
                for path in renamed:
                    with contextlib.suppress(OSError):
                        if (old / path.name).exists():
                            os.replace(old / path.name, path)
                        else:
                            path.unlink()
                raise
    except (OSError, ValueError) as error:
        names = ', '.join(str(path) for path in contents)
        raise FileWriteError(f'{names}: cannot be written: {error}') from error


def _write(path: Path, content: bytes) -> None:
    with path.open('xb') as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
