# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A call of the tool: what is missing is done, the rest is kept, and all is put together."""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
import fcntl
import json
from pathlib import Path
import secrets
import shutil
import sys
from typing import Any

from tqdm import tqdm

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import backend_config
from pose_graph_ros.cli import shared
from pose_graph_ros.cli.fleet import overview, sweep, table
from pose_graph_ros.cli.fleet.kept import key_of, read_map, read_result, UNFINISHED
from pose_graph_ros.cli.fleet.recordings import find_recordings, Recording, stamp_of
from pose_graph_ros.cli.fleet.settings import BESIDE, OF_BAGS, Settings
from pose_graph_ros.cli.fleet.sweep import Point, SCORES
from pose_graph_ros.cli.fleet.task import Task
from pose_graph_ros.core.exceptions import ConfigError, PoseGraphError
from pose_graph_ros.core.io.atomic_files import write_files

CONTENTS = 'contents.json'  # digests of bags by path, with the stamps for which they hold
LOG = 'workers.log'
HELD_OUT = 5  # of so many fixes one, if a sweep is to score them and nothing is said
Row = dict[str, Any]


def run(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    points, n_wrong = _points(options)
    recordings = find_recordings(options.bags, options.out)
    options.out.mkdir(parents=True, exist_ok=True)
    with _alone_in(options.out):
        results = Results(options.out, recordings, points)
        stopped: BaseException | None = None
        try:
            _do(results, options)
        except (KeyboardInterrupt, PoseGraphError) as error:
            stopped = error
        finally:
            results.keep_contents()
        # a table of nothing is worth less than that of the call before
        if stopped is None or len(results.found) > 0 or not (options.out / table.FILE).exists():
            _write(results, options)
        if stopped is not None:
            print(f'stopped with {len(results.missing)} to do; the same call goes on with these',
                  file=sys.stderr)
            raise stopped
    return int(n_wrong > 0 or any(row['status'] != table.CONVERGED for row in results.rows))


def _points(options: argparse.Namespace) -> tuple[list[tuple[Point, Settings]], int]:
    """Return the points of the sweep with their settings, or one point; and how many are wrong."""
    given = shared.given_parameters(options)
    is_sweep = len(options.sweep) > 0
    if isinstance(options.truth, Path) and not str(options.truth).startswith(BESIDE):
        if BESIDE in str(options.truth):
            raise ConfigError(f'--truth {options.truth}: expected {BESIDE} at its begin, as it '
                              'stands for the whole path of the bag without its suffix')
        options.truth = options.truth.absolute()
    if is_sweep and options.score == 'truth' and options.truth is None:
        raise ConfigError('--score truth: expected --truth, which says where it is')
    if is_sweep and options.score == 'held-out' and options.hold_out == 0:
        options.hold_out = HELD_OUT
    if options.hold_out == 1 or options.hold_out < 0:
        raise ConfigError(f'--hold-out: expected 0 or at least 2, got {options.hold_out}')
    if not is_sweep and options.trials is not None:
        raise ConfigError('--trials: expected --sweep, which says between what')
    wanted = sweep.points_of(options.sweep, options.trials, options.seed) if is_sweep else [{}]
    points, errors = dict[str, tuple[Point, Settings]](), list[ConfigError]()
    for point in wanted:
        try:
            settings = Settings({**given, **point}, {
                name: getattr(options, name) for name in OF_BAGS})
            backend_config(checked(settings.given))     # what no bag can be replayed with
            points.setdefault(settings.id, (point, settings))
        except ConfigError as error:
            errors.append(error)
    if len(points) == 0:
        raise errors[0]
    for text in dict.fromkeys(map(str, errors)):
        print(f'left out: {text}', file=sys.stderr)
    return [*points.values()], len(errors)


@dataclass
class Results:
    """What is known of all drives of a call."""

    out: Path
    recordings: Sequence[Recording]
    points: Sequence[tuple[Point, Settings]]
    found: dict[tuple[int, str], Row] = field(default_factory=dict)  # by point and path of the bag
    contents: dict[str, list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with suppress(OSError, ValueError, AttributeError):     # else all bags are read again
            self.contents = {path: each for path, each in json.loads(
                (self.out / CONTENTS).read_text(encoding='utf-8')).items()
                if isinstance(each, list) and len(each) == 2}
        for k, (_, settings) in enumerate(self.points):
            for each in self.recordings:
                stamp, content = self.contents.get(each.path, ['', ''])
                if stamp != '' and stamp == _stamp(each, settings) and (
                        row := read_result(self.out, key_of(content, settings.id))) is not None:
                    self.add(k, each, row)

    def add(self, point: int, recording: Recording, row: Row) -> None:
        """Add the row of a drive."""
        values = self.points[point][0]
        content = row.get('content', '')
        row = row | {'name': recording.name, 'bag': recording.path,
                     'is_new': bool(row.get('is_new')),
                     'parameters': json.dumps(values) if len(values) > 0 else ''}
        self.found[point, recording.path] = {
            each.name: row.get(each.name) for each in table.COLUMNS}
        if content != '':
            stamp = _stamp(recording, self.points[point][1])
            self.contents[recording.path] = [stamp, content]

    @property
    def missing(self) -> list[tuple[int, Recording]]:
        """Drives without a row."""
        return [(k, each) for each in self.recordings for k in range(len(self.points))
                if (k, each.path) not in self.found]

    @property
    def rows(self) -> list[Row]:
        """All rows, by point and then as the bags were named."""
        return [row for k in range(len(self.points)) for row in self.of_point(k)]

    def of_point(self, point: int) -> list[Row]:
        """Rows of a point."""
        return [row for each in self.recordings
                if (row := self.found.get((point, each.path))) is not None]

    def keep_contents(self) -> None:
        """Write which contents bags have, so that they need not be read again."""
        write_files({self.out / CONTENTS: json.dumps(self.contents, indent=0).encode()})


def _stamp(recording: Recording, settings: Settings) -> str:
    """Return another text if the bag or the file of its truth may have changed; '' if unknown."""
    truth = settings.truth_of(recording.path)
    files = [truth] if isinstance(truth, Path) else []
    if not all(each.is_file() for each in files):   # maybe only workers see it
        return ''
    return recording.stamp and recording.stamp + stamp_of(files)


def _do(results: Results, options: argparse.Namespace) -> None:
    """Do what is missing."""
    todo = results.missing
    if len(todo) == 0:
        return
    from pose_graph_ros.cli.fleet import cluster  # noqa: PLC0415  (Dask takes time to load)

    for _, settings in results.points:
        settings.write(results.out)
    name = secrets.token_hex(4)
    asked: dict[Task, tuple[int, Recording]] = {Task(
        str(results.out.absolute()), name, results.points[k][1].id, each): (k, each)
        for k, each in todo}
    told, unfinished = set[str](), results.out / UNFINISHED
    shutil.rmtree(unfinished, ignore_errors=True)   # of calls that were killed
    try:
        log = results.out / LOG
        log.unlink(missing_ok=True)
        with cluster.connected(options.scheduler, options.workers, log) as client:
            print(f'dashboard: {client.dashboard_link}', flush=True)
            print(f'{len(todo)} drives to replay, {len(results.found)} kept', flush=True)
            if options.scheduler is not None and len(client.scheduler_info()['workers']) == 0:
                print('waiting for workers', file=sys.stderr)
            for task, row in shared.watched(cluster.results(client, asked), desc='replaying',
                                            total=len(todo), unit='drive'):
                k, recording = asked[task]
                results.add(k, recording, row)
                line = f'failed: {recording.path}: {row["reason"]}'
                if row['status'] == table.FAILED and line not in told:  # at another point
                    told.add(line)
                    tqdm.write(line, file=sys.stderr)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _write(results: Results, options: argparse.Namespace) -> None:
    """Write the table, the overview and what came of a sweep, and say so."""
    rows, out, best, written = results.rows, results.out, 0, [table.FILE]
    table.write_table(rows, out)
    found = list[sweep.Scored]()
    if len(options.sweep) > 0:
        found = _scores(results, options)
        best = next(k for k, (point, _) in enumerate(results.points)
                    if point is found[0].parameters)
        print('\n'.join(sweep.lines(found)))
        if found[0].drives > 0:
            sweep.write(found, shared.given_parameters(options), options.score, out)
            written += [sweep.TABLE, sweep.BEST]
        else:
            print(f'no drive has a score ({options.score}), so no point is the best',
                  file=sys.stderr)
    page = overview.write_overview(
        results.of_point(best), out, lambda row: read_map(out, row['folder']),
        title=out.absolute().name, subtitle=_subtitle(options),
        points=[each._asdict() for each in found])
    counts = [('replayed', sum(row['is_new'] for row in rows)),
              ('kept', sum(not row['is_new'] and row['status'] != table.FAILED for row in rows)),
              ('failed', sum(row['status'] == table.FAILED for row in rows))]
    print(f'{len(rows)} drives: ' + ', '.join(f'{count} {what}' for what, count in counts))
    print(f'written: {page}, {", ".join(written)}')


def _scores(results: Results, options: argparse.Namespace) -> list[sweep.Scored]:
    column = SCORES[options.score]
    return sweep.scored([point for point, _ in results.points], [
        {row['bag']: row.get(column) for row in results.of_point(k)}
        for k in range(len(results.points))])


def _subtitle(options: argparse.Namespace) -> str:
    if len(options.sweep) == 0:
        return ''
    to = {'held-out': 'fixes that are held out', 'truth': 'the truth'}[options.score]
    return f'the best point of a sweep, by the rms error of the path to {to} [m]'


@contextmanager
def _alone_in(out: Path) -> Iterator[None]:
    """Hold a folder against other calls; raises `ConfigError` if one of them holds it."""
    with (out / '.lock').open('w', encoding='ascii') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(f'{out}: another pose-graph fleet is at work here') from error
        yield
