# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Estimate the noise of odometry and of what measures in the map; write a parameter file.

All measurements of a drive are used, and it is found out how well that does on stretches held out.
For each part of the drive in turn the engine runs with all others, with the settings before and
with those that this run shows. So the estimate in the file is from all measurements, and the
errors in the table are those of estimates that are made in the same way, at fixes that took no
part in these.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from enum import Enum
from itertools import islice
import json
import math
import os
import sys
import time
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.bags import Bag, BagError, Inputs, open_bag, reader_of
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import backend_config, IMU, Values
from pose_graph_ros.cli import finite, shared, tuned_parameters
from pose_graph_ros.cli.drive import distances, measured_in
from pose_graph_ros.cli.replay import run
from pose_graph_ros.cli.truth import truth_of
from pose_graph_ros.cli.tuned_parameters import changed, Claims, interval, Tuned
from pose_graph_ros.core import measurements
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.geometry.se2 import between, Covariances, FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.judgement.verdicts import State
from pose_graph_ros.core.measurements import Absolute, HeadingOnly, LoopClosure, OdometrySample
from pose_graph_ros.core.quantities import Metres, Seconds, StampNs
from pose_graph_ros.core.sources import kinds, validation
from pose_graph_ros.offline import noise
from pose_graph_ros.offline.noise import Errors, Found, Noise, Summary
from pose_graph_ros.offline.source_residuals import ScaleFit
from pose_graph_ros.offline.variance_components import analyse

Key = tuple[str, StampNs]  # source and stamp of a measurement
TruthAt = Callable[[Trajectory], Trajectory]
"""Return the truth where it is compared with a path."""
LEAST = 20  # measurements of a source whose noise is estimated
IN_MEMORY = 1_000_000  # measurements, of 700 bytes each
OF_CLOSURES = Claims(is_constant=False, is_scalable=True, sigma=0.0, sigma_heading=0.0)
NOT_SHOWN = Found(1.0, 0.0, math.inf, kept=True)


class Verdict(Enum):
    """What came of a tuning."""

    BETTER = 'held-out errors are lower after tuning'
    SAME = 'nothing to change: this drive does not prove any other noise'
    WORSE = 'held-out errors are not lower after tuning'


class Outcome(NamedTuple):
    """Result of a tuning."""

    tuned: Sequence[Tuned]
    verdict: Verdict
    before: Summary
    after: Summary
    to_truth: Sequence[Metres]  # rms of the paths before and after; empty if it is not known
    folds: int
    stretch: Seconds  # length of those that were held out
    measured: str  # how much was
    n_doubted: int


