# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a worker does: replay one bag and keep what comes of it, unless that has been done."""

from contextlib import suppress
import fcntl
import functools
import json
import logging
from pathlib import Path
import resource
import secrets
import shutil
import socket
import time
from typing import Any

from pose_graph_ros.adapters.bags import one_line
from pose_graph_ros.cli import finite, replay
from pose_graph_ros.cli.fleet import kept, table
from pose_graph_ros.cli.fleet.kept import key_of, read_result
from pose_graph_ros.cli.fleet.recordings import content_of, files_of, local_copy
from pose_graph_ros.cli.fleet.row import row_of, small_map
from pose_graph_ros.cli.fleet.settings import read_settings, Settings
from pose_graph_ros.cli.fleet.task import Task
from pose_graph_ros.cli.report import render
from pose_graph_ros.cli.run import document
from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.warm_up import warm_up


def result_of(task: Task) -> dict[str, Any]:
    """Return the row of a drive with its `content`; one that says why if it cannot be replayed."""
    logging.getLogger('pose_graph_ros').setLevel(logging.ERROR)  # what is odd is in the findings
    content, bag = '', Path(task.recording.path)
    try:
        settings = read_settings(Path(task.out), task.settings)     # the folder is shared
        _compile_once(Path(task.out))
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
        # the copy of a bag that was fetched is gone, and the path is told anyway
        reason = one_line(error).replace(str(bag), task.recording.path)
        row = table.failed_row(reason.removeprefix(f'{task.recording.path}: '))
    except Exception as error:  # a mistake in this package, of which the other bags know nothing
        row = table.failed_row(f'{type(error).__name__}: {one_line(error)}')
    return row | {'content': content}


@functools.cache
def _compile_once(out: Path) -> None:
    """Compile the solver if it is not, in one of the workers of this machine."""
    if jit.is_cached():
        return
    with (out / f'.compiling.{socket.gethostname()}').open('w', encoding='ascii') as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        if not jit.is_cached():
            warm_up()


def _replay(task: Task, settings: Settings, key: str, bag: Path) -> None:
    """Replay a bag and keep what comes of it under its key."""
    begin = time.monotonic()
    _forget_peak_memory()
    place = Path(task.out, kept.DRIVES, key)
    # a folder for this attempt: another worker may be at the same bag, or have died at it
    aside = Path(task.out, kept.UNFINISHED, task.run, f'{key}.{secrets.token_hex(4)}')
    options = settings.replay_options(bag, settings.truth_of(task.recording.path))
    try:
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
    finally:    # a disk that is full would stay so
        shutil.rmtree(aside, ignore_errors=True)


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
