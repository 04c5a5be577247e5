# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the table and the overview say of a run."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from pose_graph_ros.cli.drive import BELIEVED, DOUBTED, REFUSED, STATES, WAITING, WEAKLY_BELIEVED
from pose_graph_ros.cli.fleet import table
from pose_graph_ros.cli.run import Run
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry.se2 import IntArray

MAP_POINTS = 80  # of the small map
TRUTH, HELD_OUT = 'corrected path to truth', 'corrected path to fixes held out'
"""Names of the errors of a drive that are told."""


def row_of(run: Run, told: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the table says of a run, but for what only its task knows."""
    drive, estimate = run.drive, run.estimate
    levels = [each['level'] for each in told['findings']]
    worst = told['findings'][0] if len(levels) > 0 else {'level': 'good', 'text': ''}
    freedom = run.degrees_of_freedom
    path = drive.corrected.poses[:, :2]
    converged = run.report.status is Status.CONVERGED
    row = {
        'status': table.CONVERGED if converged else table.NOT_CONVERGED,
        'reason': '', 'level': worst['level'], 'finding': worst['text'],
        'warnings': levels.count('warning'), 'notices': levels.count('notice'),
        'start_ns': run.start_ns, 'duration_s': told['duration'],
        'length_m': float(np.sum(np.hypot(*np.diff(path, axis=0).T))),
        'hidden_nodes': estimate.n_hidden, 'edges': estimate.n_edges,
        **_states('fixes', drive.fix_states), **_states('closures', drive.loop_states),
        'fixes_held_out': int(np.sum(drive.fix_kinds['held out'])),
        'chi2': run.report.chi2, 'degrees_of_freedom': freedom,
        'chi2_per_degree': run.report.chi2 / freedom if freedom > 0 else None,
        'run_s': run.seconds}
    for name in ('position', 'pose'):
        nees = run.consistency.get(name)
        row[f'nees_{name}'] = None if nees is None else nees['mean']
    errors = {each.name: each for each in drive.rows}
    for name, of in (('truth', TRUTH), ('held_out', HELD_OUT)):
        for leaf, field in (('rms', 'rms'), ('median', 'median'), ('p95', 'p95'),
                            ('max', 'maximum')):
            row[f'{name}_{leaf}_m'] = getattr(errors[of], field) if of in errors else None
    heading = errors.get('corrected heading to truth')
    row['truth_heading_rms_deg'] = None if heading is None else heading.rms
    return row


def _states(what: str, states: IntArray) -> dict[str, int]:
    counts = np.bincount(states, minlength=len(STATES)).tolist()
    return {what: len(states), f'{what}_believed': counts[BELIEVED] + counts[WEAKLY_BELIEVED],
            f'{what}_doubted': counts[WAITING] + counts[DOUBTED],
            f'{what}_refused': counts[REFUSED]}


def small_map(run: Run) -> list[list[float]]:
    """Return some positions along a path [m]."""
    path = run.drive.corrected.poses[:, :2]
    steps = np.hypot(*np.diff(path, axis=0).T)
    travelled = np.concatenate(([0.0], np.cumsum(steps)))
    some = np.unique(np.searchsorted(travelled, np.linspace(0.0, travelled[-1], MAP_POINTS)))
    points: list[list[float]] = np.round(path[some], 1).tolist()
    return points
