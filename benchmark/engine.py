# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The smoother beside GTSAM's iSAM2, step by step: chains, loop closures, the floppy case.

Times of steps are in microseconds. Ours is all that a caller from Python pays, an up-to-date
estimate included; of GTSAM only `ISAM2.update` is counted. Runs of the tools are interleaved in
one process, figures are medians over the runs. A ratio is GTSAM's time divided by ours. Excess is
half of chi2 above the batch optimum of the graph so far, each tool under its own error model.
Online beside robot_localization and FusionCore: [filters](filters/README.md).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmark import ours, parts, worlds
from benchmark.metrics import ACCURACY, OPTIMUM, RATIO
from benchmark.phases import phases
from benchmark.runs import (
    interleaved,
    MICROSECOND,
    Plan,
    Run,
    sample_steps,
    timing,
    Tool,
)
from benchmark.section import about, Curve, Options, say, Section, Table
from benchmark.worlds import chain, World
from pose_graph_ros.core.geometry.se2 import FloatArray

TITLE = 'Benchmark: pose_graph_ros against GTSAM'
RATIOS = {1000: 25.0, 10000: 200.0}
"""What is asked of chains, by number of nodes."""
FLATNESS = 1.3
"""Of the p50 from the shortest to the longest chain."""
WORST = 5.0
"""Distance of any node of a chain to the optimum [mm]."""
VARIANT_FACTOR = 3.0
VARIANTS = ('late', 'position', 'dropped')
SAMPLE_EVERY = 53
"""No multiple of the period of the global poses: samples fall on all places between them."""
BINS = 40
"""Of the curve of the time of a step against the size of the graph."""
GRIDS, LOOPS, FLOPPY = 4.0, 8.0, 3.0
"""Ratios that are asked for."""
GRID_NAMES = 'grid', 'm3500', 'manhattan', 'city'
"""What names of walks in a grid hold, in small letters."""
FLOPPY_EXCESS = 0.03
"""Largest excess that is allowed in any case: GTSAM's on ais2klinik."""
FLOPPY_NAMES = ('ais2klinik',)
"""Files that are floppy cases."""
SAMPLES = 15
"""In a quick run, at the most."""
LARGE = 8000
"""Sets with as many nodes are sampled ten times more rarely."""
EXCESS_FLOOR = 1e-6
"""Excess below this is none: rounding, where a graph is still a tree."""
TIME_HEADER = ('world', 'nodes', 'closures', 'tool', 'mean', 'p50', 'p99', 'max', 'total s',
               'ratio mean', 'p50', 'p99', 'runs', 'note')
EXCESS_HEADER = ('world', 'samples', 'tool', 'median', 'p95', 'max', 'worst position mm: median',
                 'max', 'in sigmas: median', 'max', 'iteration ms: median', 'max',
                 'final chi2', 'its optimum')
POSITION_FLOOR = 1.0
"""Distances below this cannot be seen [mm]."""


@dataclass(slots=True)
class Comparison:
    """Runs of all tools over one world, and what became of their samples."""

    world: World
    runs: dict[str, list[Run]]
    judged: dict[str, ours.Excess]
    """Of ours also `ours.REFINED`, in a run of its own."""
    refinement: list[float]
    """Times of the iterations of that [s]."""

    def ratio(self, peer: str) -> FloatArray:
        """Return a peer's mean, p50 and p99 over ours, over the steps that both did."""
        both = [self.runs[name] for name in (peer, ours.NAME)]
        steps = min(runs[0].steps for runs in both)
        theirs, mine = (timing(runs, steps)[:3] for runs in both)
        return np.asarray(theirs / mine)

    @property
    def peers(self) -> list[str]:
        """Names of the tools that ours is compared with."""
        return [name for name in self.runs if name != ours.NAME]


