# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Results that are kept, under keys of all that they depend on.

The files of a drive are written aside and get their place all at once, by the renaming of their
folder. The last of them names the sizes of the others, so that what a machine lost when its power
failed is not taken for a result.
"""

from contextlib import suppress
import json
from pathlib import Path
from typing import Any

DRIVES, UNFINISHED = 'drives', 'unfinished'  # folders
FILE = 'drive.json'  # row of the table, small map, sizes of the other files, name of the run
NEEDED = {'path.tum', 'run.json', 'summary.json', 'report.html'}  # by who reads a result


def key_of(content: str, settings: str) -> str:
    """Return the key of a result, by the content of the bag and the settings."""
    return f'{settings}-{content[:24]}' if content else ''


def read_result(out: Path, key: str, run: str = '') -> dict[str, Any] | None:
    """
    Return the row of a drive that has been replayed; None if not all of it is there.

    It is new if it was this run that has replayed it.
    """
    folder = out / DRIVES / key
    with suppress(OSError, ValueError, KeyError, TypeError):
        told = json.loads((folder / FILE).read_text(encoding='utf-8'))
        if told['sizes'].keys() >= NEEDED and all(
                (folder / name).stat().st_size == size
                for name, size in told['sizes'].items()):
            return {**told['row'], 'folder': f'{DRIVES}/{key}', 'key': key,
                    'is_new': told['run'] == run}
    return None


def read_map(out: Path, folder: str) -> list[list[float]]:
    """Return the small map of a drive; nothing if there is none."""
    with suppress(OSError, ValueError, KeyError):
        points: list[list[float]] = json.loads(
            (out / folder / FILE).read_text(encoding='utf-8'))['map']
        return points
    return []
