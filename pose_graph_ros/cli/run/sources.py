# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The sources of a run in run.json: residuals, expected against found, with a verdict in words."""

import math
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.sources import GLOBAL_POSE, GYRO, Kind, LOOP_CLOSURE, ODOMETRY
from pose_graph_ros.cli.run import Frame, number, rounded, Run
from pose_graph_ros.core.disagreement import ConstraintEnergy
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.judgement.texts import short
from pose_graph_ros.core.sources.bias import CorrelatedErrors
from pose_graph_ros.offline import source_residuals, variance_components
from pose_graph_ros.offline.source_residuals import ScaleFit, SourceResiduals, Whiteness

WRONG = 1.5  # ratio of true to claimed sigmas, or its reciprocal, beyond which they are wrong


class SourceAnalysis(NamedTuple):
    """What the residuals of a source show."""

    residuals: SourceResiduals  # this and the next three as in `Analysis`
    fit: ScaleFit
    whiteness: Whiteness | None
    correlated: bool
    kind: Kind
    in_use: CorrelatedErrors | None  # that the graph is built with; None for white errors
    suspects: tuple[str, ...]  # others of which this is so: their errors may show in its residuals
    advice: str  # the parameter that makes its sigmas right, with its value

    @property
    def scale(self) -> float:
        """Factor on its sigmas in the graph."""
        used = self.residuals.scale[self.residuals.used]
        return float(np.median(used)) if len(used) > 0 else 1.0


def analyse(run: Run) -> dict[str, SourceAnalysis]:
    """Return the analysis of each source."""
    shown = variance_components.analyse(run.backend.parts)
    correlated = {source for source, each in shown.items() if each.correlated}
    guesses = {'odometry': ODOMETRY, 'loop_closure': LOOP_CLOSURE, 'turn': GYRO,
               'map': GLOBAL_POSE}
    reports, found = run.backend.reports(), {}
    for source, each in shown.items():
        fit, report = each.fit, reports.get(source)
        # other odometry than the primary one has no sigma_scale that is used
        advice = f'{source}.sigma_scale to {short(fit.ratio)}'
        if source != run.estimate.primary:
            factor = fit.ratio**2 * float(run.values.get(f'{source}.covariance_scale', 1.0))
            advice = f'{source}.covariance_scale to {short(factor)}'
        found[source] = SourceAnalysis(
            *each, run.kinds.get(source, guesses[each.residuals.kind]), None if report is None
            else report.in_use, tuple(sorted(correlated - {source})), advice)
    return found


def source_entry(analysis: SourceAnalysis, frame: Frame) -> dict[str, Any]:
    """Return the entry of a source in run.json."""
    residuals, found = analysis.residuals, analysis.fit
    used = residuals.rows(residuals.used)
    unused = residuals.rows(~residuals.used)
    far = unused.distances[np.isfinite(unused.distances)]
    expected = {row.coordinate: row.expected for row in found.rows}
    normalised = np.full((len(used.ids), 3), np.nan)
    for row, size in expected.items():
        here = used.measured[:, row] & (size > 0.0)
        normalised[here, row] = used.errors[here, row] / (used.sigmas[here, row] * size)
    names = (*('xy' if residuals.kind == 'map' else ('along', 'across')), 'heading')
    some = source_residuals.spread(len(used.ids), 2000)
    edges = np.linspace(-5.0, 5.0, 41)  # those beyond count in the outermost bins
    values, white = normalised[np.isfinite(normalised)], analysis.whiteness
    def numbers(of: Any, *fields: str) -> dict[str, float | None]:
        return {field: number(getattr(of, field)) for field in fields}

    return {
        'name': residuals.source, 'kind': analysis.kind.name,
        'count': len(residuals.ids), 'used': len(used.ids),
        'rows': [{
            'name': names[row.coordinate], 'unit': 'rad' if row.coordinate == 2 else 'm',
            'count': row.n, **numbers(row, 'sigma', 'expected', 'found', 'ratio', 'low', 'high')}
            for row in found.rows],
        'energy': {'expected': number(found.energy_expected), 'found': number(found.energy_found),
                   'quantile95_share': number(found.within)},
        **numbers(found, 'ratio', 'low', 'high', 'redundancy', 'independent'),
        'verdict': verdict(analysis)[1], 'unused': {
            'count': len(unused.ids), 'median_distance': number(
                float(np.median(far)) if len(far) > 0 else None)},
        'histogram': None if len(values) == 0 or found.says_nothing else {
            'edges': rounded(edges), 'count': np.histogram(
                np.clip(values, edges[0] + 1e-9, edges[-1] - 1e-9), edges)[0].tolist()},
        'series': {'t': frame.seconds(used.stamps_ns[some]),
                   'rows': [rounded(normalised[some, row], 2) for row in expected]},
        'autocorrelation': None if white is None else {
            'lag': rounded(white.lags), 'value': rounded(white.values),
            'band': number(white.band), 'time': number(white.tau) if white.tau > 0.0 else None,
            'fitted': rounded(white.fitted) if white.tau > 0.0 else None,
            'in_use': None if analysis.in_use is None else number(analysis.in_use.tau)},
        'scale': number(analysis.scale)}


