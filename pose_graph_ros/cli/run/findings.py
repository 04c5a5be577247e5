# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a person must know of a run, in sentences with numbers and the parameter to set.

A *warning* is something to act on, a *notice* something to know, and *good* what was checked and
is as it should be. Covariances count as wrong if the interval of the factor on their sigmas is
beyond 1.5; where the engine has found so by itself and allows for it, that is a notice.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
import math
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.sources import Kind
from pose_graph_ros.cli.run import Run
from pose_graph_ros.cli.run.sources import SourceAnalysis, verdict
from pose_graph_ros.core.alignment import AlignmentState
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.judgement.texts import number_of, sentence, short
from pose_graph_ros.core.judgement.verdicts import Judged, State, Verdict
from pose_graph_ros.core.quantities import Seconds, StampNs
from pose_graph_ros.core.sources.gyro import CONTRADICTORY

LEVELS = ('warning', 'notice', 'good')
MOST_SILENCES = 20  # of a source that are looked at
MOST_TOLD = 3  # stretches and gaps that are told one by one
MOST_SHOWN = 100  # closures that the map marks for one finding
MANY = 3  # measurements that are more than bad luck


class Finding(NamedTuple):
    """One sentence."""

    level: str
    text: str
    anchor: str  # on the page: `map`, `updates`, `errors`, or `source-NAME`
    at: Sequence[tuple[Seconds, Seconds]] = ()  # parts of the drive that it speaks of


