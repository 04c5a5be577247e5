# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a person must know of a run, in sentences with numbers and the parameter to set.

A *warning* is something to act on, a *notice* something to know, and *good* what was checked and
is as it should be. Covariances count as wrong if the interval of the factor on their sigmas is
beyond 1.5; where the engine has found so by itself and allows for it, that is a notice.
"""

from collections.abc import Iterator
import math
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.cli.run import measurement_findings
from pose_graph_ros.cli.run.content import Run
from pose_graph_ros.cli.run.sources import claim, SourceAnalysis, WRONG
from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.judgement.texts import short
from pose_graph_ros.core.odometry.agreement import CONTRADICTORY
from pose_graph_ros.core.residuals.scale import ScaleFit

# Ratio of true to claimed errors of the path from which its covariances count as too small: its
# errors are few independent ones, as they go on for minutes.
OVERCONFIDENT = 2.5
# A single update is told of if it takes this many periods.
MUCH_LONGER = 5.0
LEVELS = ('warning', 'notice', 'good')


class Finding(NamedTuple):
    """One sentence."""

    level: str
    text: str
    anchor: str
    """Place on the page that shows more: `map`, `updates`, `errors`, or `source-NAME`."""


def findings(run: Run, analyses: dict[str, SourceAnalysis]) -> list[dict[str, Any]]:
    """Return all findings for run.json, the worst first."""
    found = [*_whole(run), *(finding for each in analyses.values() for finding in _covariances(
        run, each)), *(Finding(*each) for each in measurement_findings.found(run)),
        *_disagreements(run), *_updates(run), *_path(run)]
    if all(each.level == 'good' for each in found):
        found.append(Finding('good', 'nothing was found that needs a person', 'map'))
    found.sort(key=lambda each: LEVELS.index(each.level))
    return [each._asdict() for each in found]


def _whole(run: Run) -> Iterator[Finding]:
    """Yield what concerns the whole graph."""
    estimate, report = run.estimate, run.report
    if report is not None and report.status is not Status.CONVERGED:
        reason = f': {report.reason}' if report.reason else ''
        yield Finding('warning', f'the final optimisation did not converge ({report.status.value}'
                                 f'{reason}): the path is not at the minimum', 'updates')
    if estimate.alignment is AlignmentState.UNALIGNED:
        yield Finding(
            'warning', 'the angle between odometry and map is unknown, as fixes are too few or '
            'from too short a path: drive farther', 'map')
    elif estimate.alignment is AlignmentState.LOCAL:
        yield Finding('notice', 'nothing was measured in the map, so the path begins at its '
                                'origin, and nothing but loop closures bounds its drift', 'map')
    if run.backend.n_quarantined > 0:
        names = ', '.join(run.backend.set_aside(3))
        yield Finding('warning', f'{run.backend.n_quarantined} constraints are set aside because '
                                 f'the solver fails with them: {names}', 'updates')


def _covariances(run: Run, analysis: SourceAnalysis) -> Iterator[Finding]:
    """Yield what the residuals of a source say of its covariances and their independence."""
    source, fit, anchor = (analysis.residuals.source, analysis.fit,
                           f'source-{analysis.residuals.source}')
    yield from _correlation(run, analysis)
    if fit.says_nothing:
        return
    used = analysis.residuals.scale[analysis.residuals.used]
    scale = float(np.median(used)) if len(used) > 0 else 1.0
    if not analysis.is_wrong:
        if not analysis.correlated and len(analysis.suspects) == 0:
            yield Finding('good', f'{source}: its residuals agree with its covariances '
                                  f'({short(fit.ratio)} times the sigma, {_interval(fit)})',
                          anchor)
        return
    advice = _advice(run, analysis)
    large = fit.ratio > 1.0
    share = f'{short(fit.ratio)} times' if large else f'{short(100.0 * fit.ratio)} % of'
    text = f'{source}: {claim(analysis)}, {share} the sigma ({_interval(fit)})'
    if len(analysis.suspects) > 0:
        yield Finding('notice', f'{text}; this may only be because errors of '
                                f'{" and ".join(analysis.suspects)} are treated as independent',
                      anchor)
    elif 1.0 / WRONG < fit.ratio / scale < WRONG:
        yield Finding('notice', f'{text}; the estimate allows for it (sigmas times '
                                f'{short(scale)}); {advice} tells it from the beginning', anchor)
    elif large:
        yield Finding('warning', f'{text}: its covariances are {short(fit.ratio**2)} times too '
                                 f'small; set {advice}', anchor)
    elif analysis.residuals.kind == 'odometry':
        yield Finding('good', f'{text}: on the safe side, as slow errors, such as of a wheel '
                              'radius, hardly show from node to node', anchor)
    else:
        yield Finding('notice', f'{text}: its covariances are {short(fit.ratio**-2)} times too '
                                f'large, so it counts for less than it could; {advice} would be '
                                'right', anchor)


def _interval(fit: ScaleFit) -> str:
    return f'{short(fit.low)} to {short(fit.high)}'


def _advice(run: Run, analysis: SourceAnalysis) -> str:
    """Return the parameter that makes the sigmas of a source right, with its value."""
    source, ratio = analysis.residuals.source, analysis.fit.ratio
    # other odometry than the primary one has no sigma_scale that is used
    if source == run.estimate.primary:
        return f'{source}.sigma_scale to {short(ratio)}'
    factor = ratio**2 * float(run.values.get(f'{source}.covariance_scale', 1.0))
    return f'{source}.covariance_scale to {short(factor)}'


def _correlation(run: Run, analysis: SourceAnalysis) -> Iterator[Finding]:
    """Yield whether errors of a source in the map go on from one measurement to the next."""
    source = analysis.residuals.source
    report = run.backend.reports().get(source)
    if report is None:
        return
    anchor = f'source-{source}'
    if report.in_use is not None:
        by = 'found by itself and' if report.found else 'by its parameter,'
        yield Finding('good', f'{source}: errors are correlated over '
                              f'{short(report.in_use.tau)} s, {by} allowed for', anchor)
    elif report.wrongly_white:
        yield Finding(
            'warning', f'{source}: errors of {short(report.errors.sigma_correlated)} m go on for '
            f'{short(report.errors.tau)} s but are treated as independent, so that the path is '
            f'less certain than its covariances say; set {source}.correlation_time to -1, which '
            f'finds the time, at least {short(report.errors.tau)} s', anchor)


def _disagreements(run: Run) -> Iterator[Finding]:
    """Yield which sources contradict the others."""
    found = run.backend.disagreement()
    if found is not None:
        yield Finding('warning', found.text, f'source-{found.source}')
    for source, each in run.backend.gyro_differences().items():
        if each.sigmas > CONTRADICTORY and each.reason and (
                found is None or found.source != source):
            yield Finding('warning', f'of {source} and odometry one is wrong: {each.reason}',
                          f'source-{source}')


def _updates(run: Run) -> Iterator[Finding]:
    """Yield what concerns the times of updates."""
    updates = run.recorder.log.updates
    period = 1e3 / float(run.values['frequency'])
    slow = [each for each in updates if each.milliseconds > period]
    worst = max(slow, key=lambda each: each.milliseconds, default=None)
    # a single one may be the machine's fault
    if worst is not None and (len(slow) > 2 or worst.milliseconds > MUCH_LONGER * period):
        at = (worst.stamp_ns - run.start_ns) * 1e-9
        yield Finding(
            'notice', f'{len(slow)} of {run.recorder.log.count} updates took longer than their '
            f'period of {period:.0f} ms, the longest {worst.milliseconds:.0f} ms at {at:.0f} s '
            f'with {worst.nodes} nodes; a window bounds them (window.seconds)', 'updates')


def _path(run: Run) -> Iterator[Finding]:
    """Yield how large the errors of the path are, where there is a truth or held-out fixes."""
    errors = run.errors
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
    # else the covariances are those to the first pose, which is no better known than the others
    aligned = run.estimate.alignment is AlignmentState.ALIGNED
    ratio = _to_claimed(errors, far) if aligned else 0.0
    if ratio > OVERCONFIDENT:
        yield Finding('warning', f'errors of the path are {short(ratio)} times what its '
                                 'covariances say', 'errors')
    worse = alone is not None and rms > alone and aligned
    better = alone is None or float(short(rms)) < float(short(alone))
    yield Finding('warning' if worse else 'good' if better and ratio <= OVERCONFIDENT
                  else 'notice', text, 'errors')


def _to_claimed(errors: dict[str, Any], far: FloatArray) -> float:
    """Return the ratio of the errors of a path, shape (N,) [m], to what it claims; 0 unknown."""
    sigma = np.array([np.nan if each is None else each for each in errors['sigma'] or ()])
    known = np.isfinite(sigma) & (sigma > 0.0)
    if errors['against'] != 'truth' or not np.any(known):
        return 0.0
    return math.sqrt(float(np.mean((far[known] / sigma[known])**2)))
