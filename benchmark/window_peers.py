# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Beside GTSAM's fixed-lag smoothers: time of a step, and errors of newest pose and window."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmark import excess
from benchmark.metrics import ACCURACY, Metric, RATIO
from benchmark.runs import MICROSECOND, Plan, sample_steps
from benchmark.section import say, Section, Table
from benchmark.window_lag import LagRun, NEVER, Ours, warm_up
from benchmark.worlds import chain, laps, World
from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray

LAG = 200
NODES, QUICK_NODES = 5000, 1200
PER_LAP = 150
"""Nodes of a lap: closures to the lap before are inside the lag."""
RATIO_ASKED = 10.0
NO_LARGER = 1.01
"""Ratio of errors up to which they count as no larger."""
EVERY = 97
"""Steps between samples: no multiple of the period of the fixes, nor of the closures."""
TOGETHER = 20
"""Nodes that we let go at a time, as the back end does."""
SLOW = 2
"""Repeats of what is ten times as slow as the others."""
TIMES = ('world', 'tool', 'mean', 'p50', 'p99', 'max', 'ratio mean', 'p50', 'p99', 'runs', 'note')
ERRORS = ('world', 'tool', 'newest to truth m, mrad', 'window to truth m',
          'newest to optimum mm: rms', 'max', 'window to optimum mm: rms', 'max', 'samples')

THRESHOLDS = (
    'Distances to the optimum are small beside the sigma of the newest position (of both '
    'coordinates together): 0.49 m in the chain of 1200, where 0.7 mm are 0.0014 sigma, and 0.35 m'
    ' in the laps, where 38 mm are 0.11. In the chain `budget` of `SmootherConfig` decides: a '
    'hundredth of it and of `budget_share` gives 0.12 mm in 1.2 times the time of a step, with a '
    'tenth of `alpha`, too, 0.06 mm in 1.4 times, with which it would be less than ten times as '
    'fast. In the laps no threshold brings it below 28 mm: that is the shape at which nodes were '
    'linearized when they left. (Means over the steps of the least time of 7 runs.)')

Tool = Callable[[World, Plan], LagRun]


