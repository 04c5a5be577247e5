# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
`pose-graph solve` beside a GTSAM script, both as whole processes, from start to exit.

    .venv/bin/python -m benchmark.solve --data ../shared/data/graphs

For each file GTSAM's starts and optimisers are tried first; those that reach its own optimum, to a
relative 1e-6, are the peers, and the fastest of them is compared. GTSAM's error is not (3.48), so
its optimum is the one that it reaches from our result. Then our tool, with and without the
certificate, and the peer take turns. Both read the file and write the result as g2o.
"""

import argparse
from itertools import product
import os
from pathlib import Path
import re
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

from benchmark.files import DEFAULT_FOLDER

FILES = {'ring.g2o': (11.163100832, 'g2o'), 'intel_vertigo.g2o': (546.461111602, 'g2o'),
         'CSAIL_P_toro.graph': (38.956285872, 'toro'),
         'input_M3500_g2o.g2o': (137.912950936, 'g2o'), 'M3500a.g2o': (912.115012171, 'toro'),
         'city10000.g2o': (511.985163635, 'g2o')}
"""Known optima, and the order of the information."""
STARTS, METHODS = ('lago', 'chordal', 'file'), ('gn', 'lm')
SAME = 1e-6
"""Relative difference of chi2 from the optimum."""
PEER = Path(__file__).with_name('solve_peer.py')
PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'benchmarks' / 'solve' / 'README.md'


HEAD = """\
# `pose-graph solve` beside a GTSAM script

`.venv/bin/python -m benchmark.solve`

Whole processes, from start to exit, in turns: `pose-graph solve FILE -o OUT`, the same with
`--no-certificate`, and [a script](../../../benchmark/solve_peer.py) around GTSAM 4.3.0 that reads
the file, starts, optimises and writes the result. For each file the script has the start (lago,
chordal, poses of the file) and the optimiser (Gauss-Newton, Levenberg-Marquardt) with which it is
fastest of those with which it reaches the optimum of its own error to 1e-6. Ours is the known one
to 1e-6 in each run. Times in ms, least / median of {repeats} runs, with one thread. The ratio is
that of the least times, GTSAM's over ours with the certificate; above 1 ours is faster.
Other work on the machine is felt less by the processor time than by the wall time.

| file | wall, ours | no certificate | GTSAM | ratio | processor, ours | no certificate | GTSAM \
| ratio | GTSAM's way |
|---|---|---|---|---|---|---|---|---|---|
"""


class Run(NamedTuple):
    """One process."""

    wall: float
    """From start to exit [s]."""
    processor: float
    """User and system time of it [s]."""
    chi2: float
    """As printed; NaN if it failed."""


def run(command: list[str]) -> Run:
    """Run a program that prints chi2 first, or behind the word `chi2` of a line."""
    before, begin = os.times(), time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall, after = time.perf_counter() - begin, os.times()
    spent = (after.children_user + after.children_system
             - before.children_user - before.children_system)
    found = re.search(r'(?m)^(?:chi2 )?(\d[\d.e+-]*)[ ,]', done.stdout if (
        command[1] == str(PEER)) else '\n'.join(
            line for line in done.stdout.splitlines() if line.startswith('chi2')))
    return Run(wall, spent, float(found[1]) if found and done.returncode == 0 else float('nan'))


def tool(path: Path, out: Path, *options: str) -> list[str]:
    """Return the command of our tool."""
    launcher = Path(sys.executable).with_name('pose-graph')
    return [str(launcher), 'solve', str(path), '-o', str(out), *options]


def peer(path: Path, out: Path, order: str, start: str, method: str) -> list[str]:
    """Return the command of the script around GTSAM."""
    return [sys.executable, str(PEER), str(path), str(out), order, start, method]


def least(runs: list[Run], field: str) -> float:
    """Return the least time of several runs."""
    return float(min(getattr(each, field) for each in runs))


def median(runs: list[Run], field: str) -> float:
    """Return the median time of several runs."""
    return float(sorted(getattr(each, field) for each in runs)[len(runs) // 2])


def best_peer(path: Path, order: str, folder: Path) -> tuple[list[str], float] | None:
    """Return the fastest command that reaches GTSAM's optimum, and how far that is from it."""
    ours = folder / 'ours.g2o'
    run(tool(path, ours, '--no-certificate'))
    # the optimum of its own error: from our poses, with the edges of the file
    start = folder / 'start.g2o'
    start.write_text('\n'.join(
        [line for line in ours.read_text(encoding='ascii').splitlines() if 'VERTEX' in line]
        + [line for line in path.read_text(encoding='ascii').splitlines() if 'EDGE' in line])
        + '\n', encoding='ascii')
    optimum = run(peer(start, folder / 'gtsam.g2o', order, 'file', 'lm')).chi2
    good = []
    for start, method in product(STARTS, METHODS):
        command = peer(path, folder / 'gtsam.g2o', order, start, method)
        runs = [run(command) for _ in range(3)]
        difference = abs(runs[0].chi2 / optimum - 1.0)
        if difference < SAME:
            good.append((least(runs, 'processor'), command, difference))
    if len(good) == 0:
        return None
    _, command, difference = min(good)
    return command, difference


def compare(path: Path, optimum: float, order: str, repeats: int) -> str:
    """Return the line of a file in the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        found = best_peer(path, order, folder)
        commands = {'ours': tool(path, folder / 'ours.g2o'),
                    'bare': tool(path, folder / 'ours.g2o', '--no-certificate')}
        if found is not None:
            commands['gtsam'] = found[0]
        runs: dict[str, list[Run]] = {each: [] for each in commands}
        for _ in range(repeats):
            for each, command in commands.items():
                runs[each].append(run(command))
    if not all(abs(each.chi2 / optimum - 1.0) < SAME for each in runs['ours'] + runs['bare']):
        raise SystemExit(f'{path}: not the known optimum')
    cells = [path.name]
    for field in ('wall', 'processor'):
        cells += [f'{1e3 * least(runs[each], field):.0f} / {1e3 * median(runs[each], field):.0f}'
                  if each in runs else 'none' for each in ('ours', 'bare', 'gtsam')]
        if found is not None:
            cells += [f'**{least(runs["gtsam"], field) / least(runs["ours"], field):.2f}**']
        else:
            cells += ['']
    cells.append(' '.join(found[0][-2:]) if found is not None else '')
    return f'| {" | ".join(cells)} |'


def main() -> None:
    """Measure, print and write the page."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--data', type=Path, default=DEFAULT_FOLDER, help='folder with the files')
    parser.add_argument('--repeats', type=int, default=9)
    parser.add_argument('--only', default='', help='files whose names hold this')
    parser.add_argument('--no-page', action='store_true', help='print the table only')
    options = parser.parse_args()
    lines = []
    for name, (optimum, order) in FILES.items():
        if options.only in name and (options.data / name).is_file():
            lines.append(compare(options.data / name, optimum, order, options.repeats))
            print(lines[-1], flush=True)
    if not options.no_page:
        PAGE.parent.mkdir(parents=True, exist_ok=True)
        PAGE.write_text(page(lines, options.repeats), encoding='utf-8')


def page(lines: list[str], repeats: int) -> str:
    """Return the text of the page."""
    head = HEAD.format(repeats=repeats)
    return head + '\n'.join(lines) + '\n'


if __name__ == '__main__':
    main()
