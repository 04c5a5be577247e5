# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How long updates and the work between them take while closures are judged.

Two back ends, one that judges and one that believes everything, get the same samples in turn, so
that whatever else the machine does slows both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import resource
import time

import numpy as np

from benchmark import streets
from benchmark.metrics import Metric
from benchmark.robust_closures import add, closing, Recording
from benchmark.robust_worlds import of_world, with_false
from benchmark.section import Section, Table
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import Robust
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.warm_up import warm_up

LONGEST, SLOWER = 0.05, 1.3
"""What is asked for: longest update [s], and mean time of an update beside one without judging."""
IDLE = 0.002
"""Time for the work after each update, at least one slice [s]; a robot has far more."""
BATCH = 100
"""Wrong closures that come with one update when very many wait."""


@dataclass(slots=True)
class Timed:
    """A back end, and what its calls have taken [s]."""

    backend: PoseGraphBackend
    updates: list[float] = field(default_factory=list)
    slices: list[float] = field(default_factory=list)

    def update(self, idle: float) -> None:
        """Update, then work for a while."""
        start = time.perf_counter()
        self.backend.update()
        self.updates.append(time.perf_counter() - start)
        left, finished = idle, False
        while left > 0.0 and not finished:
            start = time.perf_counter()
            finished = self.backend.refine().finished
            self.slices.append(time.perf_counter() - start)
            left -= self.slices[-1]


def drive(recording: Recording, kinds: Sequence[Robust], idle: float = IDLE) -> list[Timed]:
    """
    Feed a recording to back ends of some kinds, one sample to each in turn.

    Parameters
    ----------
    recording : Recording
    kinds : sequence of Robust
    idle : float, time for the work after each update [s]

    Returns
    -------
    list of Timed

    """
    runs = [Timed(PoseGraphBackend(recording.config(kind))) for kind in kinds]
    closure = 0
    for stamp, pose in zip(recording.stamps_ns.tolist(), recording.odometry, strict=True):
        begin = closure
        while closure < len(recording.ends) and recording.arrival_ns[closure] <= stamp:
            closure += 1
        for run in runs:
            run.backend.add_odometry(
                OdometrySample(stamp, pose, twist_variance=recording.twist_variance))
            for k in range(begin, closure):
                add(run.backend, recording, k)
            run.update(idle)
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
    before, rng, updates = memory(), np.random.default_rng(1), len(run.updates)
    n = len(recording.stamps_ns) - 10
    for _ in range(count // BATCH):
        i, j = np.sort(rng.choice(n, (2, BATCH)), axis=0)
        wrong = closing(
            recording.only(np.zeros(len(recording.ends), dtype=bool)), i, j + 1,
            rng.uniform(-1.0, 1.0, (BATCH, 3)) * (100.0, 100.0, 3.0),
            np.tile(recording.covariances[0], (BATCH, 1, 1)))
        for k in range(BATCH):
            add(run.backend, wrong, k)
        run.update(IDLE)
    return memory() - before, run.updates[updates:]


def memory() -> float:
    """Return the largest resident size of the process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def timing(*, quick: bool) -> Section:
    """Measure a drive through a city like city10000, without and with wrong closures."""
    n = 2000 if quick else 10000
    section = Section(
        'Time of judging', f'A drive of {n} nodes through a city, with as many loop closures, of '
        'which none or half are wrong, at an update for each node. Times in ms. Asked for: no '
        f'update above {1e3 * LONGEST:.0f} ms; without wrong ones a mean at most {SLOWER} times '
        'that of a back end that believes everything, over the same samples in turn.')
    table = Table('', ('closures', 'robust', 'update mean', 'p50', 'p99', 'max', 'work p50', 'p99',
                       'max', 'believed'))
    section.tables.append(table)
    world = streets.city(n)
    clean = of_world(replace(world, observed=world.observed.rows(slice(0)),
                             observed_stops=np.zeros(n, dtype=np.int64)))
    warm_up()
    for share in (0.0, 0.5):
        recording = with_false(clean, share, 1, 0) if share > 0.0 else clean
        kinds = (Robust.JUDGED, Robust.NONE) if share == 0.0 else (Robust.JUDGED,)
        runs = drive(recording, kinds)
        name = f'{100 * share:.0f} % wrong'
        for kind, run in zip(kinds, runs, strict=True):
            table.add(name, kind.value, *map(_ms, (np.mean(run.updates), *_quantiles(
                run.updates), *_quantiles(run.slices))), _believed(run.backend))
        section.metrics.append(Metric(
            f'{name}: longest update', max(runs[0].updates), 's', target=LONGEST))
        section.metrics.append(Metric(
            f'{name}: longest slice', max(runs[0].slices), 's', target=LONGEST))
        if len(runs) > 1:
            section.metrics.append(Metric('0 % wrong: slower by', float(
                np.mean(runs[0].updates) / np.mean(runs[1].updates)), target=SLOWER))
    count = 10 * n
    grown, updates = flood(runs[0], recording, count)
    section.notes.append(
        f'{count} further wrong closures, {BATCH} with each update, take {grown:.0f} MB; an '
        f'update takes {_ms(np.median(updates))} ms, {_ms(np.max(updates))} at most.')
    return section


def _quantiles(times: Sequence[float]) -> tuple[float, float, float]:
    return tuple(np.quantile(times, (0.5, 0.99, 1.0)).tolist())


def _ms(seconds: float) -> str:
    return f'{1e3 * seconds:.2f}'


def _believed(backend: PoseGraphBackend) -> str:
    closures = backend.graph.edges.weight[backend.graph.edges.kind != 0]
    return f'{np.count_nonzero(closures)} of {len(closures)}'