def findings(run: Run, analyses: Mapping[str, SourceAnalysis],
             errors: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Return all findings for run.json, the worst first; `errors` are those over time in it."""
    found = [*_whole(run), *_covariances(run, analyses)]
    for source in sorted({each.source for each in run.verdicts}):
        own = [each for each in run.verdicts if each.source == source]
        found += [*_stretches(run, source, own), *_closures(run, source, own),
                  *_odometry(run, source, own)]
    found += [*silences(run.drive.arrived_ns, run.kinds, run.start_ns), *_refusals(run),
              *_others(run), *_path(run, errors)]
    return in_order(found)


def in_order(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    """Return findings for run.json, the worst first."""
    found = [*findings]
    if all(each.level == 'good' for each in found):
        found.append(Finding('good', 'nothing was found that needs a person', 'map'))
    found.sort(key=lambda each: LEVELS.index(each.level))
    return [each._asdict() for each in found]


def _whole(run: Run) -> Iterator[Finding]:
    """Yield what concerns the whole graph."""
    estimate, report = run.estimate, run.report
    yield from (Finding('warning', text, 'map') for text in run.drive.damage)
    if report.status is not Status.CONVERGED:
        reason = f': {report.reason}' if report.reason else ''
        yield Finding('warning', f'the final optimisation did not converge ({report.status.value}'
                                 f'{reason}): the path is not at the minimum', 'updates')
    if estimate.alignment is AlignmentState.UNALIGNED:
        yield Finding('warning', 'the angle between odometry and map is unknown, as fixes are too '
                      'few or from too short a path: drive farther', 'map')
    elif estimate.alignment is AlignmentState.LOCAL:
        others = '' if len(run.backend.parts.pipeline.beacons.ids) == 0 else ' and beacons'
        yield Finding('notice', 'nothing was measured in the map, so the path begins at its '
                      f'origin, and nothing but loop closures{others} bounds its drift', 'map')
    for source, each in run.backend.calibrations().items():
        yield Finding(
            'good', f'{source}: its yaw rate is corrected by {short(each.rate, 3)} rad/s (sigma '
            f'{short(each.rate_sigma)}), its way by {short(100.0 * each.scale, 3)} % (sigma '
            f'{short(100.0 * each.scale_sigma)}), as calibrated at the end', f'source-{source}')
    if run.backend.n_quarantined > 0:
        names = ', '.join(run.backend.set_aside(3))
        yield Finding('warning', f'{run.backend.n_quarantined} constraints are set aside because '
                                 f'the solver fails with them: {names}', 'updates')


def _covariances(run: Run, analyses: Mapping[str, SourceAnalysis]) -> Iterator[Finding]:
    """Yield what the residuals of sources say of their covariances, and of their independence."""
    reports = run.backend.reports()
    for source, analysis in analyses.items():
        anchor, report = f'source-{source}', reports.get(source)
        if report is not None and report.in_use is not None:
            by = 'found by itself and' if report.found else 'by its parameter,'
            yield Finding('good', f'{source}: errors are correlated over '
                                  f'{short(report.in_use.tau)} s, {by} allowed for', anchor)
        elif report is not None and report.wrongly_white:
            yield Finding(
                'warning', f'{source}: errors of {short(report.errors.sigma_correlated)} m go on '
                f'for {short(report.errors.tau)} s but are treated as independent, so that the '
                f'path is less certain than its covariances say; set {source}.correlation_time to '
                f'-1, which finds the time, at least {short(report.errors.tau)} s', anchor)
        level, text = verdict(analysis)
        if level:
            yield Finding(level, f'{source}: {text}', anchor)


def _others(run: Run) -> Iterator[Finding]:
    """Yield which sources contradict the others, and what concerns the times of updates."""
    found = run.backend.disagreement()
    if found is not None:
        yield Finding('warning', found.text, f'source-{found.source}')
    for source, each in run.backend.gyro_differences().items():
        if each.sigmas > CONTRADICTORY and each.reason and (
                found is None or found.source != source):
            yield Finding('warning', f'of {source} and odometry one is wrong: {each.reason}',
                          f'source-{source}')
    period = 1e3 / float(run.values['frequency'])
    slow = [each for each in run.recorder.updates if each.milliseconds > period]
    worst = max(slow, key=lambda each: each.milliseconds, default=None)
    # a single one may be the machine's fault
    if worst is not None and (len(slow) > 2 or worst.milliseconds > 5.0 * period):
        at = (worst.stamp_ns - run.start_ns) * 1e-9
        yield Finding(
            'notice', f'{len(slow)} of {run.recorder.n_updates} updates took longer than their '
            f'period of {period:.0f} ms, the longest {worst.milliseconds:.0f} ms at {at:.0f} s '
            f'with {worst.nodes} nodes; a window bounds them (window.seconds)', 'updates')


def _path(run: Run, errors: Mapping[str, Any] | None) -> Iterator[Finding]:
    """Yield how large the errors of the path are, where there is a truth or held-out fixes."""
    if errors is None:
        return
    far = np.array(errors['position'], dtype=float)
    rms = math.sqrt(float(np.mean(far**2)))
    odometry = np.array([np.nan if each is None else each for each in errors['odometry']])
    alone = math.sqrt(float(np.nanmean(odometry**2))) if np.any(np.isfinite(odometry)) else None
    text = f'the path is {short(rms)} m rms from the {errors["against"]}'
    if alone is not None:
        text += f', odometry alone {short(alone)} m'
    if run.drive.truth_moved is not None:
        far_off, turn = run.drive.truth_moved
        text += (', each where it fits best (the truth was moved by '
                 f'{short(far_off)} m and {short(math.degrees(turn))} deg)')
    aligned, ratio = run.estimate.alignment is AlignmentState.ALIGNED, 0.0
    sigma = np.array([np.nan if each is None else each for each in errors['sigma'] or ()])
    known = np.isfinite(sigma) & (sigma > 0.0)
    # else the covariances are those to the first pose, which is no better known than the others
    if aligned and errors['against'] == 'truth' and np.any(known):
        ratio = math.sqrt(float(np.mean((far[known] / sigma[known])**2)))
    # errors of a path are few independent ones, as they go on for minutes
    overconfident = ratio > 2.5
    if overconfident:
        yield Finding('warning', f'errors of the path are {short(ratio)} times what its '
                                 'covariances say', 'errors')
    worse = alone is not None and rms > alone and aligned
    better = alone is None or float(short(rms)) < float(short(alone))
    yield Finding('warning' if worse else 'good' if better and not overconfident
                  else 'notice', text, 'errors')


def _stretches(run: Run, source: str, verdicts: Sequence[Verdict]) -> Iterator[Finding]:
    """Yield the stretches of fixes that are doubted."""
    every = sorted((each for each in verdicts if each.kind is Judged.FIX),
                   key=lambda each: each.stamp_ns)
    at = np.flatnonzero([each.state is State.DOUBTED for each in every])
    if len(at) == 0:
        return
    # of one stretch if at most two others are between them
    parts = sorted(np.split(at, np.flatnonzero(np.diff(at) > 3) + 1), key=len, reverse=True)
    long = [part for part in parts if len(part) >= MANY]
    for part in long[:MOST_TOLD]:
        begin, end = (1e-9 * (every[k].stamp_ns - run.start_ns) for k in (part[0], part[-1]))
        far = [float(np.hypot(*every[k].residual[:2])) for k in part]
        size = f', {short(np.nanmedian(far))} m from the path' if np.any(np.isfinite(far)) else ''
        yield Finding('warning', f'{source}: {number_of(len(part), Judged.FIX)} from {begin:.1f} '
                      f's to {end:.1f} s contradict the path and are not used{size}: look for '
                      'reflections, or a jump of the receiver', 'map', [(begin, end)])
    rest = len(at) - sum(map(len, long[:MOST_TOLD]))
    if rest > 0:
        more = ' more' if len(long) > 0 else ''
        yield Finding('notice', f'{source}: {rest}{more} of {number_of(len(every), Judged.FIX)} '
                      'contradict the path, alone or in other stretches, and are not used', 'map')


def _closures(run: Run, source: str, verdicts: Sequence[Verdict]) -> Iterator[Finding]:
    """Yield how many loop closures are doubted, and how many wait."""
    every = [each for each in verdicts if each.kind is Judged.LOOP_CLOSURE]
    of_all = f'of {number_of(len(every), Judged.LOOP_CLOSURE)}'
    doubted = [each for each in every if each.state is State.DOUBTED]
    if len(doubted) > 0:
        worst = max(doubted, key=lambda each: np.nan_to_num(each.distance, nan=-1.0, posinf=-1.0))
        far = f', {worst.distance:.1f} sigma' if np.isfinite(worst.distance) else ''
        yield Finding(
            'warning' if len(doubted) >= MANY else 'notice', f'{source}: {len(doubted)} {of_all} '
            f'contradict the others and are not used; the strongest: {worst.id}{far}', 'map',
            _ends(run, doubted))
    for state, text in (
            (State.WAITING, 'are not used, as too little speaks for or against them'),
            (State.WEAKLY_BELIEVED,
             'are used, though little but the record of the source speaks for them')):
        some = [each for each in every if each.state is state]
        if len(some) > 0:
            yield Finding('notice', f'{source}: {len(some)} {of_all} {text}', 'map',
                          _ends(run, some))


def _ends(run: Run, closures: Sequence[Verdict]) -> list[tuple[Seconds, Seconds]]:
    """Return the times of both ends of some closures."""
    stamps = (stamp for each in closures[:MOST_SHOWN] for stamp in (
        each.reference_ns, each.stamp_ns) if stamp is not None)
    return [(at, at) for at in (round(1e-9 * (stamp - run.start_ns), 3) for stamp in stamps)]


def _odometry(run: Run, source: str, verdicts: Sequence[Verdict]) -> Iterator[Finding]:
    """Yield where odometry is doubted."""
    doubted = [each for each in verdicts
               if each.kind is Judged.ODOMETRY and not each.state.in_graph]
    for each in doubted[:MOST_TOLD]:
        at = (each.stamp_ns - run.start_ns) * 1e-9
        yield Finding('warning', f'{source}: odometry is wrong before {at:.1f} s: '
                                 f'{sentence(each, run.start_ns)}', 'map', [(at, at)])
    if len(doubted) > MOST_TOLD:
        yield Finding('warning', f'{source}: odometry is doubted in {len(doubted) - MOST_TOLD} '
                                 'more places', 'map')
    jumps = run.counts.get((source, 'jump'), 0)
    if jumps > 0:
        yield Finding('warning', f'{source}: odometry jumped {jumps} times by more '
                      f'than {source}.maximum_speed allows; the motion there is taken as unknown',
                      'map')


def silent(stamps_ns: Sequence[StampNs], least_s: Seconds) -> FloatArray:
    """
    Return the longest silences of a source: begin and end [s], shape (K, 2).

    Stamps are in the order of arrival, not positive ones do not count; the silence before a late
    one is not seen.
    """
    stamps = np.array(stamps_ns, dtype=np.int64)
    newest = np.maximum.accumulate(stamps[stamps > 0])
    if len(newest) < 3:
        return np.empty((0, 2))
    lengths = np.diff(newest)
    longest = np.argsort(lengths, kind='stable')[-MOST_SILENCES:]
    others = np.delete(lengths, longest)
    usual = float(np.mean(others) if len(others) > 0 else np.median(lengths))
    found = np.sort(longest[lengths[longest] > max(least_s * 1e9, 8.0 * usual)])
    return np.column_stack((newest[found], newest[found + 1])) * 1e-9


def silences(arrived_ns: Mapping[str, Sequence[StampNs]], kinds: Mapping[str, Kind],
             start_ns: StampNs) -> Iterator[Finding]:
    """Yield silences of odometry, and of fixes and global poses."""
    for source, stamps_ns in arrived_ns.items():
        kind = kinds.get(source)
        if kind is None or not (kind.is_motion or kind.in_map):
            continue
        moves = kind.is_motion
        gaps = silent(stamps_ns, 0.5 if moves else 4.0) - start_ns * 1e-9
        if len(gaps) == 0:
            continue
        lengths = gaps[:, 1] - gaps[:, 0]
        told = gaps[np.sort(np.argsort(-lengths, kind='stable')[:MOST_TOLD])]
        where = ', '.join(f'{begin:.1f} to {end:.1f} s' for begin, end in told.tolist())
        more = f' and {len(gaps) - len(told)} more' if len(gaps) > len(told) else ''
        others = any(each.is_odometry and name != source and name in arrived_ns
                     for name, each in kinds.items())
        what = ('the path follows odometry there, and its covariance grows' if not moves else
                'the heading there is that of other sources' if not kind.is_odometry else
                'the motion there is that of other odometry, as far as it goes on' if others else
                'the motion there is not known')
        longest = float(np.max(lengths))
        yield Finding('warning' if longest > 20.0 else 'notice', f'{source}: no messages from '
                      f'{where}{more} ({short(longest, 3)} s at most); {what}', f'source-{source}',
                      [(begin, end) for begin, end in told.tolist()])


def _refusals(run: Run) -> Iterator[Finding]:
    """Yield how many messages were refused, by source and reason."""
    invalid = []
    for (source, reason), count in sorted(run.counts.items()):
        if reason == 'default_covariance' or reason.startswith('repaired'):
            invalid.append(Finding(
                'notice', f'{source}: {count} messages with a covariance that is not valid '
                f'({reason}); set {source}.covariance_override to its sigma', f'source-{source}'))
        elif source not in ('solver', 'alignment') and reason not in (
                'accepted', 'pending', 'sorted', 'thinned', 'rotations', 'done_over', 'jump'):
            detail = run.backend.refusals.get((source, reason), '')
            total = sum(n for (of, _), n in run.counts.items() if of == source)
            yield Finding('warning' if count > 0.05 * total else 'notice',
                          f'{source}: {count} of {total} messages are not used: {reason}'
                          + (f', the last: {detail}' if detail else ''), f'source-{source}')
    yield from invalid
