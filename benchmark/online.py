# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Online comparison of both tools over one world: time of a step, ratios, excess."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from benchmark import excess, ours
from benchmark.metrics import ACCURACY, Metric, RATIO
from benchmark.runs import interleaved, Plan, Run, sample_steps, Timing, timing
from benchmark.section import Curve, Options, peers, say, Table
from benchmark.worlds import World

TIME_HEADER = ('world', 'nodes', 'closures', 'tool', 'mean', 'p50', 'p99', 'max', 'total s',
               'ratio mean', 'p50', 'p99', 'runs', 'note')
EXCESS_HEADER = ('world', 'samples', 'tool', 'median', 'p95', 'max', 'worst position mm: median',
                 'max', 'in sigmas: median', 'max', 'iteration ms: median', 'max',
                 'final chi2', 'its optimum')
EXCESS_FLOOR = 1e-6
"""Excess below this is none: rounding, where a graph is still a tree."""
POSITION_FLOOR = 1.0
"""Distances below this cannot be seen [mm]."""


@dataclass(frozen=True, slots=True)
class Ratio:
    """GTSAM's time of a step divided by ours, over the steps that both did."""

    mean: float
    p50: float
    p99: float


@dataclass(slots=True)
class Comparison:
    """Runs of all tools over one world, and what became of their samples."""

    world: World
    runs: dict[str, list[Run]]
    judged: dict[str, excess.Excess]
    """Of ours also `ours.REFINED`, in a run of its own."""
    refinement: list[float]
    """Times of the iterations of that [s]."""

    def timing(self, tool: str) -> Timing:
        """Return the figures of a tool's steps."""
        return timing(self.runs[tool])

    def ratio(self, peer: str) -> Ratio:
        """Compare with one of the peers."""
        steps = min(self.runs[peer][0].steps, self.runs[ours.NAME][0].steps)
        theirs, mine = timing(self.runs[peer], steps), timing(self.runs[ours.NAME], steps)
        return Ratio(theirs.mean / mine.mean, theirs.p50 / mine.p50, theirs.p99 / mine.p99)

    @property
    def peers(self) -> list[str]:
        """Names of the tools that ours is compared with."""
        return [name for name in self.runs if name != ours.NAME]


def compare(
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
    tools = {ours.NAME: ours.run} | (peers(options, careful=careful) if gtsam else {})
    steps = sample_steps(world.n_nodes, every) if judge else frozenset()
    runs = interleaved(world, tools, Plan(steps, options.limit), options.repeats)
    judged: dict[str, excess.Excess] = {}
    refinement: list[float] = []
    if judge:
        refined = ours.run_refined(world, Plan(steps, options.limit))
        refinement = refined.refinement
        judged = {run.tool: excess.of_run(world, run)
                  for run in (runs[ours.NAME][0], refined, *(
                      of_tool[0] for name, of_tool in runs.items() if name != ours.NAME))}
    return Comparison(world, runs, judged, refinement)


def time_table(caption: str, comparisons: Iterable[Comparison]) -> Table:
    """Return the times of all tools and the ratios."""
    table = Table(caption, TIME_HEADER)
    for item in comparisons:
        first = (item.world.name, str(item.world.n_nodes), str(item.world.closures()))
        for tool, runs in item.runs.items():
            figures = item.timing(tool)
            ratios = ('', '', '')
            if tool != ours.NAME:
                ratio = item.ratio(tool)
                ratios = (f'{ratio.mean:.1f}', f'{ratio.p50:.1f}', f'{ratio.p99:.1f}')
            table.add(*first, tool, f'{figures.mean:.1f}', f'{figures.p50:.1f}',
                      f'{figures.p99:.0f}', f'{figures.maximum:.0f}', f'{figures.total:.3f}',
                      *ratios, str(len(runs)), runs[0].note)
            first = ('', '', '')
    return table


def excess_table(caption: str, comparisons: Iterable[Comparison]) -> Table:
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


def ratio_metrics(
    row: str, item: Comparison, *, mean: float | None, p99: float | None,
) -> list[Metric]:
    """Return the ratios with their targets."""
    metrics = []
    for peer in item.peers:
        ratio = item.ratio(peer)
        key = f'{row}/{item.world.name}/ratio to {peer}'
        metrics += [
            Metric(f'{key}, mean', ratio.mean, 'x', RATIO, mean, higher_is_better=True),
            Metric(f'{key}, p99', ratio.p99, 'x', RATIO, p99, higher_is_better=True)]
    return metrics


def excess_metrics(
    row: str, item: Comparison, *, asked: bool = True, least_maximum: float = 0.0,
) -> list[Metric]:
    """
    Return our excess.

    Parameters
    ----------
    row : str
    item : Comparison
    asked : bool
        Ask for that of GTSAM's first setting.
    least_maximum : float
        The largest excess may be this in any case.

    """
    if ours.NAME not in item.judged:
        return []
    median, _, highest = item.judged[ours.NAME].figures()
    median_target = highest_target = None
    if asked and len(item.peers) > 0:
        theirs = item.judged[item.peers[0]].figures()
        median_target = max(theirs[0], EXCESS_FLOOR)
        highest_target = max(theirs[2], EXCESS_FLOOR, least_maximum)
    key = f'{row}/{item.world.name}'
    metrics = [
        Metric(f'{key}/excess, median', median, '', ACCURACY, median_target),
        Metric(f'{key}/excess, max', highest, '', ACCURACY, highest_target)]
    refined = item.judged[ours.REFINED]
    peer = item.judged[item.peers[0]] if asked and len(item.peers) > 0 else None
    for name, figure in (('median', np.median), ('max', np.max)):
        target = None if peer is None else max(1e3 * float(figure(peer.worst)), POSITION_FLOOR)
        metrics.append(Metric(f'{key}/worst position when refined, {name}',
                              1e3 * float(figure(refined.worst)), ' mm', ACCURACY, target))
    return metrics


def curves(item: Comparison) -> list[Curve]:
    """Return the excess along the run of each tool."""
    return [Curve('excess', item.world.name, tool, judged.steps, judged.half_chi2)
            for tool, judged in item.judged.items()]