def verdict(analysis: SourceAnalysis) -> tuple[str, str]:
    """Return whether the covariances of a source are right: level of the finding, and words."""
    fit = analysis.fit
    if fit.n_used == 0:
        return '', 'nothing of it is used'
    if fit.says_nothing:
        return '', ('its covariances cannot be checked: the path follows '
                    f'it, so that its residuals are {short(100.0 * fit.redundancy)} % of what '
                    'its errors are' if fit.redundancy < 0.1 else 'its covariances cannot be '
                    f'checked: {fit.n_used} measurements are as few as {short(fit.independent)} '
                    'independent ones')
    share = f'{short(fit.ratio)} times' if fit.ratio > 1.0 else f'{short(100.0 * fit.ratio)} % of'
    positions = [row for row in fit.rows if row.coordinate < 2]
    rows, unit = (positions, 'm') if len(positions) > 0 else (list(fit.rows), 'deg')
    sigma = math.sqrt(sum(row.sigma**2 for row in rows) / len(rows))
    sigma = sigma if unit == 'm' else math.degrees(sigma)
    per = '' if analysis.residuals.kind in ('map', 'loop_closure') else ' from node to node'
    text = (f'claims {short(sigma)} {unit}{per}, found {short(sigma * fit.ratio)} {unit}, {share} '
            f'the sigma ({short(fit.low)} to {short(fit.high)})')
    # whether they are surely much too small or too large
    if fit.low > WRONG or (fit.high < 1.0 / WRONG and not analysis.correlated
                           and len(analysis.suspects) == 0):
        level, why = _wrong(analysis)
        return level, f'{text}{why}'
    if analysis.correlated:
        return '', ('its errors go on from one measurement to the next but are treated as '
                    f'independent, so that the path follows them; {text} or more')
    return ('good' if len(analysis.suspects) == 0 else '',
            f'its residuals agree with its covariances: {text}')


def _wrong(analysis: SourceAnalysis) -> tuple[str, str]:
    """Return how bad it is that covariances are wrong, and what to do."""
    ratio, scale, advice = analysis.fit.ratio, analysis.scale, analysis.advice
    if len(analysis.suspects) > 0:
        return 'notice', (f'; this may only be because errors of {" and ".join(analysis.suspects)}'
                          ' are treated as independent')
    if 1.0 / WRONG < ratio / scale < WRONG:
        return 'notice', (f'; the estimate allows for it (sigmas times {short(scale)}); {advice} '
                          'tells it from the beginning')
    if ratio > 1.0:
        return 'warning', f': its covariances are {short(ratio**2)} times too small; set {advice}'
    if analysis.residuals.kind == 'odometry':
        return 'good', (': on the safe side, as slow errors, such as of a wheel radius, hardly '
                        'show from node to node')
    return 'notice', (f': its covariances are {short(ratio**-2)} times too large, so it counts '
                      f'for less than it could; {advice} would be right')


def springs(run: Run, analyses: dict[str, SourceAnalysis], frame: Frame) -> list[dict[str, Any]]:
    """Return the constraints with the largest weighted energies, in descending order."""
    names = {each.number: each.id for each in run.verdicts}
    stamps, path, found = run.backend.node_stamps_ns, run.drive.corrected, []

    for rank, each in enumerate(run.backend.largest_energies(10), 1):
        residual, expected = None, math.nan
        source = analyses.get(each.source)
        at = np.zeros(0, dtype=bool) if source is None else source.residuals.ids == each.number
        if source is not None and np.count_nonzero(at) == 1:
            one = source.residuals.rows(at)
            residual, expected = one.errors[0], float(one.redundancies[0])
        ends = [frame.place(stamps[node], path.poses[node]) for node in each.nodes
                if node < len(path)]
        here = ends[:1]
        if len(ends) == 0 and each.stamp_ns >= 0 and path.covers(each.stamp_ns):
            # a bias is shown where the robot was
            ends = here = [frame.place(each.stamp_ns, path.at(each.stamp_ns))]
        elif len(ends) == 1 and residual is not None and each.kind != 'heading':
            # from where the estimate has it to where it was measured
            node = each.nodes[0]
            ends = [*ends, frame.place(stamps[node], path.poses[node, :2] + residual[:2])]
        name = each.name
        if each.stamp_ns >= 0:  # with the time since the start of the drive
            what, _, rest = name.partition(' at ')
            seconds = (each.stamp_ns - frame.start_ns) * 1e-9
            name = f'{what} at {seconds:.1f} s{rest.partition(" s")[2]}'
        found.append({
            'rank': rank, 'source': each.source, 'kind': each.kind.replace('_', ' '),
            'name': names.get(each.number, name), 'energy': number(each.energy),
            'expected': number(expected if math.isfinite(expected) else float(each.freedom)),
            'from': ends[0] if len(ends) > 0 else None, 'to': ends[1] if len(ends) > 1 else None,
            'text': _text(each, here if len(each.nodes) < 2 else ends, residual)})
    return found


def _text(each: ConstraintEnergy, ends: list[dict[str, Any]], residual: FloatArray | None) -> str:
    """Return what a constraint is and how far it is off; the residual is None if unknown."""
    times = ' to '.join(f'{end["t"]:.1f}' for end in sorted(ends, key=lambda end: end['t']))
    at = f' at {times} s' if len(ends) > 0 else ''
    if each.kind == 'bias':
        return f'error of {each.source}{at}: it changes faster than its correlation time says'
    off = '' if residual is None else (f': {short(np.hypot(*residual[:2]))} m' + (
        '' if residual[2] == 0.0 else f' and {short(abs(residual[2]))} rad') + ' off')
    return f'{each.name.partition(" at ")[0] if len(ends) > 0 else each.name}{at}{off}'
