# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The results of a run, of a replay as of a demo: files in a folder, and lines for people.

What the page of `pose-graph report` shows is the JSON object in run.json, see docs/tools.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from pose_graph_ros.cli.drive import (
    consistency,
    consistency_lines,
    extent,
    format_table,
    STATES,
    summary,
)
from pose_graph_ros.cli.run import places, Run, thinned
from pose_graph_ros.cli.run.findings import findings
from pose_graph_ros.cli.run.places import number, rounded
from pose_graph_ros.cli.run.sources import analyse, source_entry, springs
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.io.path_files import write_tum
from pose_graph_ros.core.judgement.texts import as_json, is_notable, ORDER, short, totals_text
from pose_graph_ros.core.judgement.verdicts import Judged, SourceVerdicts, Verdict
from pose_graph_ros.core.odometry.motion import AS_CLAIMED
from pose_graph_ros.offline.drawing import pattern as patterns
from pose_graph_ros.offline.drawing.pattern import BinnedPattern
from pose_graph_ros.offline.residuals import variance_components

VERSION = 1
FILE = 'run.json'
KEYS = (
    'title', 'subtitle', 'start', 'start_ns', 'duration', 'axes', 'offset', 'facts', 'findings',
    'lines', 'ellipses', 'fixes', 'closures', 'states', 'errors', 'error_table', 'sources',
    'springs', 'updates', 'sparsity', 'texts')


def read_document(path: Path) -> dict[str, Any]:
    """Return the JSON object of a run; raises FileFormatError if it is not of this version."""
    def refused(text: str) -> None:
        raise FileFormatError(f'{path}: expected finite numbers, got {text}')

    try:
        data = json.loads(path.read_text(encoding='utf-8'), parse_constant=refused)
    except json.JSONDecodeError as error:
        raise FileFormatError(f'{path}:{error.lineno}: not JSON: {error.msg}') from error
    except (UnicodeDecodeError, RecursionError) as error:
        raise FileFormatError(f'{path}: not JSON') from error
    if not isinstance(data, dict) or 'version' not in data:
        raise FileFormatError(f'{path}: not the {FILE} of a replay or a demo')
    if data['version'] != VERSION:
        raise FileFormatError(f'{path}: expected version {VERSION}, got {data["version"]}: '
                              'replay the bag again')
    missing = [key for key in KEYS if key not in data]
    if missing:
        raise FileFormatError(f'{path}: no {missing[0]}')
    return data


def document(run: Run) -> dict[str, Any]:
    """Return the JSON object of a run."""
    drive, path = run.drive, run.drive.corrected
    frame = places.Frame(run.start_ns, np.round(path.poses[0, :2], 3) + 0.0)
    verdicts = {(each.source, each.stamp_ns, each.reference_ns): each for each in run.verdicts}
    errors = places.errors(drive, run.covariances, frame)
    analysis = variance_components.analyse(run.backend.parts)
    analyses = analyse(run, analysis)
    lines, at_ns = places.lines(drive, frame)
    return {
        'version': VERSION, 'title': run.title, 'subtitle': run.subtitle,
        'start': _utc(run.start_ns), 'start_ns': str(run.start_ns),
        'duration': round(extent(path)[0], 3),
        'axes': list(drive.map_axes), 'offset': rounded(frame.offset),
        'facts': _facts(run), 'findings': findings(run, analyses, errors), 'lines': lines,
        'ellipses': places.ellipses(path, run.covariances, frame),
        'fixes': places.fixes(drive, verdicts, at_ns, frame),
        'closures': places.closures(drive, verdicts, run.recorder.refused, frame),
        'states': list(STATES), 'errors': errors,
        'error_table': [asdict(row) | {name: number(getattr(row, name), 5) for name in (
            'median', 'rms', 'p95', 'maximum')} for row in drive.rows],
        'sources': [source_entry(each, frame) for each in analyses.values()],
        'springs': springs(run, analysis.residuals, frame),
        'updates': _updates(run, frame), 'sparsity': _sparsity(run.backend.graph),
        'texts': list(frame.texts)}


