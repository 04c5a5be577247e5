# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A graph from a file at its optimum as run.json: what `pose-graph report graph.g2o` makes a page of.

It has ids of nodes in place of times: node 7 is like a pose at 7 s. The poses as read are in the
place of odometry.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pose_graph_ros.adapters import sources as kinds
from pose_graph_ros.cli import drive as drives, solve
from pose_graph_ros.cli.graph_input import read_file
from pose_graph_ros.cli.run import document, findings, Frame, number, rounded
from pose_graph_ros.cli.run.document import Told
from pose_graph_ros.cli.run.findings import Finding, MANY, MOST_SHOWN
from pose_graph_ros.cli.run.sources import source_entry, SourceAnalysis, verdict
from pose_graph_ros.cli.solved_graph import SolvedGraph
from pose_graph_ros.core.batch.optimizer import optimize, PATIENT, Status
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.judgement.settings import BELIEF
from pose_graph_ros.core.judgement.texts import short
from pose_graph_ros.core.quantities import NANOSECONDS
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.offline import source_residuals

MOST_IDS = 10**9  # from which on nodes are counted instead, as are the symbols of GTSAM
FAR = 5.0  # error that a right loop closure hardly ever has [sigma]
KINDS = {'odometry': kinds.ODOMETRY, 'closures': kinds.LOOP_CLOSURE, 'sightings': kinds.RANGE,
         'observed': kinds.GLOBAL_POSE}
DOUBTED = 'Doubted and not used: all others together agree better without it.'


def solved_document(path: Path, edge2: str | None, robust: str | None) -> dict[str, Any]:
    """Return run.json of a graph, after solving it; raises FileFormatError."""
    problem = solve.Problem(read_file(path, edge2), plain=False)
    if not np.any(problem.graph.is_pose):
        raise FileFormatError(f'{path}: expected poses, got landmarks alone')
    before, chi2 = problem.graph.poses.copy(), problem.graph.energies().chi2
    found = solve.optimised(problem, argparse.Namespace(
        robust=robust, closure_sigma=BELIEF.closure_floors[::2], start='chordal',
        certificate=True, json=False), lambda _: None)
    graph, result = problem.engine, found.solution.result
    solved = problem.solved(before, chi2, result, found.doubted)
    ids, factors = solved.ids, solved.factors
    stamps = NANOSECONDS * (ids if np.all(np.abs(ids) < MOST_IDS) else np.arange(len(ids)))
    # a landmark has no place in the order of poses, and is seen from one
    is_sighting = solved.is_closure & ~solved.is_pose[factors.j]
    times = stamps[np.column_stack((factors.i, np.where(
        is_sighting | (factors.j < 0), factors.i, factors.j)))]
    rows = {name: np.flatnonzero(chosen) for name, chosen in zip(KINDS, (
        solved.is_odometry, solved.is_closure & ~is_sighting, is_sighting, factors.j < 0),
        strict=True) if np.any(chosen)}
    drive = _drive(solved, stamps, times, rows)
    analyses, covariances = dict[str, SourceAnalysis](), np.full((len(drive.corrected), 3, 3),
                                                                 np.nan)
    is_determined = found.solution.determined and result.status is not Status.FAILED and (
        len(factors) > 0)
    if is_determined:
        # H at the optimum; the last step before it was linearised one step away
        optimize(graph, PATIENT)
        smoother = IncrementalSmoother(graph=graph)
        covariances = smoother.covariances()[solved.is_pose]
        analyses = _analyses(smoother, rows, times[:, 1])
    path_of = drive.corrected
    frame = Frame(int(path_of.stamps_ns[0]), np.round(path_of.poses[0, :2], 3) + 0.0)
    columns = (factors.i, factors.j, solved.off, solved.is_doubted)
    told = [Told(f'{ids[i]} -> {ids[j]}' if j >= 0 else f'on {ids[i]}', off,
                 DOUBTED if out else '')
            for i, j, off, out in zip(*(each.tolist() for each in columns), strict=True)]
    known = {('closures', max(ends), min(ends)): told[row] for row in rows.get(
        'closures', ()) for ends in (times[row].tolist(),)}
    lines, at_ns = document.lines(drive, frame)
    return {
        'version': document.VERSION, 'kind': 'graph', 'by_node': True, 'title': path.name,
        'subtitle': f'optimised from the {found.solution.start}', 'start': None,
        'start_ns': str(frame.start_ns), 'duration': lines['corrected']['t'][-1],
        'axes': ['x', 'y'], 'offset': rounded(frame.offset), 'facts': _facts(solved, found, rows),
        'findings': findings.in_order(_findings(
            problem, solved, found, analyses, told, times=1e-9 * (times - frame.start_ns))),
        'lines': lines, 'ellipses': document.ellipses(path_of, covariances, frame),
        'fixes': document.fixes(drive, {}, at_ns, frame),
        'closures': document.closures(drive, known, {}, frame), 'states': list(drives.STATES),
        'errors': None, 'error_table': [],
        'sources': [source_entry(each, frame) for each in analyses.values()],
        'springs': _springs(solved, times, rows, analyses, told, frame), 'updates': None,
        'sparsity': document.patterns_of(graph) if is_determined else [],
        'texts': list(frame.texts)}