class Tuning:
    """Tunes with the measurements of a bag, the first million, all fixes in the same map."""

    def __init__(self, bag: Bag, inputs: Inputs, values: Values) -> None:
        self._inputs, self._values = inputs, values
        self._step, self._steps = 0, 0
        self._path = bag.path
        reader = reader_of(bag, values)
        self.datum = reader.datum
        stream = measured_in(bag, inputs, reader, Counter(), held_out=False)
        self._measurements = [each[:2] for each in islice(stream, IN_MEMORY)]
        self.is_cut = next(stream, None) is not None  # whether the bag has more
        moves = [(name, each.stamp_ns) for name, each in self._measurements
                 if isinstance(each, OdometrySample)]
        start = min((stamp_ns for _, stamp_ns in moves), default=0)
        # the first fix that odometry covers is placed first
        for k in sorted(range(len(self._measurements)),
                        key=lambda k: self._measurements[k][1].stamp_ns < start):
            name, fix = self._measurements[k]
            if isinstance(fix, measurements.Fix):
                self._measurements[k] = name, fix.placed()
        counts = Counter(name for name, _ in moves)
        self._odometries = [name for name in inputs.odometry if counts[name] > 1]
        if len(self._odometries) == 0:
            topics = ' or '.join(inputs.topics[name] for name in inputs.odometry)
            raise BagError(f'{self._path}: no usable odometry on {topics}')
        stamps = [stamp_ns for name, stamp_ns in moves if name == self._odometries[0]]
        self._start_ns, self._duration = min(stamps), (max(stamps) - min(stamps)) * 1e-9
        self.span = Trajectory(np.array([min(stamps), max(stamps)]), np.zeros((2, 3)))
        valid = self._valid(values)
        self._repaired = {name for name, _, is_repaired in valid if is_repaired}
        every = {name: [each for of, each, _ in valid if of == name]
                 for name in inputs.of(lambda kind: kind.in_map or kind is IMU)}
        self._sources = {name: some for name, some in every.items() if len(some) >= LEAST}
        self._closures: list[tuple[str, LoopClosure]] = []
        if all(isinstance(each, HeadingOnly) for some in self._sources.values() for each in some):
            self._sources, self._closures = {}, [(name, each) for name, each in self._measurements
                                                 if isinstance(each, LoopClosure)]
            if len(self._closures) < LEAST:
                topics = ', '.join(f'{topic} ({source})'
                                   for source, topic in inputs.topics.items())
                raise BagError(f'{self._path}: nothing to tune by: at least {LEAST} valid fixes, '
                               f'global poses or loop closures are needed; used are {topics}')

    def tune(self, folds: int, truth: TruthAt | None, stretch: Seconds | None) -> Outcome:
        """Return the parameters that are the most likely, and how well these do."""
        shared.check_stretch(self._path, stretch, self._duration, folds)
        # what the settings before say is not looked for by the engine: it shows in other runs
        self._looking = {**self._values, **{
            f'{name}.correlation_time': -1.0 for name in self._sources
            if self._values[f'{name}.correlation_time'] > 0.0}}
        self._is_shown_before = self._looking == self._values and len(self._odometries) == 1
        more = 0 if self._is_shown_before else len(self._odometries)
        self._steps = 2 + more + (2 + more) * folds
        runs = self._runs('all')[1]
        tuned, tau = self._estimate(runs, frozenset())
        after = self._run(checked({**self._values, **changed(tuned)}),
                          'all, with the settings after')
        doubted = frozenset((one.source, one.stamp_ns) for one in after.verdicts()
                            if one.state is State.DOUBTED and one.reference_ns is None)
        if len(doubted) > 0:
            tuned, tau = self._estimate(runs, doubted)
        period = max((float(np.median(np.diff([each.stamp_ns for each in some]))) * 1e-9
                      for some in self._sources.values()), default=1.0)
        if stretch is None:
            stretch = noise.stretch_length(self._duration, period, tau, folds)
        tried = [self._fold(k, folds, stretch, doubted, truth) for k in range(folds)]
        one, other = noise.comparable(*zip(*(
            pair for errors, _ in tried for pair in errors), strict=True))
        verdict = Verdict.SAME if len(changed(tuned)) == 0 else Verdict.BETTER if noise.is_better(
            one, other, self._start_ns, stretch) else Verdict.WORSE
        errors = [] if truth is None else np.sqrt(np.mean(np.square(
            [to_truth for _, to_truth in tried]), axis=0)).tolist()
        measured = [f'{len(some)} of {name}' for name, some in self._sources.items()] or [
            f'{len(self._closures)} closures']
        return Outcome(tuned, verdict, noise.error_summary(one), noise.error_summary(other),
                       errors, folds, stretch,
                       f'{self._duration:.0f} s of odometry, {", ".join(measured)}', len(doubted))

    def _valid(self, values: Values) -> list[tuple[str, Absolute, bool]]:
        """Return source, valid measurement in the map, and whether it was repaired, by stamp."""
        config, found = backend_config(values), []
        for name, each in sorted(self._measurements, key=lambda each: each[1].stamp_ns):
            if isinstance(each, Absolute):
                one = kinds.validate(each, config.measurement_source(name, type(each)).covariance)
                if isinstance(one, validation.Validated) and isinstance(one.measurement, Absolute):
                    found.append((name, one.measurement, len(one.repairs) > 0))
        return found

    def _run(self, values: Values, text: str, without: Collection[Key] = (),
             odometry: str = '') -> PoseGraphBackend:
        """Run the engine, as a step that is shown, without some measurements or other odometry."""
        self._step += 1
        _show(f'step {self._step} of {self._steps}: {text}')
        return run((
            (name, each) for name, each in self._measurements if (
                odometry in ('', name) if isinstance(each, OdometrySample)
                else (name, each.stamp_ns) not in without)), values).backend

    def _runs(self, text: str,
              left_out: Collection[Key] = ()) -> tuple[PoseGraphBackend, list[PoseGraphBackend]]:
        """Return a run with the settings before, and those that show the noise of odometries."""
        before = self._run(self._values, f'{text}, with the settings before', left_out)
        return before, [before] if self._is_shown_before else [self._run(
            self._looking, f'{text}, by {name}', left_out, name) for name in self._odometries]

    def _estimate(self, runs: Sequence[PoseGraphBackend],
                  without: Collection[Key]) -> tuple[list[Tuned], Seconds]:
        """Return what runs show, but for some measurements, and the longest time constant."""
        tuned, longest = list[Tuned](), 0.0
        for name, engine in zip(self._odometries, runs, strict=True):
            parts, by_residuals = engine.parts, dict[str, ScaleFit]()
            if len(self._closures) > 0 or any(
                    len(_heading_variances(some)) > 0 for some in self._sources.values()):
                by_residuals |= {source: each.fit for source, each in analyse(parts).items()}
            found: dict[str, Noise] = {}
            for source, some in self._sources.items():
                is_placed = not all(isinstance(each, HeadingOnly) for each in some)
                shown = noise.noise_of(parts, source, {
                    stamp for of, stamp in without if of == source}) if is_placed else None
                if shown is not None:
                    found[source] = shown
            proven = {source: each.proven for source, each in found.items()}
            if len(found) > 0:
                way, turn = noise.proven_odometry(found.values())
            else:
                way, turn = (NOT_SHOWN if one is None else one.proven(one.high) for one in (
                    _shown(by_residuals.get(name), axis) for axis in (0, 2)))
            tuned += tuned_parameters.odometry_parameters(name, way, turn, self._values)
            if engine is not runs[0]:
                continue
            longest = max((0.0 if each.tau is None else each.tau.value
                           for each in found.values()), default=0.0)
            for source, some in self._sources.items():
                tuned += tuned_parameters.source_parameters(
                    source, self._claims(source, some), self._values, size=proven.get(source),
                    heading=_shown(by_residuals.get(source), 2))
            for source in dict.fromkeys(of for of, _ in self._closures):
                if (size := _shown(by_residuals.get(source))) is not None:
                    # their constraints share noise of odometry up to the hidden nodes
                    tuned += tuned_parameters.source_parameters(
                        source, OF_CLOSURES, self._values, size=size.written(max(size.value, 1.0)))
        return tuned, longest

    def _claims(self, name: str, some: Sequence[Absolute]) -> Claims:
        policy = backend_config(self._values).measurement_source(name, type(some[0])).covariance
        positions = np.array([0.5 * np.trace(each.covariance[:2, :2]) for each in some
                              if not isinstance(each, HeadingOnly)])
        headings = _heading_variances(some)
        inside = len(positions) == 0 or bool(
            np.min(positions) > 1.01 * policy.position_floor**2
            and np.max(positions) < 0.99 * policy.position_ceiling**2)
        both = positions, headings
        return Claims(
            all(np.ptp(each) < 0.05 * np.min(each) for each in both if len(each) > 0),
            inside and name not in self._repaired and len(policy.override) == 0,
            *(float(np.sqrt(np.median(each))) if len(each) > 0 else 0.0 for each in both))

    def _fold(self, k: int, folds: int, stretch: Seconds, doubted: frozenset[Key],
              truth: TruthAt | None) -> tuple[list[tuple[Errors, Errors]], list[Metres]]:
        """
        Return errors of the paths before and after at a part that is held out, and to the truth.

        The former are at the same positions, which are not doubted.
        """
        every = [(name, each.stamp_ns) for name, some in self._sources.items() for each in some
                 if not isinstance(each, HeadingOnly)]
        every += [(name, each.stamp_ns) for name, each in self._closures]
        left_out = {key for key in every
                    if noise.is_in_part(key[1], self._start_ns, stretch, k, folds)}
        text = f'part {k + 1} of {folds} held out'
        before, runs = self._runs(text, left_out)
        values = checked({**self._values, **changed(self._estimate(runs, doubted)[0])})
        after = self._run(values, f'{text}, with the settings after', left_out)
        tried = (self._values, before), (values, after)
        pairs = []
        for errors in zip(*(self._errors(*each, left_out - doubted) for each in tried),
                          strict=True):
            common = np.intersect1d(*(each.stamps_ns for each in errors))
            one, other = (each.rows(np.isin(each.stamps_ns, common)) for each in errors)
            pairs.append((one, other))
        paths = [self._path_of(backend)[0] for _, backend in tried]
        return pairs, [] if truth is None else [float(np.sqrt(np.mean(np.square(distances(
            path, true.stamps_ns, true.poses[:, :2])[1])))) for path in paths
            for true in [truth(path)]]

    def _path_of(self, backend: PoseGraphBackend) -> tuple[Trajectory, Covariances]:
        estimate = backend.estimate()
        if estimate is None:
            raise BagError(f'{self._path}: the odometry makes no path')
        return estimate.path, backend.path_covariances(estimate)

    def _errors(self, values: Values, backend: PoseGraphBackend,
                held: Collection[Key]) -> list[Errors]:
        """Return the errors of a path at what was held out of each source, and at closures."""
        reports, valid, (path, covariances) = (
            backend.reports(), self._valid(values), self._path_of(backend))
        found = []
        for name in self._sources:
            in_use = reports[name].in_use if name in reports else None
            found.append(noise.errors_at(
                path, covariances,
                [each for of, each, _ in valid if of == name and (name, each.stamp_ns) in held
                 and not isinstance(each, HeadingOnly)],
                1.0 if in_use is None else in_use.correlated + in_use.white))
        closures = [each for name, each in self._closures
                    if (name, each.stamp_ns) in held and each.reference_ns is not None]
        stamps = np.array([(each.reference_ns, each.stamp_ns) for each in closures],
                          dtype=np.int64).reshape(-1, 2)
        inside = np.all(path.covers(stamps), axis=1)
        ends = path.at(stamps[inside])
        poses = np.array([each.pose for each in closures]).reshape(-1, 3)[inside]
        errors = poses[:, :2] - between(ends[:, 0], ends[:, 1])[:, :2]
        # the covariances of these are not known
        return [*found, Errors(stamps[inside, 1], errors, np.full((len(errors), 2, 2), np.nan))]


