# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Thinning: a robot that drives in one hall for ever, with a graph that does not grow."""

from dataclasses import replace
import time
from typing import NamedTuple

import numpy as np

from benchmark.day import GROWN, SLOWER
from benchmark.drives import nees, off_truth
from benchmark.parts import resident_bytes
from benchmark.recordings import add, drain, Recording, UPDATE_EVERY
from benchmark.section import about, Options, Section
from benchmark.wrong_closures import simulated
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import Robust, ThinningConfig
from pose_graph_ros.offline.simulation.settings import FalseClosures

HOURS, SHARED, QUICK_HOURS, QUICK_SHARED = 8.0, 1.0, 0.5, 0.2
"""Of the drive with the thinned graph, and of those with the whole graph as well [h]."""
CELLS = 1.0, 2.0
"""`ThinningConfig.cell` [m]."""
COMPARISON, LONG = 'comparison', 'long'
"""Cases."""
TENTHS = 10


class Tenth(NamedTuple):
    """What was measured over a tenth of a drive, and at its end."""

    hours: float
    nodes: int
    edges: int
    squared: float
    """Error of the newest pose [m^2]."""
    nees: float
    step: float
    """Mean time of what follows a sample of odometry [ms]."""
    memory: float
    """Of the process [MB]."""


def _drive(hours: float, seed: int) -> Recording:
    return simulated('hall', 3600.0 * hours, seed, false=FalseClosures())


def _run(recording: Recording, thinning: ThinningConfig) -> list[Tenth]:
    """Drive with true closures, all believed."""
    backend = PoseGraphBackend(replace(recording.config(Robust.NONE), thinning=thinning))
    found, steps = list[Tenth](), recording.steps()
    for part in np.array_split(np.arange(len(recording.stamps_ns)), TENTHS):
        squared, claims, spent = list[float](), list[float](), 0.0
        for k in part.tolist():
            step = next(steps)
            begin = time.perf_counter()
            add(backend, *step)
            if k % UPDATE_EVERY == UPDATE_EVERY - 1:
                backend.update()
                drain(backend)
            spent += time.perf_counter() - begin
            if k % UPDATE_EVERY == UPDATE_EVERY - 1:
                off, covariance = off_truth(backend, recording.truth)
                squared.append(off[0]**2 + off[1]**2)
                claims.append(nees(off, covariance))
        found.append(Tenth(
            float(step[0].stamp_ns - recording.stamps_ns[0]) / 3.6e12,
            backend.graph.n_nodes, len(backend.graph.factors.edges), float(np.mean(squared)),
            float(np.mean(claims)), 1e3 * spent / len(part),
            1e-6 * resident_bytes()))
    return found


def section(options: Options) -> Section:
    """
    Compare the thinned graph with the whole one.

    A forklift drives through the aisles of a hall of 28 x 30 m in any order. A hidden node each
    metre, a closure to an earlier drive every 5 m, no fixes, all believed, an update every
    {UPDATE_EVERY} m. Errors are those of the newest pose, the first one being known.
    `thinning.cell` is 1 m or 2 m.
    """
    hours, shared = (QUICK_HOURS, QUICK_SHARED) if options.quick else (HOURS, SHARED)
    n = options.runs or 2
    found = Section('Does the graph grow with the area or with the time?', about(section))
    table = found.table(f'{n} drives of {shared:g} hours', 'graph', 'nodes', 'edges', 'rms [m]',
                        'over whole', 'NEES', 'step, last tenth [ms]')
    long = found.table(f'One drive of {hours:g} hours, {CELLS[-1]:g} m', 'hours', 'nodes',
                       'edges', 'rms [m]', 'NEES', 'mean step [ms]', 'memory [MB]')
    if options.wants(COMPARISON):
        drives, whole = [_drive(shared, seed) for seed in range(n)], 0.0
        for name, config in (('whole', ThinningConfig()), *(
                (f'{cell:g} m', ThinningConfig(cell=cell)) for cell in CELLS)):
            runs = [_run(each, config) for each in drives]
            rms = float(np.sqrt(np.mean([tenth.squared for run in runs for tenth in run])))
            whole = whole or rms
            claims = np.mean([tenth.nees for run in runs for tenth in run])
            table.add(name, str(runs[0][-1].nodes), str(runs[0][-1].edges), f'{rms:.3f}',
                      f'{rms / whole:.3f}', f'{claims:.2f}',
                      f'{np.mean([run[-1].step for run in runs]):.2f}')
            found.ask(f'hall, {name}: rms', rms, ' m')
    if options.wants(LONG):
        tenths = _run(_drive(hours, 0), ThinningConfig(cell=CELLS[-1]))
        for each in tenths:
            long.add(f'{each.hours:.2f}', str(each.nodes), str(each.edges),
                     f'{np.sqrt(each.squared):.3f}', f'{each.nees:.2f}', f'{each.step:.2f}',
                     f'{each.memory:.1f}')
        for name, field, most in (('nodes', 'nodes', GROWN), ('edges', 'edges', GROWN),
                                  ('mean step', 'step', SLOWER), ('memory', 'memory', GROWN)):
            found.ask(f'hall, {name}, last tenth of {hours:g} hours over the second',
                      getattr(tenths[-1], field) / getattr(tenths[1], field), most=most)
    return found