def _compare(
    world: World, options: Options, every: int, *, judge: bool = True, gtsam: bool = True,
    careful: bool = True,
) -> Comparison:
    """
    Run all tools over a world, interleaved.

    Parameters
    ----------
    world : World
    options : Options
    every : int
        Take an estimate after every so many steps.
    judge : bool
        Compare the estimates with batch optima.
    gtsam, careful : bool
        Whether GTSAM runs, and whether also with its careful setting.

    """
    say(f'  {world.name}: {world.n_nodes} nodes, {world.closures()} closures')
    tools: dict[str, Tool] = {ours.NAME: ours.run}
    if gtsam and options.gtsam:
        # the rest of the benchmark can be used without GTSAM
        from benchmark.gtsam_peer import CAREFUL, FAST  # noqa: PLC0415

        tools |= {setting.name: setting for setting in ((FAST, CAREFUL) if careful else (FAST,))}
    steps = sample_steps(world.n_nodes, every) if judge else frozenset()
    runs = interleaved(world, tools, Plan(steps, options.limit), options.repeats)
    judged: dict[str, ours.Excess] = {}
    refinement: list[float] = []
    if judge:
        refined = ours.run_refined(world, Plan(steps, options.limit))
        refinement = refined.refinement
        judged = {run.tool: ours.excess(world, run)
                  for run in (runs[ours.NAME][0], refined, *(
                      of_tool[0] for name, of_tool in runs.items() if name != ours.NAME))}
    return Comparison(world, runs, judged, refinement)


def _time_table(caption: str, comparisons: Iterable[Comparison]) -> Table:
    """Return the times of all tools and the ratios."""
    table = Table(caption, TIME_HEADER)
    for item in comparisons:
        first = (item.world.name, str(item.world.n_nodes), str(item.world.closures()))
        for tool, runs in item.runs.items():
            mean, p50, p99, most, total = timing(runs)
            ratios = ('', '', '') if tool == ours.NAME else (
                f'{ratio:.1f}' for ratio in item.ratio(tool))
            table.add(*first, tool, f'{mean:.1f}', f'{p50:.1f}', f'{p99:.0f}', f'{most:.0f}',
                      f'{total:.3f}', *ratios, str(len(runs)), runs[0].note)
            first = ('', '', '')
    return table


def _excess_table(caption: str, comparisons: Iterable[Comparison]) -> Table:
    """Return what the samples of all tools came to."""
    table = Table(caption, EXCESS_HEADER)
    for item in comparisons:
        first = item.world.name
        for tool, judged in item.judged.items():
            median, p95, highest = judged.figures()
            table.add(first, str(len(judged.steps)), tool, f'{median:.2g}', f'{p95:.2g}',
                      f'{highest:.2g}', f'{1e3 * np.median(judged.worst):.2g}',
                      f'{1e3 * np.max(judged.worst):.2g}', f'{np.median(judged.sigmas):.1g}',
                      f'{np.max(judged.sigmas):.1g}', *(
                          (f'{1e3 * np.median(item.refinement):.2f}',
                           f'{1e3 * np.max(item.refinement):.2f}')
                          if tool == ours.REFINED else ('', '')),
                      f'{judged.final_chi2:.6g}', f'{judged.optimum_chi2:.6g}')
            first = ''
    return table