def _heading_variances(some: Sequence[Absolute]) -> FloatArray:
    return np.array([each.variance if isinstance(each, HeadingOnly) else each.covariance[2, 2]
                     for each in some if isinstance(each, HeadingOnly | measurements.GlobalPose)])


def _shown(fit: ScaleFit | None, axis: int | None = None) -> Found | None:
    """Return the noise, or that of a coordinate, by residuals; None if they show nothing."""
    of = fit if fit is None or axis is None else next(
        (row for row in fit.rows if row.coordinate == axis), None)
    return None if of is None or math.isnan(of.ratio) else Found(
        of.ratio**2, of.low**2, of.high**2, kept=of.low <= 1.0 <= of.high)


# --- the tool

def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    start, values, truth = time.monotonic(), shared.parameter_values(options), truth_of(options)
    if options.out.is_dir():
        raise BagError(f'{options.out}: is a folder; expected a file to write')
    if not options.out.resolve().parent.is_dir():
        raise BagError(f'{options.out}: there is no folder {options.out.resolve().parent}')
    where = options.out if options.out.exists() else options.out.resolve().parent
    if not os.access(where, os.W_OK):
        raise BagError(f'{options.out}: cannot be written: no permission')
    with open_bag(*options.bags) as bag:
        inputs = shared.inputs_of(bag, options, values)
        tuning = Tuning(shared.watched_bag(bag, 'reading'), inputs, values)
        known = truth.read(bag, inputs.span, tuning.datum.plane)
    if known is not None:
        truth.placed(known[0], tuning.span)     # so that wrong times are said at once
    try:
        outcome = tuning.tune(options.folds, None if known is None else lambda path: truth.placed(
            known[0], path)[0], options.stretch)
    finally:
        _show('')
    names = ' '.join(each.name for each in options.bags)
    headline = [f'Noise by `pose-graph tune {names}`', *_notes(outcome, tuning)]
    is_better = outcome.verdict is Verdict.BETTER
    if is_better:
        options.out.write_text(
            tuned_parameters.yaml_text(outcome.tuned, headline), encoding='utf-8')
    if options.json:
        print(json.dumps(finite({
            'bags': [str(each) for each in options.bags],
            'file': str(options.out) if is_better else None,
            'verdict': outcome.verdict.name.lower(), 'reason': outcome.verdict.value,
            'parameters': [each._asdict() | {'changed': each.changes} for each in outcome.tuned],
            'before': outcome.before._asdict(), 'after': outcome.after._asdict(),
            'to_truth': dict(zip(('before', 'after'), outcome.to_truth, strict=False)) or None,
            'folds': outcome.folds, 'stretch_s': outcome.stretch, 'doubted': outcome.n_doubted,
            'is_cut': tuning.is_cut, 'seconds': time.monotonic() - start}), indent=2))
    else:
        print('\n'.join(f'{source}: {topic}' for source, topic in inputs.topics.items()))
        print('\n'.join(_lines(outcome, tuning)))
        print(f'\nwritten: {options.out}' if is_better else '\nnothing is written')
    return 0 if is_better else 1


