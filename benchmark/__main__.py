# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Command line of the benchmark: choose a page or sections of it, measure, report, gate.

    make bench BENCH_ARGS='--quick --gate'
    .venv/bin/python -m benchmark engine.loops engine.batch --case ring
    .venv/bin/python -m benchmark robust.timing --quick
"""

import argparse
from collections.abc import Callable
from dataclasses import asdict, fields
from datetime import date
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
import shlex
import sys
import time
import traceback

from benchmark import metrics, ours, report
from benchmark.section import about, kept_with, Options, say, Section

PAGES = ('engine', 'solve', 'inputs', 'robust', 'window', 'load', 'malformed', 'peers')
"""Modules with a page each: its title, its sections by name, and what it is about."""
FIRST = PAGES[0]


def _parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog='python -m benchmark', formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Measure the engine, requirement by requirement, beside GTSAM or alone.',
        epilog='examples:\n'
        '  --quick --gate                    before a commit: fails and names what got worse\n'
        '  engine.loops --case ring           one section, only worlds whose name holds "ring"\n'
        '  robust --quick                    another page\n'
        '  load --size 1000 --seconds 8      the node with 1000 hidden nodes\n'
        '  --write-baseline                  after a change for the better, on purpose\n')
    parser.set_defaults(**asdict(Options()))
    parser.add_argument('names', nargs='*', default=[FIRST], metavar='NAME',
                        help=f'a page ({", ".join(PAGES)}; default {FIRST}) or sections of one, '
                        'as engine.loops; those that are not made again stay on the page')
    parser.add_argument('--quick', action='store_true', help='small worlds, few drives: minutes')
    parser.add_argument('--case', dest='cases', action='append', default=[], metavar='TEXT',
                        help='only worlds, drives and graphs with TEXT in their names; may be '
                        'given several times; other rows of the page stay')
    parser.add_argument('--repeats', type=int, metavar='N',
                        help='runs of each tool that is timed (default %(default)s)')
    parser.add_argument('--runs', type=int, metavar='N', help='seeded drives of each kind')
    parser.add_argument('--limit', type=float, metavar='SECONDS',
                        help='cut a run of one tool after this time (default %(default)s); '
                        'ratios are then over the steps that were done')
    parser.add_argument('--size', dest='sizes', type=int, nargs='+', metavar='N',
                        help='load: hidden nodes; window.samples: samples of odometry; '
                        'malformed: messages')
    parser.add_argument('--hours', type=float, metavar='H', help='window.day: length of drives')
    parser.add_argument('--rates', type=float, nargs='+', metavar='HZ',
                        help='load: of odometry (default %(default)s)')
    parser.add_argument('--seconds', type=float, metavar='S',
                        help='load: at each rate (default %(default)s)')
    parser.add_argument('--data', type=Path, metavar='DIR',
                        help='folder with public data; what is not there is skipped')
    parser.add_argument('--without-gtsam', dest='gtsam', action='store_false',
                        help='measure ours alone: no ratios')
    parser.add_argument('--out', type=Path, default=None, metavar='DIR',
                        help='folder of the page (default build/benchmark/PAGE)')
    parser.add_argument('--gate', action='store_true',
                        help='compare with benchmark/baseline.json and exit with 1 if anything '
                        'got worse')
    parser.add_argument('--write-baseline', action='store_true',
                        help='write what was measured into benchmark/baseline.json')
    options = parser.parse_args(arguments)
    pages = {name.partition('.')[0] for name in options.names}
    if len(pages) > 1 or not pages <= set(PAGES):
        parser.error(f'expected sections of one page of {", ".join(PAGES)}, got '
                     f'{" ".join(options.names)}')
    options.page, = pages
    options.module = import_module(f'benchmark.{options.page}')
    sections = tuple(options.module.SECTIONS)
    options.sections = [name.partition('.')[2] for name in options.names
                        if name != options.page] or sections
    for name in options.sections:
        if name not in sections:
            parser.error(f'{options.page} has no section {name}, but {", ".join(sections)}')
    if options.repeats < 1 or (options.runs is not None and options.runs < 1):
        parser.error('--repeats, --runs: expected at least 1')
    return options


def _measure(name: str, function: Callable[[Options], Section], options: Options) -> Section:
    """Measure one section; an exception is its result, not the end of the benchmark."""
    begin = time.perf_counter()
    say(f'{name} ...')
    try:
        section = function(options)
    except Exception as error:  # one section must not cost the others
        traceback.print_exc()
        section = Section(name, 'Not measured.', failed=True,
                          notes=[f'{type(error).__name__}: {error}'])
    say(f'{name}: {time.perf_counter() - begin:.1f} s')
    for metric in section.metrics:
        if not metric.reached:
            say(f'  {metric.key}: {metric.value:.4g}{metric.unit}, {metric.status()}')
    return section


def main(arguments: list[str]) -> int:
    """Run the benchmark; return 1 if a section failed or something got worse, 2 without GTSAM."""
    chosen = _parse(arguments)
    if chosen.gtsam and find_spec('gtsam') is None:
        if chosen.page == FIRST:
            say('gtsam is not installed: `make bench` does that, or give --without-gtsam')
            return 2
        chosen.gtsam = False
    out = chosen.out = chosen.out or Path('build/benchmark', chosen.page)
    out.mkdir(parents=True, exist_ok=True)
    options = Options(**{each.name: getattr(chosen, each.name) for each in fields(Options)})
    # folders are others elsewhere
    shown = [word if before not in ('--data', '--out') else before[2:].upper()
             for before, word in zip(['', *arguments], arguments, strict=False)]
    command = shlex.join(['python', '-m', 'benchmark', *shown])

    say('compiling, or loading what has been compiled')
    ours.warm_up()
    made = []
    for name in chosen.sections:
        section = _measure(name, chosen.module.SECTIONS[name], options)
        made.append(section)
        section.notes.append(f'Made on {date.today().isoformat()} by `{command}`.')
        kept = kept_with(out, name, section, tuple(chosen.module.SECTIONS),
                         rows=len(options.cases) > 0)
        path = report.write(
            kept, out, f'python -m benchmark {chosen.page}', title=chosen.module.TITLE,
            about=about(chosen.module),
            curves=[curve for each in made for curve in each.curves])
    figures = [metric for section in made for metric in section.metrics]
    asked = [metric for metric in figures if metric.target is not None]
    say(f'{sum(metric.reached for metric in asked)} of {len(asked)} figures reach what is asked; '
        f'see {path}')

    mode = 'quick' if chosen.quick else 'full'
    worse = metrics.gate(figures, mode) if chosen.gate else []
    if chosen.write_baseline:
        metrics.write_baseline(figures, mode)
    for line in worse:
        say(f'worse: {line}')
    if chosen.gate and len(worse) == 0:
        say('gate: nothing got worse')
    failed = [section.title for section in made if section.failed]
    if failed:
        say(f'failed: {", ".join(failed)}')
    return 1 if worse or failed else 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
