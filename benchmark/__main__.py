# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Command line of the benchmark: choose the rows, measure, report, and compare with the baseline.

    make bench BENCH_ARGS='--quick --gate'
    .venv/bin/python -m benchmark --only loops/ring --only batch
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
import shlex
import sys
import time
import traceback

from benchmark import (
    metrics,
    ours,
    report,
    row_back_end,
    row_batch,
    row_chain,
    row_loops,
    row_resources,
)
from benchmark.files import DEFAULT_FOLDER
from benchmark.section import Options, say, Section

ROWS: dict[str, Callable[[Options], Section]] = {
    'chain': row_chain.measure,
    'variants': row_chain.measure_variants,
    'back_end': row_back_end.measure,
    'loops': row_loops.measure,
    'floppy': row_loops.measure_floppy,
    'batch': row_batch.measure,
    'covariances': row_resources.measure_covariances,
    'start': row_resources.measure_start,
    'memory': row_resources.measure_memory,
}
REPEATS = 3


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='python -m benchmark', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Measure the engine against GTSAM, requirement by requirement.',
        epilog='rows: ' + ', '.join(ROWS) + '\n\n'
        'examples:\n'
        '  --quick --gate            before a commit: fails and names what got worse\n'
        '  --only loops/ring         one row, only worlds whose name holds "ring"\n'
        '  --data FOLDER             with the graph files of that folder (.g2o, TORO .graph)\n'
        '  --write-baseline          after a change for the better, on purpose\n')
    parser.add_argument('--quick', action='store_true',
                        help='small worlds: under 2 minutes on 2 cores')
    parser.add_argument('--only', metavar='ROW[/WORLD]', action='append', default=[],
                        help='measure this row alone, and of it only the worlds whose names hold '
                        'WORLD; may be given several times')
    parser.add_argument('--repeats', type=int, metavar='N', default=REPEATS,
                        help='runs of each tool over each world (default %(default)s); what '
                        'takes over a minute is run once')
    parser.add_argument('--limit', type=float, default=200.0, metavar='SECONDS',
                        help='cut a run of one tool over one world after this time (default '
                        '%(default)s); ratios are then over the steps that were done')
    parser.add_argument('--data', type=Path, metavar='FOLDER',
                        help='folder with graph files (default: that of the shared data, where '
                        'it exists)')
    parser.add_argument('--without-gtsam', action='store_true',
                        help='measure ours alone: no ratios')
    parser.add_argument('--out', type=Path, default=Path('build/benchmark'), metavar='DIR',
                        help='folder for README.md, metrics.json and pictures (default '
                        '%(default)s; docs/benchmarks is the committed one)')
    parser.add_argument('--gate', action='store_true',
                        help='compare with benchmark/baseline.json and exit with 1 if anything '
                        'got worse')
    parser.add_argument('--write-baseline', action='store_true',
                        help='write what was measured into benchmark/baseline.json')
    options = parser.parse_args(arguments)
    for name in options.only:
        if name.partition('/')[0] not in ROWS:
            parser.error(f'--only {name}: there is no such row; rows are {", ".join(ROWS)}')
    if options.repeats < 1:
        parser.error(f'--repeats: expected at least 1, got {options.repeats}')
    if options.data is not None and not options.data.is_dir():
        parser.error(f'--data: {options.data} is no folder')
    return options


def _measure(name: str, options: Options) -> Section:
    """Measure one row; an exception is its result, not the end of the benchmark."""
    begin = time.perf_counter()
    say(f'{name} ...')
    try:
        section = ROWS[name](options)
    except Exception as error:  # one row must not cost the others
        traceback.print_exc()
        section = Section(name, 'Not measured.', failed=True,
                          notes=[f'{type(error).__name__}: {error}'])
    say(f'{name}: {time.perf_counter() - begin:.1f} s')
    for metric in section.metrics:
        if not metric.reached:
            say(f'  {metric.key}: {metric.value:.4g}{metric.unit}, {metric.status()}')
    return section


def main(arguments: list[str]) -> int:
    """Run the benchmark; return 1 if a row failed or something got worse, 2 without GTSAM."""
    chosen = _parse(arguments)
    folder = chosen.data or (DEFAULT_FOLDER if DEFAULT_FOLDER.is_dir() else None)
    if not chosen.without_gtsam and find_spec('gtsam') is None:
        say('gtsam is not installed: `make bench` does that, or give --without-gtsam')
        return 2
    options = Options(chosen.quick, chosen.repeats, folder, limit=chosen.limit,
                      gtsam=not chosen.without_gtsam)
    wanted: dict[str, tuple[str, ...]] = {}
    for name in chosen.only or ROWS:
        row, _, world = name.partition('/')
        wanted[row] = (*wanted.get(row, ()), *([world] if world else []))

    say('compiling, or loading what has been compiled')
    ours.warm_up()
    sections = [_measure(row, replace(options, worlds=worlds)) for row, worlds in wanted.items()]
    figures = [metric for section in sections for metric in section.metrics]
    command = shlex.join(['python', '-m', 'benchmark', *arguments])
    path = report.write(sections, chosen.out, command)
    say(f'{report.summary(figures)}; see {path}')

    failed = [section.title for section in sections if section.failed]
    mode = 'quick' if chosen.quick else 'full'
    worse = metrics.gate(figures, mode) if chosen.gate else []
    if chosen.write_baseline:
        metrics.write_baseline(figures, mode)
    for line in worse:
        say(f'worse: {line}')
    if chosen.gate and len(worse) == 0:
        say('gate: nothing got worse')
    if failed:
        say(f'failed: {", ".join(failed)}')
    return 1 if worse or failed else 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