def _show(text: str) -> None:
    """Say on a terminal what is being done, in place of what was said before."""
    if sys.stderr.isatty():
        print(f'\r\x1b[K{text}', end='', file=sys.stderr, flush=True)


def _notes(outcome: Outcome, tuning: Tuning) -> list[str]:
    """Return what is to be known of the estimate."""
    notes = [f'{outcome.measured}; {outcome.folds} parts of the drive held out in turn, in '
             f'stretches of {outcome.stretch:.3g} s']
    if tuning.is_cut:
        notes.append('the bag is long: only its first part was read')
    if outcome.n_doubted > 0:
        notes.append(f'{outcome.n_doubted} measurements contradict the others and were left out')
    return [*notes, outcome.verdict.value]


def _lines(outcome: Outcome, tuning: Tuning) -> list[str]:
    """Return the tables as text."""
    rows = [('', 'before', 'after', '95 %', ''), *(
        (each.name, _value(each.before), _value(each.after) if each.changes else '',
         interval(each), each.note.strip('; ')) for each in outcome.tuned)]
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    lines = ['', *('  '.join([f'{row[0]:<{widths[0]}}', *(
        f'{cell:>{width}}' for cell, width in zip(row[1:4], widths[1:], strict=True)),
        row[4]]).rstrip() for row in rows)]
    lines += ['', f'{"held out":<22}{"rms":>9}{"median":>9}{"NEES":>9}{"NLPD":>9}'
                  f'{"correlation":>13}{"count":>8}']
    for name, of in (('before', outcome.before), ('after', outcome.after)):
        lines.append(f'{name:<22}{of.rms:>7.3f} m{of.median:>7.3f} m{of.nees:>9.3g}'
                     f'{of.nlpd:>9.3f}{of.correlation_time:>11.3g} s{of.n:>8}')
    for name, error in zip(('before, to truth', 'after, to truth'), outcome.to_truth,
                           strict=False):
        lines.append(f'{name:<22}{error:>7.3f} m')
    return [*lines, '', *_notes(outcome, tuning)]


def _value(value: Any) -> str:
    """Return a value for the table."""
    if isinstance(value, list | tuple):
        return '[' + ', '.join(map(_value, value)) + ']' if len(value) > 0 else 'unset'
    return f'{value:.4g}' if isinstance(value, int | float) else str(value)
