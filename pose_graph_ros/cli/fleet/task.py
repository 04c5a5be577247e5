# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The task of a worker: replay one bag and keep what comes of it, unless that has been done."""

from contextlib import suppress
import json
import logging
from pathlib import Path
import resource
import secrets
import shutil
import time
from typing import Any, NamedTuple

from pose_graph_ros.adapters.bags import one_line
from pose_graph_ros.cli import finite, replay
from pose_graph_ros.cli.fleet import kept, table
from pose_graph_ros.cli.fleet.kept import key_of, read_result
from pose_graph_ros.cli.fleet.recordings import content_of, files_of, local_copy, Recording
from pose_graph_ros.cli.fleet.row import row_of, small_map
from pose_graph_ros.cli.fleet.settings import read_settings, Settings
from pose_graph_ros.cli.report import render
from pose_graph_ros.cli.run import document
from pose_graph_ros.core.exceptions import PoseGraphError


class Task(NamedTuple):
    """What a worker is told."""

    out: str  # folder of the results
    run: str  # name of the call, for what is not finished
    settings: str  # their id
    recording: Recording


def do(task: Task) -> dict[str, Any]:
    """Return the row of a drive with its `content`; one that says why if it cannot be replayed."""
    logging.getLogger('pose_graph_ros').setLevel(logging.ERROR)  # what is odd is in the findings
    content = ''
    try:
        settings = read_settings(Path(task.out), task.settings)
        with local_copy(task.recording) as bag:
            truth = settings.truth_of(task.recording.path)
            content = content_of([*files_of(bag), *([truth] if isinstance(truth, Path) else [])])
            key = key_of(content, settings.id)
            row = read_result(Path(task.out), key, task.run)
            if row is None:
                _replay(task, settings, key, bag)
                row = read_result(Path(task.out), key, task.run)
                assert row is not None, 'it has just been written'
    except (PoseGraphError, OSError) as error:
        row = table.failed_row(one_line(error))
    except Exception as error:  # a mistake in this package, of which the other bags know nothing
        row = table.failed_row(f'{type(error).__name__}: {one_line(error)}')
    return row | {'content': content}


def _replay(task: Task, settings: Settings, key: str, bag: Path) -> None:
    """Replay a bag and keep what comes of it under its key."""
    begin = time.monotonic()
    _forget_peak_memory()
    place = Path(task.out, kept.DRIVES, key)
    # a folder for this attempt: another worker may be at the same bag, or have died at it
    aside = Path(task.out, kept.UNFINISHED, task.run, f'{key}.{secrets.token_hex(4)}')
    options = settings.replay_options(bag, settings.truth_of(task.recording.path))
    done = replay.replayed(options, settings.given)
    told = document.write_files(done.run, aside, {
        **done.facts, 'bags': [task.recording.path]})
    (aside / 'report.html').write_text(render(told), encoding='utf-8')
    row = row_of(done.run, told) | {
        'version': settings.version, 'total_s': time.monotonic() - begin,
        'peak_memory_mb': _peak_memory_mb()}
    sizes = {each.name: each.stat().st_size for each in aside.iterdir()}
    (aside / kept.FILE).write_text(json.dumps(finite({
        'run': task.run, 'sizes': sizes, 'row': row, 'map': small_map(done.run)})) + '\n',
        encoding='utf-8')
    place.parent.mkdir(exist_ok=True)
    try:
        aside.rename(place)
    except OSError:     # something is there
        if read_result(Path(task.out), key) is None:
            shutil.rmtree(place)
            aside.rename(place)


def _forget_peak_memory() -> None:
    """Let the largest memory of this process count from now on, where the system can."""
    with suppress(OSError):
        Path('/proc/self/clear_refs').write_text('5', encoding='ascii')


def _peak_memory_mb() -> float:
    try:
        lines = Path('/proc/self/status').read_text(encoding='ascii').splitlines()
        kib = next(line.split()[1] for line in lines if line.startswith('VmHWM'))
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000.0
    return float(kib) * 1.024e-3
