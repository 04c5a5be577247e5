# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Command line of the benchmark of belief.

    .venv/bin/python -m benchmark.belief --seeds 100-104 --jobs 2 -o belief.md
    .venv/bin/python -m benchmark.belief --seeds 0 --scenarios clean outage --drives good plaza2
"""

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
import itertools
from pathlib import Path
import sys

import numpy as np

from benchmark.belief import engine, peers
from benchmark.belief.odometry import drive, KINDS, RECORDED
from benchmark.belief.scenarios import SCENARIOS
from benchmark.files import DATA
from benchmark.report import environment, markdown
from benchmark.section import about, say, Table
from pose_graph_ros.core.config import CovariancePolicy, MeasurementSource, POSITIONS, Robust
from pose_graph_ros.core.warm_up import warm_up

PEERS = tuple(peers.OURS)
ERRORS = 'oracle', 'knowing', *PEERS, 'ours'
RATIOS = {'ours': ('ours', 'oracle'), 'ours over knowing': ('ours', 'knowing'),
          'ours online': ('ours online', 'oracle online'),
          **{name: (name, 'oracle') for name in PEERS}}
"""What is divided by what."""


@dataclass(frozen=True, slots=True)
class Case:
    """One scenario on one drive."""

    scenario: str
    drive: str
    seed: int
    data: Path


@dataclass(frozen=True, slots=True)
class Found:
    """What came of a case: figures by column, NaN where there is none."""

    case: Case
    figures: dict[str, float]

    def ratio(self, name: str) -> float:
        """Return a ratio of `RATIOS`."""
        above, below = RATIOS[name]
        return self.figures[above] / self.figures[below]

    def row(self) -> tuple[str, ...]:
        """Return the row of the table."""
        return (self.case.scenario, self.case.drive, str(self.case.seed), *(
            f'{value:.3g}' if np.isfinite(value) else '' for value in self.figures.values()))


def measure(case: Case) -> Found:
    """Run ours, the oracles and the peers on a case."""
    clean, scenario = drive(case.drive, case.seed, case.data), SCENARIOS[case.scenario]
    changed = scenario.change(clean, np.random.default_rng((case.seed, 2)))
    right = replace(changed.only_right(), odometry=clean.odometry)
    paths = peers.paths(changed)
    paths['ours'], ours = engine.run(changed, engine.config(POSITIONS))
    paths['oracle'], oracle = engine.run(
        right, engine.config(replace(POSITIONS, robust=Robust.NONE)), changed)
    if case.drive in KINDS:
        told = MeasurementSource(
            covariance=CovariancePolicy(override=(scenario.sigma,)), robust=Robust.NONE,
            correlation_time=scenario.tau)
        paths['knowing'] = engine.at_end(
            right, engine.config(told, KINDS[case.drive].settings()))
    errors = {name: engine.error(path, changed) for name, path in paths.items()}
    return Found(case, {
        **{name: errors.get(name, np.nan) for name in ERRORS}, 'ours online': ours.pop('online'),
        'oracle online': oracle['online'], 'ratio': errors['ours'] / errors['oracle'], **ours})


def page(found: Sequence[Found], command: str) -> str:
    """
    Return a summary by scenario, and all cases, as Markdown.

    Errors are rms of positions to the truth [m], in the map: of the path at the stamps of the
    fixes when all is known, and *online* of the newest pose just after each fix, right or
    wrong, from {engine.SETTLED_S:.0f} s on and once it is in the map. The *oracle* is the same
    engine with defaults, which is given the right fixes alone, all believed, and in *slip*
    odometry without the slip; *knowing* is also told the true noise of odometry and fixes by
    parameters, for simulated drives. Huber, Cauchy and GNC-TLS are those of {peers.SAID}, over
    the whole drive. Ratios are over the oracle, that of *ours online* over the oracle online.
    Nobody can tell which receiver is wrong in *two_all*; the seed chooses it. NEES is of
    positions: 1 if what is claimed is right. Times are of the processor; those per fix are of
    all calls online. What is tuned is tuned on seeds 0 to 4. There is no truth of husky: the
    path by its recorded fixes stands for it.
    """
    summary = Table('Ratios: geometric mean (worst)', ('scenario', 'cases', *RATIOS))
    cases = Table('Cases', ('scenario', 'odometry', 'seed', *found[0].figures))
    for name, group in itertools.groupby(found, lambda one: one.case.scenario):
        rows = list(group)
        summary.rows.append((name, str(len(rows)), *(
            _summed(np.array([one.ratio(ratio) for one in rows])) for ratio in RATIOS)))
        cases.rows.extend(one.row() for one in rows)
    return '\n'.join(['# Belief in positions', '', *environment(command), '', about(page), '',
                      *markdown(summary), *markdown(cases)])


def _summed(ratios: np.ndarray) -> str:
    known = ratios[np.isfinite(ratios)]
    return '' if len(known) == 0 else (
        f'{np.exp(np.mean(np.log(known))):.3f} ({np.max(known):.2f})')


def seeds(text: str) -> range:
    """Return the seeds of `7` or `100-104`."""
    first, _, last = text.partition('-')
    return range(int(first), int(last or first) + 1)


def main() -> None:
    """Measure what the command line asks for, and write the page after each case."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmark.belief',
        description='Measure which fixes are believed, beside an oracle that knows.')
    parser.add_argument('--seeds', nargs='+', type=seeds, default=[seeds('100-104')],
                        metavar='N', help='as 7 or 100-104, which is the default')
    parser.add_argument('--scenarios', nargs='+', choices=SCENARIOS, default=SCENARIOS)
    parser.add_argument('--drives', nargs='+', choices=KINDS | RECORDED, default=KINDS | RECORDED)
    parser.add_argument('--jobs', type=int, default=1, metavar='N', help='processes')
    parser.add_argument('--data', type=Path, default=DATA, metavar='DIR',
                        help='folder with public data; what is not there is skipped')
    parser.add_argument('-o', dest='out', type=Path, metavar='FILE', help='also write the page')
    options = parser.parse_args()
    drives = [name for name in options.drives
              if name in KINDS or (options.data / RECORDED[name]).is_dir()]
    cases = itertools.starmap(Case, itertools.product(
        options.scenarios, drives, itertools.chain(*options.seeds), [options.data]))
    found: list[Found] = []
    paths = '--data', '-o'      # of this machine
    command = ' '.join(['python -m benchmark.belief', *(
        word for before, word in itertools.pairwise(sys.argv)
        if word not in paths and before not in paths)])
    with ProcessPoolExecutor(options.jobs, initializer=warm_up) as pool:
        for one in pool.map(measure, cases):
            found.append(one)
            say(' | '.join(one.row()))
            if options.out is not None:
                options.out.write_text(page(found, command), encoding='utf-8')
    print(page(found, command))


if __name__ == '__main__':
    main()
