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

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
import time
from typing import Any

import numpy as np

from pose_graph_ros.adapters.bag_inputs import Inputs
from pose_graph_ros.adapters.bags import BagError
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import backend_config, ODOMETRY_KINDS
from pose_graph_ros.cli.tuned_parameters import (
    changed,
    closure_parameters,
    odometry_parameters,
    source_parameters,
    Tuned,
)
from pose_graph_ros.cli.tuning_drive import Key, LEAST, Run, SourceOfPoses, TuningDrive
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.measurements import LoopClosure
from pose_graph_ros.offline.tuning.closure_fit import ClosureProblem, fit_closures, MOST_NODES
from pose_graph_ros.offline.tuning.drive_rows import drive_rows, timeline
from pose_graph_ros.offline.tuning.fit import estimate, Fit
from pose_graph_ros.offline.tuning.held_out import (
    Errors,
    fold_of,
    is_better,
    joined,
    NO_ERRORS,
    proven,
    shown_variances,
    stretch_length,
    Summary,
    summary,
    wrong,
)
from pose_graph_ros.offline.tuning.likelihood import Role


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
    to_truth: Sequence[float]
    """Rms error of the paths before and after to the truth [m]; empty if it is not known."""
    folds: int
    folds_done: int
    stretch: float
    """Length of the stretches that were held out [s]."""
    measured: str
    """How much was measured."""
    n_doubted: int
    contradiction: float


@dataclass(slots=True)
class _Fold:
    """One part of the drive that is held out."""

    held_out: frozenset[Key]
    tuned: list[Tuned]
    before: list[Errors]
    to_truth: float