def write_document(run: Run, folder: Path) -> dict[str, Any]:
    """Return the JSON object of a run, after writing it into a folder as run.json."""
    data = document(run)
    text = json.dumps(data, allow_nan=False, separators=(',', ':'), ensure_ascii=False)
    (folder / FILE).write_text(text + '\n', encoding='utf-8')
    return data


def _utc(stamp_ns: int) -> str | None:
    """Return a stamp as a time of day with milliseconds; None if it is not of this epoch."""
    stamp = np.datetime64(stamp_ns, 'ns')
    # before, stamps count from any beginning
    return None if stamp < np.datetime64('2000') else f'{stamp.astype("datetime64[ms]")}Z'


def _facts(run: Run) -> list[dict[str, str]]:
    """Return what stands at the head of the page."""
    estimate, drive = run.estimate, run.drive
    duration, travelled = extent(drive.corrected)
    longest = max((each.milliseconds for each in run.recorder.updates), default=None)
    freedom = _freedom(run.backend.graph)
    facts = [
        ('duration', _clock(duration), ''), ('distance', _metres(travelled), 'of the path'),
        ('hidden nodes', str(estimate.n_hidden), '' if estimate.n_frozen == 0 else
         f'{estimate.n_frozen} of them have left the window'),
        ('edges', str(estimate.n_edges), 'between poses'),
        ('measurements', str(estimate.n_observed), 'in the map, in the graph'),
        ('chi2', f'{estimate.chi2:.5g}', f'{freedom} degrees of freedom'),
        ('alignment', estimate.alignment.value, 'of odometry with the map'),
        ('optimisation', run.report.status.value.replace('_', ' '),
         f'{run.report.iterations} iterations at the end')]
    if len(drive.loop_stamps_ns) > 0:
        facts.append(('loop closures', str(len(drive.loop_stamps_ns)), ''))
    for row in drive.rows:
        if row.name in ('corrected path to truth', 'corrected path to fixes held out'):
            facts.append(('error', f'{row.rms:.2f} m rms', row.name.partition(' to ')[2]))
    facts.append(('time to run', f'{run.seconds:.1f} s',
                  f'{duration / max(run.seconds, 1e-9):.0f} times as fast as driven'))
    if longest is not None:
        facts.append(('longest update', f'{longest:.1f} ms', f'of {run.recorder.n_updates}'))
    return [{'label': label, 'value': value, 'note': note} for label, value, note in facts]


def _freedom(graph: Graph) -> int:
    """Return the number of measured coordinates with a weight, less that of unknowns."""
    information = graph.factors_by_row.information[graph.weights > 0.0]
    measured = int(np.count_nonzero(np.diagonal(information, axis1=1, axis2=2) > 0.0))
    return measured - int(np.sum(graph.dimension[~graph.fixed]))


def _clock(seconds: float) -> str:
    if seconds < 120.0:
        return f'{seconds:.1f} s'
    minutes, rest = divmod(round(seconds), 60)
    return f'{minutes} min {rest:02d} s' if minutes < 60 else (
        f'{minutes // 60} h {minutes % 60:02d} min')


def _metres(metres: float) -> str:
    return f'{metres:.1f} m' if metres < 1000.0 else f'{1e-3 * metres:.2f} km'


def _updates(run: Run, frame: places.Frame) -> dict[str, Any] | None:
    """Return the updates as columns; None if none was recorded."""
    if len(run.recorder.updates) == 0:
        return None
    stamps, nodes, milliseconds, chi2 = zip(*thinned(run.recorder.updates), strict=True)
    return {'t': frame.seconds(np.array(stamps)), 'nodes': list(nodes),
            'ms': rounded(milliseconds, 2), 'chi2': [number(each, 6) for each in chi2],
            'count': run.recorder.n_updates,
            'period': number(1e3 / float(run.values['frequency']))}


def _sparsity(graph: Graph) -> list[dict[str, Any]]:
    """Return the patterns of H and of its factor."""
    def entry(title: str, pattern: BinnedPattern, fill: int) -> dict[str, Any]:
        return {'title': title, 'size': pattern.size, 'nonzeros': pattern.nonzeros,
                'fill': max(fill, 0), 'bins': pattern.bins, 'cells': pattern.cells.tolist()}

    whole, factor = patterns.hessian(graph), patterns.factor(graph)
    upper = (whole.nonzeros + whole.size) // 2
    return [entry('H, poses in the order of time, then biases', whole, 0),
            entry('R, in the order of elimination', factor, factor.nonzeros - upper)]


