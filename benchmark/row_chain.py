# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of the requirements: chains of odometry with global poses, and their variants."""

from itertools import pairwise

import numpy as np

from benchmark import online, ours
from benchmark.metrics import ACCURACY, Metric
from benchmark.online import Comparison
from benchmark.runs import MICROSECOND
from benchmark.section import Curve, Options, say, Section, Table
from benchmark.worlds import chain
from pose_graph_ros.core.geometry.se2 import FloatArray

RATIOS = {1000: 25.0, 10000: 200.0}
"""What is asked for, by number of nodes."""
FLATNESS = 1.3
"""Of the p50 from the shortest to the longest chain."""
WORST = 5.0
"""Distance of any node to the optimum [mm]."""
VARIANT_FACTOR = 3.0
VARIANTS = ('late', 'position', 'dropped')
SAMPLE_EVERY = 53
"""No multiple of the period of the global poses: samples fall on all places between them."""
BINS = 40
"""Of the curve of the time of a step against the size of the graph."""


def measure(options: Options) -> Section:
    """Measure chains of 1 000 to 1 000 000 nodes."""
    section = Section(
        'Chain', 'Odometry at 10 Hz and a global pose on every tenth node. p50 is asked to be '
        f'flat, within {FLATNESS}x from the shortest to the longest chain.')
    sizes = (1000, 10000, 30000) if options.quick else (1000, 10000, 100000, 1000000)
    comparisons = []
    for n in sizes:
        world = chain(n)
        if options.wants(world.name):
            short = n in RATIOS
            every = SAMPLE_EVERY if n == min(RATIOS) or not options.quick else 997
            comparisons.append(online.compare(
                world, options, every, judge=short, gtsam=short, careful=not options.quick))
    section.tables = [
        online.time_table('Time of a step [us]', comparisons),
        online.excess_table('Excess over the batch optimum', comparisons)]
    for item in comparisons:
        name, n = item.world.name, item.world.n_nodes
        section.metrics += online.ratio_metrics('chain', item, mean=RATIOS.get(n), p99=None)
        section.metrics += online.excess_metrics('chain', item, asked=False)
        if ours.NAME in item.judged:
            worst = 1e3 * float(np.max(item.judged[ours.NAME].worst))
            section.metrics.append(
                Metric(f'chain/{name}/worst position', worst, ' mm', ACCURACY, WORST))
        section.curves += online.curves(item)
        section.curves += _time_curves(item)
    if len(comparisons) > 1:
        p50 = [item.timing(ours.NAME).p50 for item in comparisons]
        section.metrics.append(Metric(
            f'chain/p50, {comparisons[-1].world.name} over {comparisons[0].world.name}',
            p50[-1] / p50[0], 'x', None, FLATNESS))
    return section


def measure_variants(options: Options) -> Section:
    """Measure chains whose global poses are late, without heading, or missing for long."""
    n, every = (3000, 5 * SAMPLE_EVERY) if options.quick else (10000, SAMPLE_EVERY)
    section = Section(
        'Chain: late, position-only, dropped',
        f'The same with global poses 30 nodes late; without heading; none on long stretches. Each '
        f'is asked to take no more than {VARIANT_FACTOR:.0f} times the mean of the prompt case.')
    if not any(options.wants(chain(2, variant).name) for variant in VARIANTS):
        return section
    comparisons = [
        online.compare(chain(n, variant), options, every, gtsam=not options.quick, careful=False)
        for variant in ('prompt', *VARIANTS)]
    table = Table('Mean against the prompt case', ('world', 'mean us', 'factor'))
    prompt = comparisons[0].timing(ours.NAME).mean
    for item in comparisons[1:]:
        mean = item.timing(ours.NAME).mean
        table.add(item.world.name, f'{mean:.2f}', f'{mean / prompt:.2f}')
        section.metrics.append(Metric(
            f'variants/{item.world.name}/over prompt', mean / prompt, 'x', None, VARIANT_FACTOR))
        worst = 1e3 * float(np.max(item.judged[ours.NAME].worst))
        section.metrics.append(
            Metric(f'variants/{item.world.name}/worst position', worst, ' mm', ACCURACY))
        section.metrics += online.excess_metrics('variants', item, asked=False)
    section.tables = [online.time_table('Time of a step [us]', comparisons), table,
                      online.excess_table('Excess over the batch optimum', comparisons)]
    return section


def _time_curves(item: Comparison) -> list[Curve]:
    """Return the mean time of a step [us] against the number of nodes, in bins of equal ratio."""
    curves = []
    for tool, runs in item.runs.items():
        seconds: FloatArray = np.median([run.seconds for run in runs], axis=0)
        edges = np.unique(np.geomspace(10, len(seconds), BINS).astype(int))
        means = [float(np.mean(seconds[a:b])) / MICROSECOND
                 for a, b in pairwise(edges)]
        curves.append(Curve('step time', 'chain', tool, edges[1:].astype(float), np.array(means)))
    say(f'  {item.world.name}: ours p50 {item.timing(ours.NAME).p50:.2f} us')
    return curves
