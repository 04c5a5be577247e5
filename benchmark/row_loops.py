# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of the requirements: loop closures, and the floppy case."""

from collections.abc import Callable

from benchmark import online, ours, streets
from benchmark.metrics import ACCURACY, Metric, OPTIMUM
from benchmark.online import Comparison
from benchmark.section import file_worlds, Options, Section
from benchmark.worlds import laps, World

RATIO = 8.0
FLOPPY_RATIO = 3.0
FLOPPY_EXCESS = 0.03
"""Largest excess that is allowed in any case: GTSAM's on ais2klinik."""
FLOPPY_NAMES = ('ais2klinik',)
"""Files that are floppy cases."""
SAMPLES = 15
"""In a quick run, at the most."""
LARGE = 8000
"""Sets with as many nodes are sampled ten times more rarely."""
QUICK_SIZE = 1300
"""Sets with more nodes and loop closures are left out of quick runs."""

_GENERATED: dict[str, Callable[[], World]] = {
    'laps': laps, 'campus': streets.campus, 'grid': streets.grid, 'drive': streets.drive,
    'city GPS': streets.city}


def measure(options: Options) -> Section:
    """Measure generated worlds and those of the folder with graph files."""
    section = Section(
        'Loop closures',
        f'Asked for: at least {RATIO:.0f} times GTSAM, in the mean and at p99, where neither the '
        'median nor the maximum of the excess is above that of GTSAM with skip 10.')
    worlds = options.chosen((('campus', streets.campus), ('laps', laps),
                             ('grid', lambda: streets.grid(1200)))
                            if options.quick else _GENERATED.items())
    worlds += [world for world in file_worlds(options, section.notes)
               if world.name not in FLOPPY_NAMES
               and not (options.quick and world.n_nodes > QUICK_SIZE)]
    _fill(section, 'loops', worlds, options, ratio=RATIO)
    return section


def measure_floppy(options: Options) -> Section:
    """Measure the corridor, and ais2klinik where there is a file of that name."""
    section = Section(
        'The floppy case',
        f'Weak heading, thousands of nodes swing at a closure. Asked for: at least '
        f'{FLOPPY_RATIO:.0f} times GTSAM at its excess (or a maximum of {FLOPPY_EXCESS}).')
    worlds = options.chosen([('corridor', lambda: streets.corridor(2000 if options.quick else
                                                                   15000))])
    if not options.quick:
        worlds += [world for world in file_worlds(options, section.notes)
                   if world.name in FLOPPY_NAMES]
    _fill(section, 'floppy', worlds, options, ratio=FLOPPY_RATIO, least_maximum=FLOPPY_EXCESS)
    return section


def _fill(
    section: Section, row: str, worlds: list[World], options: Options, *, ratio: float,
    least_maximum: float = 0.0,
) -> None:
    comparisons = []
    for world in worlds:
        every = 50 if world.n_nodes < LARGE else 500
        if row == 'floppy':
            every = min(every, 250)
        if options.quick:
            every = max(every, world.n_nodes // SAMPLES)
        careful = not options.quick and world.n_nodes < LARGE
        item = online.compare(world, options, every, careful=careful)
        comparisons.append(item)
        section.metrics += online.ratio_metrics(row, item, mean=ratio, p99=ratio)
        section.metrics += online.excess_metrics(row, item, least_maximum=least_maximum)
        section.metrics += _final(row, item)
        section.curves += online.curves(item)
    section.tables = [online.time_table('Time of a step [us]', comparisons),
                      online.excess_table('Excess over the batch optimum', comparisons)]


def _final(row: str, item: Comparison) -> list[Metric]:
    """Return the best known optimum of the whole graph, and how far above it ours has ended."""
    best = ours.polished(item.world, ours.start_of_batch(item.world))
    key = f'{row}/{item.world.name}'
    judged, steps = item.judged[ours.NAME], item.runs[ours.NAME][0].steps
    if steps < item.world.n_nodes:
        return [Metric(f'{key}/optimum', best, '', OPTIMUM),
                Metric(f'{key}/steps left undone', item.world.n_nodes - steps, '', None, 0.0)]
    best = min(best, judged.optimum_chi2)
    return [Metric(f'{key}/optimum', best, '', OPTIMUM),
            Metric(f'{key}/final chi2 above it', max(judged.final_chi2 - best, 0.0), '', ACCURACY)]
