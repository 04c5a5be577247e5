# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The results of a run, of a replay as of a demo: files in a folder, and lines for people.

What the page of `pose-graph report` shows is the JSON object in run.json: docs/tools/report.md.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.cli import drive as drives, finite
from pose_graph_ros.cli.drive import BELIEVED, distances, Drive, extent, HELD_OUT, REFUSED
from pose_graph_ros.cli.html_page import duration_text, length_text
from pose_graph_ros.cli.run import Frame, number, rounded, Run, thinned
from pose_graph_ros.cli.run.findings import findings
from pose_graph_ros.cli.run.sources import analyse, source_entry, springs
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry.se2 import Covariances, IntArray, wrap
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.io.path_files import write_tum
from pose_graph_ros.core.judgement import texts
from pose_graph_ros.core.judgement.texts import Key, sentence, short
from pose_graph_ros.core.judgement.verdicts import Judged
from pose_graph_ros.core.odometry.motion import AS_CLAIMED
from pose_graph_ros.offline import pattern as patterns
from pose_graph_ros.offline.source_residuals import spread

REFUSED_SOMEHOW = 'Refused; the counts of its source say why.'
MOST_POSES = 10_000  # of a path
MOST_OF_SOURCE = 20_000  # fixes or loop closures; half are kept for those not believed
VERSION, FILE = 1, 'run.json'
KEYS = ('title', 'subtitle', 'start', 'start_ns', 'duration', 'axes', 'offset', 'facts',
        'findings', 'lines', 'ellipses', 'fixes', 'closures', 'states', 'errors', 'error_table',
        'sources', 'springs', 'updates', 'sparsity', 'texts')


class Told(NamedTuple):
    """What is told of a measurement."""

    id: str
    distance: float  # when it was judged [sigma]
    why: str  # it is believed or not


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
    frame = Frame(run.start_ns, np.round(path.poses[0, :2], 3) + 0.0)
    verdicts = {(each.source, each.stamp_ns, each.reference_ns): Told(
        each.id, each.distance, sentence(each, frame.start_ns)
        if each.kind is not Judged.FIX or texts.is_notable(each) else '')
        for each in run.verdicts}
    errors = _errors(drive, run.covariances, frame)
    analyses = analyse(run)
    paths, at_ns = lines(drive, frame)
    start, updates = np.datetime64(run.start_ns, 'ns'), None
    if len(run.recorder.updates) > 0:
        stamps, nodes, milliseconds, chi2 = zip(*thinned(run.recorder.updates), strict=True)
        updates = {'t': frame.seconds(np.array(stamps)), 'nodes': list(nodes),
                   'ms': rounded(milliseconds, 2), 'chi2': [number(each, 6) for each in chi2],
                   'count': run.recorder.n_updates,
                   'period': number(1e3 / float(run.values['frequency']))}
    return {
        'version': VERSION, 'title': run.title, 'subtitle': run.subtitle,
        # before, stamps count from any beginning
        'start': None if start < np.datetime64('2000') else f'{start.astype("datetime64[ms]")}Z',
        'start_ns': str(run.start_ns),
        'duration': round(extent(path)[0], 3),
        'axes': list(drive.map_axes), 'offset': rounded(frame.offset),
        'facts': _facts(run), 'findings': findings(run, analyses, errors), 'lines': paths,
        'ellipses': ellipses(path, run.covariances, frame),
        'fixes': fixes(drive, verdicts, at_ns, frame),
        'closures': closures(drive, verdicts, run.recorder.refused, frame),
        'states': list(drives.STATES), 'errors': errors,
        'error_table': [asdict(row) | {name: number(getattr(row, name), 5) for name in (
            'median', 'rms', 'p95', 'maximum')} for row in drive.rows],
        'sources': [source_entry(each, frame) for each in analyses.values()],
        'springs': springs(run, analyses, frame),
        'updates': updates, 'sparsity': patterns_of(run.backend.graph),
        'texts': list(frame.texts), 'parameters': _set_parameters(run.values)}


