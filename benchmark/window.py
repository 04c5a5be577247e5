# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Measure a graph of which only a window is kept: speed, consistency, memory.

    .venv/bin/python -m benchmark.window --out docs/benchmarks/window
    .venv/bin/python -m benchmark.window --quick --only peers

Each section can be made alone, and says at its end by which command it was. Times are those of
one machine that may have had other work; ratios are of runs right after one another.
"""

import argparse
from collections.abc import Callable
from datetime import date
from pathlib import Path
import shlex
import sys

from benchmark import (
    kept_sections,
    ours,
    report,
    window_consistency,
    window_hall,
    window_memory,
    window_peers,
    window_samples,
)
from benchmark.section import say, Section

SECTIONS: dict[str, Callable[[argparse.Namespace], Section]] = {
    'peers': lambda chosen: window_peers.section(
        quick=chosen.quick, repeats=chosen.repeats, limit=chosen.limit),
    'consistency': lambda chosen: window_consistency.section(
        quick=chosen.quick, seeds=chosen.seeds, cases=chosen.case),
    'day': lambda chosen: window_memory.section(
        hours=chosen.hours or (0.4 if chosen.quick else None), cases=chosen.case,
        folder=chosen.out),
    'hall': lambda chosen: window_hall.section(
        quick=chosen.quick, seeds=chosen.seeds, folder=chosen.out, cases=chosen.case),
    'samples': lambda chosen: window_samples.section(
        chosen.samples or ([100_000] if chosen.quick else [1_000_000, 10_000_000]), chosen.bags)}
ROWS = 'consistency', 'hall'
"""Sections of which rows that are not made again are kept."""


def main(arguments: list[str]) -> int:
    """Run the sections and write the page; return 1 if a figure is not what is asked for."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.window', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--quick', action='store_true', help='short drives, few seeds: minutes')
    parser.add_argument('--only', choices=SECTIONS, action='append', help='only these sections')
    parser.add_argument('--repeats', type=int, default=3, metavar='N',
                        help='peers: runs of each tool over each world (default %(default)s)')
    parser.add_argument('--limit', type=float, default=60.0, metavar='S',
                        help='peers: cut a run after so many seconds (default: %(default)s)')
    parser.add_argument('--seeds', type=int, metavar='N',
                        help='consistency, hall: drives of each kind')
    parser.add_argument('--hours', type=float, metavar='H',
                        help='day: length of the drives (default: 24 hours, unlimited ones 2)')
    parser.add_argument('--samples', type=int, metavar='N', action='append',
                        help='samples of odometry (default: a million and ten million)')
    parser.add_argument('--bags', type=Path, metavar='DIR',
                        help='samples: keep the bags there, and use them again (default: they '
                        'are removed)')
    parser.add_argument('--case', action='append', default=[], metavar='TEXT',
                        help='consistency, day, hall: only what has one of these in its name; '
                        'other rows of the page stay')
    parser.add_argument('--out', type=Path, default=Path('build/benchmark/window'), metavar='DIR')
    chosen = parser.parse_args(arguments)
    chosen.out.mkdir(parents=True, exist_ok=True)
    say('compiling, or loading what has been compiled')
    ours.warm_up()
    for name in chosen.only or SECTIONS:
        say(name)
        section = SECTIONS[name](chosen)
        section.notes.append(f'Made on {date.today().isoformat()} by `python -m '
                             f'benchmark.window {shlex.join(_shown(arguments))}`.')
        sections = kept_sections.merged(
            chosen.out, {name: section}, tuple(SECTIONS),
            rows=name in ROWS and len(chosen.case) > 0)
    return report.conclude(sections, chosen.out, 'benchmark.window', ['--out', 'OUT'],
                           title='A graph that forgets', about=__doc__)


def _shown(arguments: list[str]) -> list[str]:
    """Return the arguments with names for folders, which are others elsewhere."""
    return [arguments[k - 1][2:].upper() if k > 0 and arguments[k - 1] in ('--out', '--bags')
            else argument for k, argument in enumerate(arguments)]


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