def _drive(solved: SolvedGraph, stamps: IntArray, times: IntArray,
           rows: dict[str, IntArray]) -> drives.Drive:
    """Return the poses as those of a drive; landmarks and what was measured of it are fixes."""
    factors, (before, after) = solved.factors, (
        Trajectory(stamps[solved.is_pose], poses[solved.is_pose])
        for poses in (solved.before, solved.after))
    measured, closures = (rows.get(name, np.empty(0, np.int64)) for name in (
        'observed', 'closures'))
    measured = measured[factors.kind[measured] != FactorKind.HEADING]
    sightings = rows.get('sightings', np.empty(0, np.int64))
    landmarks, first = np.unique(factors.j[sightings], return_index=True)
    places = np.concatenate((factors.mean[measured, :2], solved.after[landmarks, :2]))
    return drives.Drive(
        before, after, None, np.append(times[measured, 0], times[sightings[first], 0]),
        places,
        np.zeros(len(places), np.int64), [*['observed'] * len(measured),
                                          *['landmarks'] * len(landmarks)],
        np.sort(times[closures], axis=1),
        np.where(solved.is_doubted[closures], drives.DOUBTED, drives.BELIEVED),
        ['closures'] * len(closures))


def _analyses(smoother: IncrementalSmoother, rows: dict[str, IntArray],
              stamps: IntArray) -> dict[str, SourceAnalysis]:
    """Return what the residuals of each kind of constraints show."""
    # what the fit takes of a range is not known
    is_known = smoother.graph.factors_by_row.kind != FactorKind.RANGE
    groups = {(name, 'map' if name == 'observed' else KINDS[name].name): each[is_known[each]]
              for name, each in rows.items() if np.any(is_known[each])}
    return {name: SourceAnalysis(
        each, fit := source_residuals.fit(each), None, False, KINDS[name], None, (),
        f'their sigmas in the file to {short(fit.ratio)} times what they are')
        for name, each in source_residuals.of_solved(
            smoother.graph, smoother.covariances(),
            lambda edges: smoother.innovations(edges).covariances, groups, stamps).items()}


def _facts(solved: SolvedGraph, found: solve.Optimised,
           rows: dict[str, IntArray]) -> list[dict[str, str]]:
    information = solved.factors.information[~solved.is_doubted]
    freedom = int(np.count_nonzero(np.diagonal(information, axis1=1, axis2=2) > 0.0)) - int(
        np.sum(np.where(solved.is_pose, 3, 2)[~solved.is_fixed]))
    result, landmarks = solved.result, int(np.sum(~solved.is_pose))
    facts = [
        ('hidden nodes', len(solved.ids), f'{landmarks} landmarks' if landmarks > 0 else ''),
        *((name, len(each), f'{len(found.doubted)} doubted and not used' if name == 'closures'
           and found.decision is not None else '') for name, each in rows.items()),
        ('chi2', f'{result.chi2:.5g}', f'{freedom} degrees of freedom'),
        ('chi2 as read', f'{solved.chi2_before:.5g}', ''),
        ('optimisation', result.status.value.replace('_', ' '), f'{result.iterations} iterations'),
        ('certificate', '' if found.certificate is None else found.certificate['verdict'].replace(
            '_', ' '), 'of the minimum'),
        ('time to run', f'{found.seconds:.2f} s', 'without the certificate')]
    return [{'label': label, 'value': str(value), 'note': note} for label, value, note in facts]