def write_results(run: Run, folder: Path, facts: Mapping[str, Any]) -> list[str]:
    """Return what people want to know, after writing path, picture, summary.json and run.json."""
    # matplotlib takes half a second to load, and wrong input needs none of it
    from pose_graph_ros.cli.picture import draw_drive  # noqa: PLC0415

    drive, estimate, backend, report = run.drive, run.estimate, run.backend, run.report
    folder.mkdir(parents=True, exist_ok=True)
    write_tum(drive.corrected, folder / 'path.tum')
    draw_drive(drive, folder / 'drive.png', run.title)
    totals = backend.verdict_totals()
    counts = {'.'.join(key): count for key, count in sorted(run.counts.items())}
    calibrations = {source: each._asdict() for source, each in backend.calibrations().items()}
    nees = {} if drive.truth is None or report.status is Status.FAILED else consistency(
        drive, run.covariances)
    text = json.dumps(summary(drive, {
        **facts, **{f'nees_{name}': each for name, each in nees.items()},
        **({'calibrations': calibrations} if len(calibrations) > 0 else {}),
        'alignment': estimate.alignment.value,
        'hidden_nodes': estimate.n_hidden, 'frozen_nodes': estimate.n_frozen,
        'thinned_nodes': estimate.n_thinned, 'edges': estimate.n_edges,
        'observed_nodes': estimate.n_observed, 'biases': estimate.n_biases,
        'chi2': estimate.chi2, 'odometry_errors': estimate.odometry_errors._asdict(),
        'status': report.status.value, 'counts': counts,
        'judged': _judgement(totals, run.verdicts)}), indent=2)
    (folder / 'summary.json').write_text(text + '\n', encoding='utf-8')
    told = write_document(run, folder)
    lines = [f'{estimate.n_hidden} hidden nodes, {estimate.n_edges} edges, {estimate.n_observed} '
             f'observed nodes in {run.seconds:.2f} s; {report.status.value}, chi2 '
             f'{report.chi2:.6g}; {estimate.alignment.value}']
    errors = estimate.odometry_errors
    if errors != AS_CLAIMED:
        corrected = [f'{short(factor * value, 3)} +- {short(factor * sigma, 2)} {unit}'
                     for value, sigma, factor, unit in (
                         (errors.rate, errors.rate_sigma, 1.0, 'rad/s'),
                         (errors.scale, errors.scale_sigma, 100.0, '% of the way'))
                     if value != 0.0]
        lines.append('; corrected by '.join(filter(None, (
            f'{estimate.primary}: noise of the way {short(math.sqrt(errors.way), 3)} times, of '
            f'turns {short(math.sqrt(errors.turn), 3)} times what it claims',
            ' and '.join(corrected)))))
    lines += [f'{source}: {totals_text(of_source)}' for source, of_source in totals.items()]
    lines += [f'{each["level"]:8} {each["text"]}' for each in told['findings']]
    if 'new_bag' in facts:
        lines.append('new bag: {original} messages copied, {left_out} left out, {corrected} poses '
                     'of odometry corrected'.format(**facts['new_bag']))
    return [*lines, 'counts: ' + ', '.join(f'{name} {count}' for name, count in counts.items()),
            '', format_table(drive.rows), *consistency_lines(nees), '']


def _judgement(
    totals: Mapping[str, SourceVerdicts], verdicts: Sequence[Verdict],
) -> dict[str, object]:
    """Return counts of each source, and all closures and all that is not believed."""
    return {
        'sources': {source: {
            'states': {state.value: each.counts.get(state, 0) for state in ORDER},
            'forgotten': each.n_forgotten}
            for source, each in totals.items()},
        'constraints': [as_json(each) for each in verdicts
                        if each.kind is Judged.LOOP_CLOSURE or is_notable(each)]}
