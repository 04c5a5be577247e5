# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Tune with all measurements of a drive, and find out how well that does on stretches held out.

For each part of the drive in turn the noise is estimated from all others, and the engine runs with
all others, with the settings before and after. So the estimate in the file is from all
measurements, and the errors in the table are those of estimates that are made in the same way, at
fixes that took no part in these. If they are worse, the same is done with the noise of odometry,
or that of the other sources, as it was.
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import islice
import time
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.bag_inputs import Inputs, reader_of
from pose_graph_ros.adapters.bags import Bag, BagError
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import backend_config, Kind, ODOMETRY_KINDS
from pose_graph_ros.cli.replay import measurements_of, run_measurements
from pose_graph_ros.cli.tuned_parameters import (
    changed,
    closure_parameters,
    odometry_parameters,
    source_parameters,
    Tuned,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import Covariances
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.judgement.texts import states_by_stamps
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.measurements import Fix, LoopClosure, Measurement, OdometrySample
from pose_graph_ros.core.quantities import Metres, Seconds
from pose_graph_ros.offline.tuning import held_out
from pose_graph_ros.offline.tuning.closure_fit import ClosureProblem, fit_closures, MOST_NODES
from pose_graph_ros.offline.tuning.drive_rows import (
    Absolute,
    drive_rows,
    Key,
    LEAST,
    source_of_poses,
    SourceOfPoses,
    timeline,
)
from pose_graph_ros.offline.tuning.fit import estimate, Fit
from pose_graph_ros.offline.tuning.held_out import Errors, NO_ERRORS, proven, Summary
from pose_graph_ros.offline.tuning.likelihood import Role


class Run(NamedTuple):
    """Result of a run of the engine."""

    path: Trajectory
    covariances: Covariances  # of the path, in map axes
    factors: Mapping[str, float]  # of the engine on the variances that a source claims
    doubted: frozenset[Key]  # measurements that contradict the others
    graph: Graph


class Verdict(Enum):
    """What came of a tuning."""

    BETTER = 'held-out errors are lower after tuning'
    SAME = 'nothing to change: this drive does not prove any other noise'
    WORSE = 'held-out errors are not lower after tuning'


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a tuning."""

    tuned: Sequence[Tuned]
    verdict: Verdict
    before: Summary
    after: Summary
    to_truth: Sequence[Metres]  # rms of the paths before and after; empty if it is not known
    folds: int
    folds_done: int
    stretch: Seconds  # length of those that were held out
    measured: str  # how much was
    n_doubted: int
    contradiction: float


class _Tried(NamedTuple):
    """What a path with some settings shows of what was held out."""

    errors: list[Errors]
    to_truth: Metres


class Tuning:
    """Tunes with the measurements of a bag, the first million, all fixes in the same map."""

    def __init__(
        self, bag: Bag, inputs: Inputs, values: Mapping[str, Any], show: Callable[[str], None],
    ) -> None:
        self._inputs, self._values, self._show = inputs, values, show
        self._step, self._steps = 0, 0
        self._config, self._path = backend_config(values), bag.path
        stream = measurements_of(bag, inputs, reader_of(bag, values), Counter())
        self._measurements = _in_the_map(list(islice(stream, 1_000_000)))  # of 700 bytes each
        self.is_cut = next(stream, None) is not None  # whether the bag has more
        self._odometry = {}
        for name in inputs.of(*ODOMETRY_KINDS):
            found = timeline([each for of, each in self._measurements
                              if of == name and isinstance(each, OdometrySample)],
                             self._config.odometry_source(name))
            if len(found) > 1:
                self._odometry[name] = found
        if len(self._odometry) == 0:
            topics = ' or '.join(inputs.topics[name] for name in inputs.of(*ODOMETRY_KINDS))
            raise BagError(f'{self._path}: no usable odometry on {topics}')
        stamps = next(iter(self._odometry.values())).stamps_ns
        self._start_ns, self._duration = int(stamps[0]), float(stamps[-1] - stamps[0]) * 1e-9
        self._sources = [each for each in self._sources_of_poses(values)
                         if each.measured.has_positions or each.measured.has_headings]
        self._closures: list[tuple[str, LoopClosure]] = []
        if not any(each.measured.has_positions for each in self._sources):
            self._sources, self._closures = [], [
                (name, each) for name, each in self._measurements
                if isinstance(each, LoopClosure)]
            if len(self._closures) < LEAST:
                topics = ', '.join(f'{topic} ({source})'
                                   for source, topic in inputs.topics.items())
                raise BagError(
                    f'{self._path}: nothing to tune by: at least {LEAST} valid fixes, global '
                    f'poses or loop closures are needed; used are {topics}')

    def tune(self, folds: int, deadline: Seconds, truth: Trajectory | None) -> Outcome:
        """Return the parameters that are the most likely, and how well these do."""
        self._steps = 2 + 3 * folds
        tuned, fits = self._estimate(frozenset(), 'estimating noise')
        start = time.monotonic()
        self._begin('running with it')
        run = self._run(self._with(tuned))
        seconds = time.monotonic() - start
        doubted = frozenset() if run is None else run.doubted
        if len(doubted) > 0:
            self._steps += 1
            tuned, fits = self._estimate(doubted, 'estimating noise again')
        fit_seconds = time.monotonic() - start - seconds
        primary = next(iter(fits.values()))
        tau = max((each.value for each in primary.found if each.parameter.role is Role.TAU),
                  default=0.0)
        stretch = held_out.stretch_length(self._duration, self._period(), tau, folds)
        per_fold = 2.5 * seconds + fit_seconds + 1.0
        n_done = int(np.clip((deadline - time.monotonic()) / per_fold, 1, folds))
        changes = len(changed(tuned)) > 0
        self._steps -= 3 * folds - (3 if changes else 1) * n_done
        tried = [self._fold(k, folds, stretch, doubted, truth, is_tuned=changes)
                 for k in range(n_done)]
        one, other = self._common(tried, doubted)
        verdict = Verdict.SAME
        if changes:
            verdict = Verdict.BETTER if held_out.is_better(
                one, other, self._start_ns, stretch) else Verdict.WORSE
        errors = [] if truth is None else np.sqrt(np.mean(np.square(
            [[each.to_truth for each in pair] for pair in tried]), axis=0)).tolist()
        return Outcome(tuned, verdict, held_out.summary(one), held_out.summary(other), errors,
                       folds, n_done, stretch, self._measured(), len(doubted),
                       max(each.contradiction for each in fits.values()))

    def _sources_of_poses(self, values: Mapping[str, Any]) -> list[SourceOfPoses]:
        """Return the sources with enough valid measurements in the map, by some parameters."""
        config, found = backend_config(values), []
        for name in self._inputs.of(Kind.FIX, Kind.GLOBAL_POSE, Kind.IMU):
            kept = [each for of, each in self._measurements
                    if of == name and isinstance(each, Absolute)]
            source = None if len(kept) == 0 else source_of_poses(
                name, kept, config.measurement_source(name, type(kept[0])))
            if source is not None:
                found.append(source)
        return found

    def _run(self, values: Mapping[str, Any], without: Collection[Key] = ()) -> Run | None:
        """Return the result of the engine without some measurements; None if it has no path."""
        backend, _ = run_measurements((
            (name, each) for name, each in self._measurements
            if isinstance(each, OdometrySample) or (name, each.stamp_ns) not in without), values)
        estimate = backend.estimate()
        if estimate is None:
            return None
        factors = {
            name: 1.0 if report.in_use is None else report.in_use.correlated + report.in_use.white
            for name, report in backend.reports().items()}
        doubted = frozenset(
            (name, stamp) for (name, stamp, _), state
            in states_by_stamps(backend.verdicts()).items() if state is State.DOUBTED)
        return Run(estimate.path, backend.path_covariances(estimate), factors, doubted,
                   backend.graph)

    def _closure_errors(self, run: Run, left_out: Collection[Key]) -> Errors:
        """Return the errors of a path at closures, in the frames of their references."""
        chosen = [each for name, each in self._closures
                  if (name, each.stamp_ns) in left_out and each.reference_ns is not None]
        stamps = np.array([(each.reference_ns, each.stamp_ns) for each in chosen],
                          dtype=np.int64).reshape(-1, 2)
        inside = np.all(run.path.covers(stamps), axis=1)
        ends = run.path.at(stamps[inside])
        measured_poses = np.array([each.pose for each in chosen]).reshape(-1, 3)[inside]
        errors = measured_poses[:, :2] - se2.between(ends[:, 0], ends[:, 1])[:, :2]
        return Errors(stamps[inside, 1], errors, np.full((len(errors), 2, 2), np.nan))

    def _begin(self, text: str) -> str:
        """Show what is done next, as which step of all, and return that."""
        self._step += 1
        text = f'step {self._step} of {self._steps}: {text}'
        self._show(text)
        return text

    def _with(self, tuned: Sequence[Tuned]) -> dict[str, Any]:
        """Return all parameters, with those that were tuned."""
        return checked({**self._values, **changed(tuned)})

    def _estimate(
        self, without: Collection[Key], text: str,
    ) -> tuple[list[Tuned], dict[str, Fit]]:
        """Return what is the most likely without some measurements."""
        text, count = self._begin(text), 0

        def tick() -> None:
            nonlocal count
            count += 1
            if count % 100 == 0:
                self._show(f'{text}: {count} evaluations')
        if len(self._closures) > 0:
            return self._estimate_by_closures(without, tick)
        sources = [each._replace(measured=each.measured.rows(~each.is_among(without)))
                   for each in self._sources]
        measured = {each.name: each.measured for each in sources}
        fits = estimate(self._odometry, measured, self._config, tick)
        if len(fits) == 0:
            raise BagError(f'{self._path}: nothing to tune by: no fix or global pose was measured '
                           'while there was odometry')
        rows = drive_rows(self._odometry[next(iter(fits))], measured, self._config)
        shown = held_out.shown_variances(rows, len(measured))
        tuned: list[Tuned] = []
        for name, found in proven(fits, shown, self._duration).items():
            tuned += odometry_parameters(name, found, self._values)
            if name == next(iter(fits)):
                for k, source in enumerate(sources):
                    tuned += source_parameters(source, k, found, self._values)
        return tuned, fits

    def _estimate_by_closures(
        self, without: Collection[Key], tick: Callable[[], None],
    ) -> tuple[list[Tuned], dict[str, Fit]]:
        """Do the same by loop closures alone."""
        run, primary = self._run(self._values, without), next(iter(self._odometry))
        if run is None or run.graph.n_nodes > MOST_NODES:
            raise BagError(f'{self._path}: too many hidden nodes to tune by loop closures; '
                           f'expected at most {MOST_NODES}')
        problem = ClosureProblem(run.graph, tick)
        if problem.n_closures < LEAST // 2:
            raise BagError(f'{self._path}: nothing to tune by: only '
                           f'{problem.n_closures} loop closures are believed')
        found = proven({primary: fit_closures(problem)}, (), self._duration)[primary]
        sources = list(dict.fromkeys(name for name, _ in self._closures))
        return list(closure_parameters(primary, sources, found, self._values)), {primary: found}

    def _period(self) -> float:
        """Return the longest median time between measurements of a source of positions [s]."""
        return max((float(np.median(np.diff(each.measured.stamps_ns))) * 1e-9
                    for each in self._sources if each.measured.has_positions), default=1.0)

    def _fold(
        self, k: int, folds: int, stretch: Seconds, doubted: Collection[Key],
        truth: Trajectory | None, *, is_tuned: bool,
    ) -> tuple[_Tried, _Tried]:
        """Return what a part that is held out shows of the settings before and after."""
        every = [(source.name, source.measured.stamps_ns) for source in self._sources
                 if source.measured.has_positions]
        every += [(name, np.array([each.stamp_ns], dtype=np.int64))
                  for name, each in self._closures]
        left_out = frozenset(
            (name, stamp) for name, stamps in every for stamp in stamps[held_out.fold_of(
                stamps, self._start_ns, stretch, folds) == k].tolist())
        text = f'part {k + 1} of {folds} held out'
        tuned = self._estimate(left_out | frozenset(doubted), text)[0] if is_tuned else []
        self._begin(f'{text}: running with the settings before')
        before = after = self._try(self._values, left_out, truth)
        if is_tuned:
            self._begin(f'{text}: running with the settings after')
            after = self._try(self._with(tuned), left_out, truth)
        return before, after

    def _try(
        self, values: Mapping[str, Any], left_out: Collection[Key], truth: Trajectory | None,
    ) -> _Tried:
        run = self._run(values, left_out)
        if run is None:
            return _Tried([], np.nan)
        errors = [self._closure_errors(run, left_out)] if len(self._closures) > 0 else [
            held_out.errors_at(
                run.path, run.covariances, source.measured.rows(source.is_among(left_out)),
                run.factors.get(source.name, 1.0)) for source in self._sources_of_poses(values)]
        if truth is None or not np.any(inside := run.path.covers(truth.stamps_ns)):
            return _Tried(errors, np.nan)
        apart = run.path.at(truth.stamps_ns[inside])[:, :2] - truth.poses[inside, :2]
        return _Tried(errors, float(np.sqrt(np.mean(np.sum(apart**2, axis=1)))))

    def _common(
        self, tried: Sequence[tuple[_Tried, _Tried]], doubted: Collection[Key],
    ) -> tuple[Errors, Errors]:
        """Return the errors before and after at the same positions, which are not wrong."""
        stamps = np.array([stamp for _, stamp in doubted], dtype=np.int64)
        ones, others = [NO_ERRORS], [NO_ERRORS]
        for before, after in tried:
            for one, other in zip(before.errors, after.errors, strict=True):
                common = np.isin(one.stamps_ns, other.stamps_ns) & ~np.isin(one.stamps_ns, stamps)
                ones.append(one.rows(common))
                others.append(other.rows(np.isin(other.stamps_ns, one.stamps_ns[common])))
        first, second = held_out.joined(ones), held_out.joined(others)
        right = ~held_out.wrong([first, second])
        return first.rows(right), second.rows(right)

    def _measured(self) -> str:
        """Return how much was measured, in words."""
        counts = ', '.join([f'{len(each.measured.stamps_ns)} of {each.name}'
                            for each in self._sources] or [f'{len(self._closures)} closures'])
        return f'{self._duration:.0f} s of odometry, {counts}'


def _in_the_map(
    measurements: list[tuple[str, OdometrySample | Measurement]],
) -> list[tuple[str, OdometrySample | Measurement]]:
    """Return measurements with fixes placed; the first one that odometry covers goes first."""
    start = min((each.stamp_ns for _, each in measurements
                 if isinstance(each, OdometrySample)), default=0)
    order = sorted(range(len(measurements)), key=lambda k: measurements[k][1].stamp_ns < start)
    for k in order:
        name, each = measurements[k]
        if isinstance(each, Fix):
            measurements[k] = name, each.placed()
    return measurements