def _set_parameters(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters that are not as by default."""
    usual = checked({name: value for name, value in values.items()
                     if name == 'sources' or name.endswith('.type')})
    return finite({name: value for name, value in values.items()
                   if name == 'sources' or value != usual[name]})


def patterns_of(graph: Graph) -> list[dict[str, Any]]:
    """Return where H and its factor have blocks that are not zero."""
    whole, factor = patterns.hessian(graph), patterns.factor(graph)
    fill = max(factor.nonzeros - (whole.nonzeros + whole.size) // 2, 0)
    return [{'title': title, 'size': each.size, 'nonzeros': each.nonzeros, 'fill': fill,
             'bins': each.bins, 'cells': each.cells.tolist()} for title, each, fill in (
                 ('H, poses in the order of time, then biases', whole, 0),
                 ('R, in the order of elimination', factor, fill))]


def _facts(run: Run) -> list[dict[str, str]]:
    """Return what stands at the head of the page."""
    estimate, drive = run.estimate, run.drive
    duration, travelled = extent(drive.corrected)
    longest = max((each.milliseconds for each in run.recorder.updates), default=None)
    facts = [
        ('duration', duration_text(duration), ''),
        ('distance', length_text(travelled), 'of the path'),
        ('hidden nodes', str(estimate.n_hidden), '' if estimate.n_frozen == 0 else
         f'{estimate.n_frozen} of them have left the window'),
        ('edges', str(estimate.n_edges), 'between poses'),
        ('measurements', str(estimate.n_observed), 'in the map, in the graph'),
        ('chi2', f'{estimate.chi2:.5g}', f'{run.degrees_of_freedom} degrees of freedom'),
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


def write_results(run: Run, folder: Path, facts: Mapping[str, Any]) -> list[str]:
    """Return what people want to know, after writing path, picture, summary.json and run.json."""
    # matplotlib takes half a second to load, and wrong input needs none of it
    from pose_graph_ros.cli.picture import draw_drive  # noqa: PLC0415

    told = write_files(run, folder, facts)
    draw_drive(run.drive, folder / 'drive.png', run.title)
    return _lines_for_people(run, facts, told)


def write_files(run: Run, folder: Path, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the object in run.json, after writing path.tum, summary.json and run.json."""
    drive, estimate, backend, report = run.drive, run.estimate, run.backend, run.report
    folder.mkdir(parents=True, exist_ok=True)
    write_tum(drive.corrected, folder / 'path.tum')
    totals = backend.verdict_totals()
    counts = {'.'.join(key): count for key, count in sorted(run.counts.items())}
    calibrations = {source: each._asdict() for source, each in backend.calibrations().items()}
    # counts of each source, and all closures and all that is not believed
    judged = {'sources': {source: {
        'states': {state.value: each.counts.get(state, 0) for state in texts.ORDER},
        'forgotten': each.n_forgotten} for source, each in totals.items()}, 'constraints': [
            texts.as_json(each) for each in run.verdicts if each.kind is Judged.LOOP_CLOSURE
            or texts.is_notable(each)]}
    text = json.dumps(drives.summary(drive, {
        **facts, **{f'nees_{name}': each for name, each in run.consistency.items()},
        **({'calibrations': calibrations} if len(calibrations) > 0 else {}),
        'alignment': estimate.alignment.value,
        'hidden_nodes': estimate.n_hidden, 'frozen_nodes': estimate.n_frozen,
        'thinned_nodes': estimate.n_thinned, 'edges': estimate.n_edges,
        'observed_nodes': estimate.n_observed, 'biases': estimate.n_biases,
        'chi2': estimate.chi2, 'odometry_errors': estimate.odometry_errors._asdict(),
        'status': report.status.value, 'counts': counts, 'judged': judged}), indent=2)
    (folder / 'summary.json').write_text(text + '\n', encoding='utf-8')
    told = document(run)
    text = json.dumps(told, allow_nan=False, separators=(',', ':'), ensure_ascii=False)
    (folder / FILE).write_text(text + '\n', encoding='utf-8')
    return told


def _lines_for_people(run: Run, facts: Mapping[str, Any], told: Mapping[str, Any]) -> list[str]:
    drive, estimate, report = run.drive, run.estimate, run.report
    counts = {'.'.join(key): count for key, count in sorted(run.counts.items())}
    lines = [f'{estimate.n_hidden} hidden nodes, {estimate.n_edges} edges, {estimate.n_observed} '
             f'observed nodes in {run.seconds:.2f} s; at the end all optimised: '
             f'{report.status.value}, chi2 {report.chi2:.6g}; {estimate.alignment.value}']
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
    lines += [f'{source}: {texts.totals_text(each)}'
              for source, each in run.backend.verdict_totals().items()]
    lines += [f'{each["level"]:8} {each["text"]}' for each in told['findings']]
    if 'new_bag' in facts:
        lines.append('new bag: {original} messages copied, {left_out} left out, {corrected} poses '
                     'of odometry corrected'.format(**facts['new_bag']))
    far = drives.lengths(drive)
    lines += [f'length of {name}: {far[name]:.2f} m in the plane, where that of the path is '
              f'{far["path"]:.2f} m; {steep:.2f} m with its heights'
              for name in ('odometry', 'truth')
              if (steep := far[f'{name}_with_heights']) is not None]
    return [*lines, 'counts: ' + ', '.join(f'{name} {count}' for name, count in counts.items()),
            '', drives.format_table(drive.rows),
            *(f'NEES of the {name}: ' + ('no valid covariance' if each is None else (
                f'{each["mean"]:.4g}, expected {each["expected"]}, {each["interval"][0]:.4f} '
                f'to {each["interval"][1]:.4f} if '
                f'errors were independent; {100.0 * each["within"]:.1f} % below '
                'the 95 % quantile')) for name, each in run.consistency.items()), '']


# --- the map

def lines(drive: Drive, frame: Frame) -> tuple[dict[str, Any], IntArray]:
    """Return the paths, and the stamps of the poses of the corrected one [ns]."""
    def places(path: Trajectory) -> dict[str, Any]:
        some = spread(len(path), MOST_POSES)
        x, y = frame.places(path.poses[some, :2])
        return {'t': frame.seconds(path.stamps_ns[some]), 'x': x, 'y': y}

    path, truth = drive.corrected, drive.truth
    some = spread(len(path), MOST_POSES)
    corrected = {**places(path), 'theta': rounded(path.poses[some, 2])}
    return {'corrected': corrected, 'odometry': places(drive.placed_odometry),
            'truth': None if truth is None else places(truth)}, path.stamps_ns[some]


def ellipses(path: Trajectory, covariances: Covariances, frame: Frame) -> dict[str, Any]:
    """Return some 200 covariances of positions along a path, in map axes; NaN where unknown."""
    known = np.flatnonzero(np.all(np.isfinite(covariances), axis=(1, 2)))
    if len(known) == 0:
        return {name: [] for name in ('t', 'x', 'y', 'xx', 'xy', 'yy')}
    # evenly along the path and in time, so that stops and fast stretches both have some
    steps = np.hypot(*np.diff(path.poses[known, :2], axis=0).T)
    travelled = np.concatenate(([0.0], np.cumsum(steps)))
    times = (path.stamps_ns[known] - path.stamps_ns[known[0]]) * 1e-9
    measure = sum(each / max(each[-1], 1e-9) for each in (travelled, times))
    at = np.unique(np.searchsorted(measure, np.linspace(0.0, measure[-1], 200)))
    some = known[np.clip(at, 0, len(known) - 1)]
    x, y = frame.places(path.poses[some, :2])
    return {'t': frame.seconds(path.stamps_ns[some]), 'x': x, 'y': y,
            **{name: [number(value) for value in covariances[some, row, column].tolist()]
               for name, row, column in (('xx', 0, 0), ('xy', 0, 1), ('yy', 1, 1))}}


def _by_source(sources: Sequence[str], stamps: IntArray) -> Iterator[tuple[str, IntArray]]:
    """Yield sources with the rows of their measurements, by stamp."""
    for source in dict.fromkeys(sources):
        rows = np.flatnonzero(np.asarray(sources) == source)
        yield source, rows[np.argsort(stamps[rows], kind='stable')]


def _judged(keys: Sequence[Key], states: IntArray, verdicts: Mapping[Key, Told],
            reasons: Mapping[Key, str], frame: Frame) -> dict[str, Any]:
    """Return the columns of what is believed, and why not."""
    found, whys = [verdicts.get(key) for key in keys], []
    for key, state, each in zip(keys, states.tolist(), found, strict=True):
        # of fixes nearly all are believed, for the same reason
        silent = state == HELD_OUT or (state == BELIEVED and key[2] is None)
        whys.append(reasons.get(key, REFUSED_SOMEHOW) if state == REFUSED
                    else '' if silent or each is None else each.why)
    return {'state': states.tolist(), 'why': [frame.text(why) for why in whys],
            'id': ['' if each is None else each.id for each in found],
            # when they were judged [sigma]
            'd': rounded([np.nan if each is None else each.distance for each in found], 2)}


def fixes(drive: Drive, verdicts: Mapping[Key, Told], at_ns: IntArray,
           frame: Frame) -> list[dict[str, Any]]:
    """Return the fixes and global poses of each source; `at_ns` are stamps of the path."""
    found = []
    for source, every in _by_source(drive.fix_sources, drive.fix_stamps_ns):
        rows = every[shown(drive.fix_states[every])]
        stamps = drive.fix_stamps_ns[rows]
        x, y = frame.places(drive.fix_positions[rows])
        # the nearest pose of the path, -1 outside of it
        after = np.clip(np.searchsorted(at_ns, stamps), 0, len(at_ns) - 1)
        before = np.maximum(after - 1, 0)
        nearer = np.abs(at_ns[before] - stamps) < np.abs(at_ns[after] - stamps)
        inside = (stamps >= at_ns[0] - 1_000_000) & (stamps <= at_ns[-1] + 1_000_000)
        nearest = np.where(inside, np.where(nearer, before, after), -1)
        found.append({'source': source, 'left_out': len(every) - len(
            rows), 't': frame.seconds(stamps), 'x': x, 'y': y, 'at': nearest.tolist(), **_judged(
                [(source, stamp, None) for stamp in stamps.tolist()], drive.fix_states[rows],
                verdicts, {}, frame)})
    return found


def closures(drive: Drive, verdicts: Mapping[Key, Told], reasons: Mapping[Key, str],
              frame: Frame) -> list[dict[str, Any]]:
    """Return the loop closures of each source, in the order of their later ends."""
    path, found = drive.corrected, []
    for source, every in _by_source(drive.loop_sources, drive.loop_stamps_ns[:, 1]):
        rows = every[shown(drive.loop_states[every])]
        stamps = drive.loop_stamps_ns[rows]
        ends = np.sort(stamps, axis=1)
        places = path.at(np.clip(ends, *path.stamps_ns[[0, -1]]))[:, :, :2]
        (x0, y0), (x1, y1) = frame.places(places[:, 0]), frame.places(places[:, 1])
        found.append({'source': source, 'left_out': len(every) - len(rows),
                      't0': frame.seconds(ends[:, 0]), 't1': frame.seconds(ends[:, 1]),
                      'x0': x0, 'y0': y0, 'x1': x1, 'y1': y1, **_judged(
                          [(source, later, earlier) for earlier, later in stamps.tolist()],
                          drive.loop_states[rows], verdicts, reasons, frame)})
    return found


def _errors(drive: Drive, covariances: Covariances, frame: Frame) -> dict[str, Any] | None:
    """
    Return the errors of the path over time; None without a truth and fixes that are held out.

    Covariances are those of the corrected path, NaN where unknown.
    """
    path, truth, odometry = drive.corrected, drive.truth, drive.placed_odometry
    if truth is not None:
        against, stamps, places = 'truth', truth.stamps_ns, truth.poses
    else:
        order = np.argsort(drive.fix_stamps_ns, kind='stable')
        order = order[drive.fix_states[order] == HELD_OUT]
        against, stamps, places = (
            'held-out fixes', drive.fix_stamps_ns[order], drive.fix_positions[order])
    inside = np.flatnonzero(path.covers(stamps))
    if len(inside) == 0:
        return None
    some = inside[spread(len(inside), 2000)]
    stamps, places = stamps[some], places[some]
    _, far = distances(path, stamps, places[:, :2])
    by_odometry = np.full(len(stamps), np.nan)
    by_odometry[odometry.covers(stamps)] = distances(odometry, stamps, places[:, :2])[1]
    sigma = np.sqrt(covariances[:, 0, 0] + covariances[:, 1, 1])
    at = np.clip(np.searchsorted(path.stamps_ns, stamps), 0, len(path) - 1)
    return {'against': against, 't': frame.seconds(stamps), 'position': rounded(far),
            'heading': None if truth is None else rounded(
                wrap(path.at(stamps)[:, 2] - places[:, 2]), 4),
            'sigma': None if not np.any(np.isfinite(sigma)) else rounded(sigma[at]),
            'odometry': rounded(by_odometry)}


def shown(states: IntArray) -> IntArray:
    """Return which measurements of a source are in run.json: of very many, only some."""
    believed = np.isin(states, (BELIEVED, HELD_OUT))
    others, rest = np.flatnonzero(~believed), np.flatnonzero(believed)
    others = others[spread(len(others), MOST_OF_SOURCE // 2)]
    return np.sort(np.append(others, rest[spread(len(rest), MOST_OF_SOURCE - len(others))]))