def _add(
    section: Section, row: str, item: Comparison, *, mean: float | None = None,
    p99: float | None = None, asked: bool = False, least_maximum: float = 0.0,
) -> None:
    """
    Add the ratios and our excess.

    Parameters
    ----------
    section : Section
    row : str
    item : Comparison
    mean, p99 : float, optional, ratios that are asked for
    asked : bool
        Ask for the excess of GTSAM's first setting.
    least_maximum : float
        The largest excess may be this in any case.

    """
    key = f'{row}/{item.world.name}'
    for peer in item.peers:
        means, _, p99s = item.ratio(peer).tolist()
        section.ask(f'{key}/ratio to {peer}, mean', means, 'x', RATIO, least=mean)
        section.ask(f'{key}/ratio to {peer}, p99', p99s, 'x', RATIO, least=p99)
    if ours.NAME not in item.judged:
        return
    theirs = item.judged[item.peers[0]] if asked and len(item.peers) > 0 else None
    median, _, highest = item.judged[ours.NAME].figures()
    targets = (None, None) if theirs is None else (
        max(theirs.figures()[0], EXCESS_FLOOR),
        max(theirs.figures()[2], EXCESS_FLOOR, least_maximum))
    section.ask(f'{key}/excess, median', median, '', ACCURACY, most=targets[0])
    section.ask(f'{key}/excess, max', highest, '', ACCURACY, most=targets[1])
    for name, figure in (('median', np.median), ('max', np.max)):
        target = None if theirs is None else max(1e3 * float(figure(theirs.worst)), POSITION_FLOOR)
        section.ask(f'{key}/worst position when refined, {name}',
                    1e3 * figure(item.judged[ours.REFINED].worst), ' mm', ACCURACY, most=target)


def _tables(section: Section, comparisons: list[Comparison]) -> None:
    section.tables += [_time_table('Time of a step [us]', comparisons),
                       _excess_table('Excess over the batch optimum', comparisons)]


def chains(options: Options) -> Section:
    """
    Measure chains of 1 000 to 1 000 000 nodes.

    Odometry at 10 Hz and a global pose on every tenth node. p50 is asked to be flat, within
    {FLATNESS}x from the shortest to the longest chain.
    """
    section = Section('Chain', about(chains))
    sizes = (1000, 10000, 30000) if options.quick else (1000, 10000, 100000, 1000000)
    comparisons = []
    for world in options.chosen([(f'chain {n}', lambda n=n: chain(n)) for n in sizes]):
        n = world.n_nodes
        every = SAMPLE_EVERY if n == min(RATIOS) or not options.quick else 997
        item = _compare(world, options, every, judge=n in RATIOS, gtsam=n in RATIOS,
                        careful=not options.quick)
        comparisons.append(item)
        _add(section, 'chain', item, mean=RATIOS.get(n))
        _add_worst(section, 'chain', item, WORST)
        section.curves += _time_curves(item)
    _tables(section, comparisons)
    if len(comparisons) > 1:
        p50 = [timing(item.runs[ours.NAME])[1] for item in comparisons]
        section.ask(f'chain/p50, {comparisons[-1].world.name} over {comparisons[0].world.name}',
                    p50[-1] / p50[0], 'x', most=FLATNESS)
    return section


def variants(options: Options) -> Section:
    """
    Measure chains whose global poses are late, without heading, or missing for long.

    The same with global poses 30 nodes late; without heading; none on long stretches. Each is
    asked to take no more than {VARIANT_FACTOR:.0f} times the mean of the prompt case.
    """
    n, every = (3000, 5 * SAMPLE_EVERY) if options.quick else (10000, SAMPLE_EVERY)
    section = Section('Chain: late, position-only, dropped', about(variants))
    comparisons = [_compare(chain(n, variant), options, every, gtsam=not options.quick,
                            careful=False) for variant in ('prompt', *VARIANTS)]
    _tables(section, comparisons)
    table = section.table('Mean against the prompt case', 'world', 'mean us', 'factor')
    means = [timing(item.runs[ours.NAME])[0] for item in comparisons]
    for item, mean in zip(comparisons[1:], means[1:], strict=True):
        table.add(item.world.name, f'{mean:.2f}', f'{mean / means[0]:.2f}')
        section.ask(f'variants/{item.world.name}/over prompt', mean / means[0], 'x',
                    most=VARIANT_FACTOR)
        _add_worst(section, 'variants', item)
        _add(section, 'variants', item)
    return section