def worlds(n: int) -> list[World]:
    """Return the worlds: a chain with fixes, a chain with positions, laps with closures."""
    return [chain(n), chain(n, 'position'), laps(n, PER_LAP)]


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of one run."""

    newest: float
    """Position of the newest pose, rms over all steps [m]."""
    heading: float
    """Its heading, rms over all steps [rad]."""
    window: float
    """Positions of the window, rms over the samples [m]."""
    off_newest: FloatArray
    """Distance of the newest pose to the optimum of the unlimited graph, by sample [m]."""
    off_window: FloatArray
    """Distances of the poses of the window to it, of all samples [m]."""


def errors(world: World, run: LagRun) -> Errors:
    """Compare a run with the truth, and with the optima of the unlimited graph."""
    assert world.truth is not None
    steps = len(run.newest)
    off = run.newest - world.truth[:steps]
    to_truth, newest, window = [], [], []
    optimum = _by_gtsam if run.tool.startswith('GTSAM') else _by_ours
    for k, (nodes, poses) in run.samples.items():
        best = optimum(world, k)
        to_truth.append(np.sum((poses - world.truth[nodes])[:, :2]**2, axis=1))
        window.append(np.hypot(*(poses - best[nodes])[:, :2].T))
        newest.append(np.hypot(*(run.newest[k] - best[k])[:2]))
    return Errors(
        _rms(np.hypot(*off[:, :2].T)), _rms(se2.wrap(off[:, 2])),
        float(np.sqrt(np.mean(np.concatenate(to_truth)))), np.array(newest),
        np.concatenate(window))


def _by_ours(world: World, step: int) -> FloatArray:
    assert world.truth is not None
    graph = world.graph(world.truth[:step + 1], step)
    optimizer.optimize(graph, excess.EXACT)
    return graph.poses


def _by_gtsam(world: World, step: int) -> FloatArray:
    # only here: the rest of the benchmark can be used without GTSAM
    from benchmark import gtsam_peer  # noqa: PLC0415

    assert world.truth is not None
    graph = gtsam_peer.whole_graph(world, step)
    best = gtsam_peer.optimum(graph, gtsam_peer.values_of(world.truth[:step + 1]))
    return gtsam_peer.poses_of(best)


def tools(*, quick: bool) -> dict[str, Tool]:
    """Return all that is compared, the first of ours and of the peers first."""
    # only here: the rest of the benchmark can be used without GTSAM
    from benchmark.gtsam_peer import CAREFUL, FAST  # noqa: PLC0415
    from benchmark.window_gtsam import FixedLag  # noqa: PLC0415

    made = [Ours(LAG, TOGETHER), Ours(LAG, 1), Ours(NEVER),
            FixedLag(LAG, FAST), FixedLag(LAG, CAREFUL)]
    if not quick:
        made.append(FixedLag(LAG, None))
    return {tool.name: tool for tool in made}


def section(*, quick: bool, repeats: int, limit: float) -> Section:
    """
    Compare with GTSAM.

    Parameters
    ----------
    quick : bool
    repeats : int, runs of each tool over each world
    limit : float, time after which a run is cut [s]

    """
    n = QUICK_NODES if quick else NODES
    found = Section(
        'Beside GTSAM\'s fixed-lag smoothers',
        f'A lag of {LAG} nodes, {n} steps. Ours lets {TOGETHER} nodes go at a time, as the back '
        f'end does in groups, so it keeps {LAG} to {LAG + TOGETHER}; also one at a time, as '
        'GTSAM. The newest pose is read after each step, and that is '
        'part of its time, as is letting the oldest node go; of GTSAM the building of factors is '
        'not counted. Tools run one after the other in one process, figures are medians over the '
        'runs, ratios are GTSAM\'s time over ours. *Chain*: odometry and a global pose (or only a '
        f'position) on every tenth node. *Laps*: {PER_LAP} nodes a lap, a closure to the lap '
        'before on every fifth node. Errors are of all steps (newest pose to truth) or of '
        'samples; the optimum is that of the unlimited graph at that step, each tool under its '
        f'own error model. Asked for: at least {RATIO_ASKED:.0f} times as fast as the incremental '
        'one in the mean, at no larger error.', notes=[THRESHOLDS])
    times, wrong = Table('Time of a step [us]', TIMES), Table('Errors', ERRORS)
    found.tables = [times, wrong]
    chosen = tools(quick=quick)
    warm_up()
    for world in worlds(n):
        say(f'  {world.name}')
        plan = Plan(sample_steps(n, EVERY), limit)
        runs: dict[str, list[LagRun]] = {name: [] for name in chosen}
        for repeat in range(repeats):
            for name, tool in chosen.items():
                slow = repeat > 0 and float(np.sum(runs[name][0].seconds)) > SLOW
                if not slow or repeat < SLOW:
                    runs[name].append(tool(world, plan if repeat == 0 else Plan(limit=limit)))
        _add(found, world, runs)
    return found


def _add(found: Section, world: World, runs: dict[str, list[LagRun]]) -> None:
    """Add the rows and figures of a world."""
    first = next(iter(runs))
    judged = {name: errors(world, of_tool[0]) for name, of_tool in runs.items()}
    label = world.name
    for name, of_tool in runs.items():
        steps = len(of_tool[0].seconds)
        mean, p50, p99, longest = _timing(of_tool, steps)
        ratios = ('', '', '')
        if name.startswith('GTSAM'):
            mine = _timing(runs[first], steps)
            both = tuple(theirs / own for theirs, own in zip(
                (mean, p50, p99), mine, strict=False))
            ratios = tuple(f'{ratio:.1f}' for ratio in both)
            if 'batch' not in name:
                found.metrics.append(Metric(
                    f'{world.name}/times as fast as {name}', both[0], 'x', RATIO, RATIO_ASKED,
                    higher_is_better=True))
        found.tables[0].add(label, name, f'{mean:.1f}', f'{p50:.1f}', f'{p99:.0f}',
                            f'{longest:.0f}', *ratios, str(len(of_tool)), of_tool[0].note)
        item = judged[name]
        found.tables[1].add(
            label, name, f'{item.newest:.4f}, {1e3 * item.heading:.2f}', f'{item.window:.4f}',
            *(f'{1e3 * figure(off):.2g}' for off in (item.off_newest, item.off_window)
              for figure in (_rms, np.max)), str(len(item.off_newest)))
        say('  ' + ' | '.join(found.tables[0].rows[-1]))
        say('  ' + ' | '.join(found.tables[1].rows[-1]))
        label = ''
    best = min((name for name in runs if name.startswith('GTSAM') and 'batch' not in name),
               key=lambda name: judged[name].newest)
    for what in ('newest', 'window'):
        found.metrics.append(Metric(
            f'{world.name}/error of the {what} to the truth over that of {best}',
            getattr(judged[first], what) / getattr(judged[best], what), '', ACCURACY, NO_LARGER))
        off = f'off_{what}'
        found.metrics.append(Metric(
            f'{world.name}/distance of the {what} to the optimum over that of {best}',
            _rms(getattr(judged[first], off)) / _rms(getattr(judged[best], off)), '', ACCURACY,
            NO_LARGER))


def _timing(runs: list[LagRun], steps: int) -> tuple[float, ...]:
    """Return medians over runs of mean, p50, p99 and maximum over the same steps [us]."""
    rows = []
    for run in runs:
        seconds = run.seconds[LAG + 1:steps] / MICROSECOND
        rows.append((np.mean(seconds), *np.percentile(seconds, (50, 99)), np.max(seconds)))
    return tuple(np.median(rows, axis=0).tolist())


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