def _findings(problem: solve.Problem, solved: SolvedGraph, found: solve.Optimised,
              analyses: dict[str, SourceAnalysis], told: list[Told], *,
              times: FloatArray) -> Iterator[Finding]:
    """Yield what a person must know; `times` are those of the ends of constraints."""
    def ends(rows: IntArray) -> list[tuple[float, float]]:
        return [(time, time) for time in times[rows[:MOST_SHOWN]].ravel().tolist()]

    result, n = solved.result, int(np.sum(solved.is_closure))
    if result.status is not Status.CONVERGED or result.reason:
        yield Finding('warning', f'optimisation: {result.status.value}: {result.reason}', 'map')
    if len(problem.held) > 0:
        names = ', '.join(map(str, solved.ids[problem.held[:5]].tolist()))
        yield Finding('notice', f'nothing holds the parts of the graph that begin at {names}; '
                      'these nodes are fixed', 'map')
    if found.certificate is not None:
        yield Finding('good' if found.certificate['verdict'] == 'certified' else 'notice',
                      '; '.join(line.strip() for line in found.proof), 'map')
    if len(found.doubted) > 0:
        yield Finding('warning' if len(found.doubted) >= MANY else 'notice',
                      f'{len(found.doubted)} of {n} loop closures contradict the others and are '
                      'not used', 'map', ends(found.doubted))
    far = np.flatnonzero(solved.is_closure & ~solved.is_doubted & (solved.off > FAR))
    if len(far) > 0:
        worst = told[far[np.argmax(solved.off[far])]]
        yield Finding(
            'warning', f'{len(far)} of {n} loop closures are more than {FAR:g} sigma off, the '
            f'worst {worst.id}: {short(worst.distance, 3)} sigma'
            + ('; --robust decides which to believe' if found.decision is None else ''), 'springs',
            ends(far[np.argsort(-solved.off[far])]))
    for name, analysis in analyses.items():
        level, text = verdict(analysis)
        if level:
            yield Finding(level, f'{name}: {text}', f'source-{name}')


def _springs(solved: SolvedGraph, times: IntArray, rows: dict[str, IntArray],  # noqa: PLR0917
             analyses: dict[str, SourceAnalysis], told: list[Told],
             frame: Frame) -> list[dict[str, Any]]:
    """Return the constraints with the largest energies."""
    factors, springs = solved.factors, list[dict[str, Any]]()
    energies = np.where(solved.is_doubted, 0.0, solved.off**2)
    expected = np.sum(np.diagonal(factors.information, axis1=1, axis2=2) > 0.0, axis=1) * 1.0
    for each in analyses.values():
        known = np.isfinite(redundancies := each.residuals.redundancies)
        expected[each.residuals.ids[known]] = redundancies[known]

    for row in np.argsort(-energies, kind='stable')[:10].tolist():
        name = next(name for name, every in rows.items() if row in every)
        springs.append({
            'rank': len(springs) + 1, 'source': name, 'name': told[row].id,
            'kind': FactorKind(factors.kind[row]).name.lower().replace('_', ' '),
            'energy': number(energies[row]), 'expected': number(expected[row]),
            'from': frame.place(times[row, 0], solved.after[factors.i[row]]),
            'to': frame.place(times[row, 1], factors.mean[row] if name == 'observed'
                              else solved.after[factors.j[row]]),
            'text': f'{name}: {short(solved.off[row], 3)} sigma off'})
    return springs