def _add_worst(
    section: Section, row: str, item: Comparison, target: float | None = None,
) -> None:
    if ours.NAME in item.judged:
        worst = 1e3 * np.max(item.judged[ours.NAME].worst)
        section.ask(f'{row}/{item.world.name}/worst position', worst, ' mm', ACCURACY, most=target)


def _time_curves(item: Comparison) -> list[Curve]:
    """Return the mean time of a step [us] against the number of nodes, in bins of equal ratio."""
    curves = []
    for tool, runs in item.runs.items():
        seconds: FloatArray = np.median([run.seconds for run in runs], axis=0)
        edges = np.unique(np.geomspace(10, len(seconds), BINS).astype(int))
        means = [float(np.mean(seconds[a:b])) / MICROSECOND for a, b in pairwise(edges)]
        curves.append(Curve(tool, edges[1:].astype(float), np.array(means)))
    return curves


def loops(options: Options) -> Section:
    """
    Measure generated worlds and those of the folder with graph files.

    Asked for: at least {LOOPS:.0f} times GTSAM, and {GRIDS:.0f} times in grids, in the mean and at
    p99, where neither the median nor the maximum of the excess is above that of GTSAM with skip
    10, nor, after a refinement, the largest distance of a node to its place in the optimum.
    """
    section = Section('Loop closures', about(loops))
    return _closing(section, 'loops', [
        world for world in options.closing(section.notes) if world.name not in FLOPPY_NAMES],
        options)


def floppy(options: Options) -> Section:
    """
    Measure the corridor, and ais2klinik where there is a file of that name.

    Weak heading, thousands of nodes swing at a closure. Asked for: at least {FLOPPY:.0f} times
    GTSAM at its excess (or a maximum of {FLOPPY_EXCESS}).
    """
    section = Section('The floppy case', about(floppy))
    n = 2000 if options.quick else 15000
    read = options.file_worlds(section.notes, 0 if options.quick else np.inf)
    return _closing(section, 'floppy', options.chosen([('corridor', lambda: worlds.corridor(n))])
                    + [world for world in read if world.name in FLOPPY_NAMES],
                    options, least_maximum=FLOPPY_EXCESS)


def _closing(
    section: Section, row: str, chosen: list[World], options: Options, *,
    least_maximum: float = 0.0,
) -> Section:
    comparisons = []
    for world in chosen:
        every = 50 if world.n_nodes < LARGE else 500
        if row == 'floppy':
            every = min(every, 250)
        if options.quick:
            every = max(every, world.n_nodes // SAMPLES)
        careful = not options.quick and world.n_nodes < LARGE
        item = _compare(world, options, every, careful=careful)
        comparisons.append(item)
        ratio = FLOPPY if row == 'floppy' else GRIDS if any(
            name in world.name.lower() for name in GRID_NAMES) else LOOPS
        _add(section, row, item, mean=ratio, p99=ratio, asked=True, least_maximum=least_maximum)
        _add_final(section, f'{row}/{world.name}', item)
    _tables(section, comparisons)
    return section


def _add_final(section: Section, key: str, item: Comparison) -> None:
    """Add the best known optimum of the whole graph, and how far above it ours has ended."""
    best = ours.polished(item.world, ours.start_of_batch(item.world))
    judged, left = item.judged[ours.NAME], item.world.n_nodes - item.runs[ours.NAME][0].steps
    if left > 0:
        section.ask(f'{key}/steps left undone', left, most=0.0)
    else:
        best = min(best, judged.optimum_chi2)
        section.ask(f'{key}/final chi2 above it', max(judged.final_chi2 - best, 0.0), '', ACCURACY)
    section.ask(f'{key}/optimum', best, '', OPTIMUM)


SECTIONS = {
    'chain': chains, 'variants': variants, 'back_end': parts.back_end, 'loops': loops,
    'floppy': floppy, 'phases': phases, 'batch': parts.batch, 'covariances': parts.covariances,
    'start': parts.start, 'memory': parts.memory}
