# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How long updates and the work between them take while closures are judged.

Two back ends, one that judges and one that believes everything, get the same samples in turn.
Times are those of the processor, which other processes change least.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
import time

import numpy as np

from benchmark import worlds
from benchmark.parts import resident_bytes
from benchmark.recordings import add, CLOSURES, closures, Recording
from benchmark.section import about, Options, Section
from benchmark.wrong_closures import of_world, simulated, with_false
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import Robust
from pose_graph_ros.core.warm_up import warm_up

LONGEST, SLOWER = 0.05, 1.3
"""What is asked for: longest update [s], and mean time of a step beside one without judging."""
IDLE = 0.01
"""Time for the work after each update, at least one slice [s]; a robot has more."""
BATCH = 100
"""Wrong closures that come with one update when very many wait."""
LARGE, FLOOD = 10_000, 100_000
"""Nodes of a drive, and further wrong closures."""


@dataclass(slots=True)
class Timed:
    """A back end, and what its calls have taken [s]."""

    backend: PoseGraphBackend
    updates: list[float] = field(default_factory=list)
    slices: list[float] = field(default_factory=list)
    steps: list[float] = field(default_factory=list)
    """Updates with the work after each."""

    def update(self, idle: float) -> None:
        """Update, then work for a while."""
        begin = start = time.thread_time()
        self.backend.update()
        self.updates.append(time.thread_time() - start)
        left, finished = idle, False
        while left > 0.0 and not finished:
            start = time.thread_time()
            finished = self.backend.refine().finished
            self.slices.append(time.thread_time() - start)
            left -= self.slices[-1]
        self.steps.append(time.thread_time() - begin)


def drive(recording: Recording, kinds: Sequence[Robust]) -> list[Timed]:
    """Feed a recording to back ends of some kinds, one sample to each in turn."""
    runs = [Timed(PoseGraphBackend(recording.config(kind))) for kind in kinds]
    for step in recording.steps():
        for run in runs:
            add(run.backend, *step)
            run.update(IDLE)
    return runs


def flood(run: Timed, recording: Recording, count: int) -> tuple[float, list[float]]:
    """
    Add very many wrong closures; return how much memory the process has grown [MB], and times.

    Parameters
    ----------
    run : Timed, at the end of the recording
    recording : Recording
    count : int

    """
    before, rng, updates = resident_bytes(), np.random.default_rng(1), len(run.updates)
    n, information = len(recording.stamps_ns) - 10, recording.loops().information[0]
    none = recording.only(np.zeros(len(recording.ends), dtype=bool))
    for _ in range(count // BATCH):
        i, j = np.sort(rng.choice(n, (2, BATCH)), axis=0)
        wrong = none.closing(closures(
            i, j + 1, rng.uniform(-1.0, 1.0, (BATCH, 3)) * (100.0, 100.0, 3.0), information))
        _, arriving = zip(*wrong.steps(), strict=True)
        for closure in chain.from_iterable(arriving):
            run.backend.add_measurement(closure, CLOSURES)
        run.update(IDLE)
    return 1e-6 * (resident_bytes() - before), run.updates[updates:]


def drives(n: int) -> list[Recording]:
    """Return drives of n nodes whose closures are right, from tight odometry to loose one."""
    world = worlds.city(n)
    city = replace(world, name='city', observed=world.observed.rows(slice(0)),
                   observed_stops=np.zeros(world.n_nodes, dtype=np.int64))
    return [of_world(city), of_world(worlds.corridor(n)), simulated('hall', 1.4 * n, 0)]


def timing(options: Options) -> Section:
    """
    Measure drives without wrong closures, with random ones and with groups of them.

    Drives of {n} nodes, at an update for each node and 10 ms for the work after it. Times of the
    processor in ms. A step is an update with that work. Asked for: no update above 50 ms; without
    wrong closures steps that take at most {SLOWER} times those of a back end that believes
    everything, over the same samples in turn.
    """
    n = LARGE // 5 if options.quick else LARGE
    section = Section('Time of judging', about(timing, n=n))
    table = section.table(
        '', 'drive', 'wrong', 'robust', 'update mean', 'p99', 'max', 'slice p99', 'max',
        'step mean', 'p99', 'believed', 'end of stream [s]')
    warm_up()
    for clean in drives(n):
        for share, group in ((0.0, 1), (0.1, 1), (0.3, 10), (0.5, 1)):
            recording = with_false(clean, share, group, 0) if share > 0.0 else clean
            kinds = (Robust.JUDGED, Robust.NONE) if share == 0.0 else (Robust.JUDGED,)
            runs = drive(recording, kinds)
            name = f'{100 * share:.0f} %' + (f', groups of {group}' if group > 1 else '')
            _ask(section, f'{clean.name}, {name} wrong', runs, large=n >= LARGE)
            for kind, run in zip(kinds, runs, strict=True):
                believed, start = _believed(run.backend), time.thread_time()
                run.backend.optimize()
                table.add(clean.name, name, kind.value, *map(_ms, (
                    np.mean(run.updates), *_quantiles(run.updates), *_quantiles(run.slices),
                    np.mean(run.steps), np.quantile(run.steps, 0.99))), believed,
                    f'{time.thread_time() - start:.1f}')
    count = FLOOD // 10 if options.quick else FLOOD
    grown, updates = flood(runs[0], recording, count)
    section.notes.append(
        f'{count} further wrong closures, {BATCH} with each update: the process grows by '
        f'{grown:.0f} MB (below 0: less than it gave back); an update takes '
        f'{_ms(np.median(updates))} ms, {_ms(np.max(updates))} at most.')
    return section


def _ask(section: Section, name: str, runs: Sequence[Timed], *, large: bool) -> None:
    """Add the figures that something is asked of, in a large graph."""
    first, slower = runs[0], SLOWER if large else None
    section.ask(f'{name}: longest update', max(first.updates), ' s', most=LONGEST)
    section.ask(f'{name}: longest slice', max(first.slices), ' s', most=LONGEST)
    for other in runs[1:]:
        for what, figure in (('', np.mean), (', p99', lambda v: np.quantile(v, 0.99))):
            section.ask(f'{name}: steps slower by{what}', figure(first.steps) / figure(
                other.steps), most=slower)


def _quantiles(times: Sequence[float]) -> tuple[float, float]:
    return tuple(np.quantile(times, (0.99, 1.0)).tolist())


def _ms(seconds: float) -> str:
    return f'{1e3 * seconds:.2f}'


def _believed(backend: PoseGraphBackend) -> str:
    closures = backend.graph.factors.edges.weight[backend.graph.factors.edges.kind != 0]
    return f'{np.count_nonzero(closures)} of {len(closures)}'