class Tuning:
    """
    Tunes with the measurements of a drive.

    Parameters
    ----------
    values : mapping, all parameters before
    path : str, of the bag, for errors
    show : callable, receives what is being done

    """

    def __init__(
        self, drive: TuningDrive, inputs: Inputs, values: Mapping[str, Any], path: str,
        show: Callable[[str], None],
    ) -> None:
        self._drive, self._inputs, self._values, self._show = drive, inputs, values, show
        self._step, self._steps = 0, 0
        self._config, self._path = backend_config(values), path
        self._odometry = {}
        for name in inputs.of(*ODOMETRY_KINDS):
            found = timeline(drive.odometry(name), self._config.odometry_source(name))
            if len(found) > 1:
                self._odometry[name] = found
        if len(self._odometry) == 0:
            topics = ' or '.join(inputs.topics[name] for name in inputs.of(*ODOMETRY_KINDS))
            raise BagError(f'{path}: no usable odometry on {topics}')
        stamps = next(iter(self._odometry.values())).stamps_ns
        self._start_ns, self._duration = int(stamps[0]), float(stamps[-1] - stamps[0]) * 1e-9
        self._sources = [each for each in drive.sources_of_poses(inputs, values)
                         if each.measured.has_positions or each.measured.has_headings]
        self._closures: list[tuple[str, LoopClosure]] = []
        if not any(each.measured.has_positions for each in self._sources):
            self._sources, self._closures = [], drive.closures()
            if len(self._closures) < LEAST:
                raise BagError(
                    f'{path}: nothing to tune by: at least {LEAST} valid fixes, global poses or '
                    f'loop closures are needed; used are {_topics(inputs)}')

    def tune(self, folds: int, deadline: float, truth: Trajectory | None) -> Outcome:
        """
        Return the parameters that are the most likely, and how well these do.

        Parameters
        ----------
        folds : int
        deadline : float, by `time.monotonic` [s]
        truth : Trajectory, optional, only for comparison

        """
        self._steps = 2 + 3 * folds
        tuned, fits = self._estimate(frozenset(), 'estimating noise')
        start = time.monotonic()
        self._begin('running with it')
        run = self._drive.run(self._with(tuned))
        seconds = time.monotonic() - start
        doubted = frozenset() if run is None else run.doubted
        if len(doubted) > 0:
            self._steps += 1
            tuned, fits = self._estimate(doubted, 'estimating noise again')
        fit_seconds = time.monotonic() - start - seconds
        primary = next(iter(fits.values()))
        tau = max((each.value for each in primary.found if each.parameter.role is Role.TAU),
                  default=0.0)
        stretch = stretch_length(self._duration, self._period(), tau, folds)
        per_fold = 2.5 * seconds + fit_seconds + 1.0
        n_done = int(np.clip((deadline - time.monotonic()) / per_fold, 1, folds))
        changes = len(changed(tuned)) > 0
        self._steps -= 3 * folds - (3 if changes else 1) * n_done
        parts = [self._fold(k, folds, stretch, doubted, truth, is_tuned=changes)
                 for k in range(n_done)]
        after = self._after(parts, truth) if changes else [
            (part.before, part.to_truth) for part in parts]
        one, other = self._common([part.before for part in parts], [each for each, _ in after],
                                  doubted)
        verdict = Verdict.SAME
        if changes:
            verdict = Verdict.BETTER if is_better(
                one, other, self._start_ns, stretch) else Verdict.WORSE
        errors = [float(np.sqrt(np.mean(np.square(each)))) for each in (
            [part.to_truth for part in parts],
            [each for _, each in after])] if truth is not None else []
        return Outcome(tuned, verdict, summary(one), summary(other), errors, folds, n_done,
                       stretch, self._measured(), len(doubted),
                       max(each.contradiction for each in fits.values()))

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
        sources = [self._without(each, without) for each in self._sources]
        measured = {each.name: each.measured for each in sources}
        fits = estimate(self._odometry, measured, self._config, tick)
        if len(fits) == 0:
            raise BagError(f'{self._path}: nothing to tune by: no fix or global pose was measured '
                           'while there was odometry')
        rows = drive_rows(self._odometry[next(iter(fits))], measured, self._config)
        shown = shown_variances(rows, len(measured))
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
        run, primary = self._drive.run(self._values, without), next(iter(self._odometry))
        if run is None or run.graph.n_nodes > MOST_NODES:
            raise BagError(f'{self._path}: too many hidden nodes to tune by loop closures; '
                           f'expected at most {MOST_NODES}')
        problem = ClosureProblem(run.graph, tick)
        if np.sum(problem.is_closure) < LEAST // 2:
            raise BagError(f'{self._path}: nothing to tune by: only '
                           f'{int(np.sum(problem.is_closure))} loop closures are believed')
        found = proven({primary: fit_closures(problem)}, (), self._duration)[primary]
        sources = list(dict.fromkeys(name for name, _ in self._closures))
        return list(closure_parameters(primary, sources, found, self._values)), {primary: found}

    def _without(self, source: SourceOfPoses, without: Collection[Key]) -> SourceOfPoses:
        """Return a source without some measurements."""
        if len(without) == 0:
            return source
        kept = np.array([(source.name, stamp) not in without
                         for stamp in source.measured.stamps_ns.tolist()], dtype=bool)
        return SourceOfPoses(
            source.name, source.measured.rows(kept), is_constant=source.is_constant,
            is_scalable=source.is_scalable, sigma=source.sigma,
            sigma_heading=source.sigma_heading)

    def _period(self) -> float:
        """Return the longest median time between measurements of a source of positions [s]."""
        return max((float(np.median(np.diff(each.measured.stamps_ns))) * 1e-9
                    for each in self._sources if each.measured.has_positions), default=1.0)

    def _fold(
        self, k: int, folds: int, stretch: float, doubted: Collection[Key],
        truth: Trajectory | None, *, is_tuned: bool,
    ) -> _Fold:
        """Return a fold, with the estimate of the noise if it is asked for, and its errors."""
        held_out = frozenset(
            (source.name, stamp) for source in self._sources if source.measured.has_positions
            for stamp in source.measured.stamps_ns[fold_of(
                source.measured.stamps_ns, self._start_ns, stretch, folds) == k].tolist())
        if len(self._closures) > 0:
            stamps = np.array([each.stamp_ns for _, each in self._closures], dtype=np.int64)
            folded = fold_of(stamps, self._start_ns, stretch, folds) == k
            held_out = frozenset((name, each.stamp_ns) for (name, each), out in zip(
                self._closures, folded.tolist(), strict=True) if out)
        text = f'part {k + 1} of {folds} held out'
        tuned, _ = self._estimate(held_out | frozenset(doubted), text) if is_tuned else ([], {})
        self._begin(f'{text}: running with the settings before')
        run = self._drive.run(self._values, held_out)
        return _Fold(held_out, tuned, self._errors(run, self._values, held_out),
                     _to_truth(run, truth))

    def _after(
        self, parts: Sequence[_Fold], truth: Trajectory | None,
    ) -> list[tuple[list[Errors], float]]:
        """Return the errors of all folds after tuning, and those to the truth."""
        after = []
        for k, part in enumerate(parts):
            self._begin(f'part {k + 1} held out: running with the settings after')
            values = self._with(part.tuned)
            run = self._drive.run(values, part.held_out)
            after.append((self._errors(run, values, part.held_out), _to_truth(run, truth)))
        return after

    def _errors(
        self, run: Run | None, values: Mapping[str, Any], held_out: Collection[Key],
    ) -> list[Errors]:
        if run is None:
            return []
        if len(self._closures) > 0:
            return [self._drive.closure_errors(run, held_out)]
        return self._drive.errors(run, values, self._inputs, held_out)

    def _common(
        self, before: Sequence[Sequence[Errors]], after: Sequence[Sequence[Errors]],
        doubted: Collection[Key],
    ) -> tuple[Errors, Errors]:
        """Return the errors before and after at the same positions, which are not wrong."""
        stamps = np.array([stamp for _, stamp in doubted], dtype=np.int64)
        ones, others = [NO_ERRORS], [NO_ERRORS]
        for part, same in zip(before, after, strict=True):
            for one, other in zip(part, same, strict=True):
                common = np.isin(one.stamps_ns, other.stamps_ns) & ~np.isin(one.stamps_ns, stamps)
                kept = np.isin(other.stamps_ns, one.stamps_ns[common])
                ones.append(one.rows(common))
                others.append(other.rows(kept))
        first, second = joined(ones), joined(others)
        right = ~wrong([first, second])
        return first.rows(right), second.rows(right)

    def _measured(self) -> str:
        """Return how much was measured, in words."""
        counts = ', '.join([f'{len(each.measured.stamps_ns)} of {each.name}'
                            for each in self._sources] or [f'{len(self._closures)} closures'])
        return f'{self._duration:.0f} s of odometry, {counts}'


def _to_truth(run: Run | None, truth: Trajectory | None) -> float:
    """Return the rms error of a path [m]."""
    if run is None or truth is None:
        return float('nan')
    inside = run.path.covers(truth.stamps_ns)
    if not np.any(inside):
        return float('nan')
    errors = run.path.at(truth.stamps_ns[inside])[:, :2] - truth.poses[inside, :2]
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _topics(inputs: Inputs) -> str:
    return ', '.join(f'{topic} ({source})' for source, topic in inputs.topics.items())
