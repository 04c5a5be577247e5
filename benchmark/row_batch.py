# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Row of the requirements: batch optimisation, without a guess and from the same start."""

from collections.abc import Callable
import time

import numpy as np

from benchmark import ours, streets
from benchmark.metrics import Metric, OPTIMUM, RATIO
from benchmark.runs import quiet
from benchmark.section import file_worlds, Options, say, Section, Table
from benchmark.worlds import chain, laps, World

TARGET = 5.0
SAME = 1e-6
"""chi2 this much above the best known, as a part of it, is another minimum."""
LONG = 10.0
"""What takes longer is done once [s]."""
ENOUGH = 0.2
"""What is over sooner is done again until it has taken so long in all [s], or ..."""
MORE = 10
"""... so many times as often as asked for."""
QUICK_SIZE = 1300

_HEADER = ('world', 'nodes', 'closures', 'ours, no guess ms', 'GTSAM LM, odometry ms', 'ratio',
           'ours, same start ms', 'GTSAM LM, same start ms', 'ratio', 'best chi2',
           'ours, no guess', 'ours, same start', 'GTSAM, odometry', 'GTSAM, same start', 'runs')


def measure(options: Options) -> Section:
    """Measure all worlds that have loop closures, and one chain."""
    section = Section(
        'Batch',
        f'Whole graphs. Without a guess: our own start included, against GTSAM LM from odometry. '
        f'From the same (chordal) start: the optimisation alone. Asked for: {TARGET:.0f} times '
        'GTSAM in both, and the best known optimum. Best: the lowest that any run here leads to, '
        'all of them under our error model; the chi2 of GTSAM are under its own.')
    n = {'grid': 1200, 'chain': 1000} if options.quick else {'grid': 3500, 'chain': 10000}
    worlds = [(f'chain {n["chain"]}', lambda: chain(n['chain'])), ('campus', streets.campus),
              ('laps', laps), ('grid', lambda: streets.grid(n['grid']))]
    if not options.quick:
        worlds += [('drive', streets.drive), ('corridor', streets.corridor),
                   ('city GPS', streets.city)]
    ours.warm_up_batch()
    table = Table('', _HEADER)
    section.tables.append(table)
    for world in options.chosen(worlds) + [
            world for world in file_worlds(options, section.notes)
            if not (options.quick and world.n_nodes > QUICK_SIZE)]:
        say(f'  {world.name}')
        _measure_world(section, table, world, options)
    return section


def _measure_world(section: Section, table: Table, world: World, options: Options) -> None:
    odometry, same = world.dead_reckoning(), ours.start_of_batch(world)
    nothing = world.graph(odometry)
    from_same = world.graph(same)

    def own() -> float:
        nothing.set_poses(odometry)
        return ours.solve_from_nothing(nothing)

    def own_same() -> float:
        from_same.set_poses(same)
        return ours.solve(from_same)

    jobs: dict[str, Callable[[], float]] = {'nothing': own, 'same': own_same}
    ends = {}
    if options.gtsam:
        # the rest of the benchmark can be used without GTSAM
        from benchmark import gtsam_peer  # noqa: PLC0415

        factors = gtsam_peer.whole_graph(world)
        starts = {'odometry': gtsam_peer.values_of(odometry),
                  'lm same': gtsam_peer.values_of(same)}

        def peer(name: str) -> Callable[[], float]:
            def job() -> float:
                ends[name] = gtsam_peer.optimize(factors, starts[name])
                return 2.0 * float(factors.error(ends[name]))
            return job

        jobs |= {name: peer(name) for name in starts}

    times, chi2 = _timed(jobs, options.repeats)
    best = min(chi2['nothing'], chi2['same'],
               *(ours.polished(world, gtsam_peer.poses_of(values)) for values in ends.values()))
    key = f'batch/{world.name}'
    ratios = {'nothing': '', 'same': ''}
    for mine, theirs in (('nothing', 'odometry'), ('same', 'lm same')):
        if theirs in times:
            ratio = times[theirs] / times[mine]
            ratios[mine] = f'{ratio:.1f}'
            section.metrics.append(Metric(
                f'{key}/ratio, {"no guess" if mine == "nothing" else "same start"}', ratio, 'x',
                RATIO, TARGET, higher_is_better=True))
    section.metrics += [
        Metric(f'{key}/chi2, no guess', chi2['nothing'], '', OPTIMUM),
        Metric(f'{key}/above the best known', (chi2['nothing'] - best) / max(best, 1.0),
               '', None, SAME)]
    ms = {name: f'{1e3 * value:.2f}' for name, value in times.items()}
    found = {name: f'{value:.7g}' for name, value in chi2.items()}
    table.add(
        world.name, str(world.n_nodes), str(world.closures()), ms['nothing'],
        ms.get('odometry', ''), ratios['nothing'], ms['same'], ms.get('lm same', ''),
        ratios['same'], f'{best:.7g}', found['nothing'], found['same'],
        found.get('odometry', ''), found.get('lm same', ''), str(options.repeats))


def _timed(
    jobs: dict[str, Callable[[], float]], repeats: int,
) -> tuple[dict[str, float], dict[str, float]]:
    """Run all jobs in turns, short ones oftener; return median times [s] and the last results."""
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    results = {}
    with quiet():
        for turn in range(repeats * MORE):
            for name, job in jobs.items():
                taken = seconds[name]
                if taken and (taken[0] > LONG or (turn >= repeats and sum(taken) > ENOUGH)):
                    continue
                begin = time.perf_counter()
                results[name] = job()
                seconds[name].append(time.perf_counter() - begin)
    return {name: float(np.median(values)) for name, values in seconds.items()}, results
