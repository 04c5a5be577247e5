# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of the table of a fleet, made up."""

from typing import Any

import numpy as np

UNKNOWN = (
    'duration_s', 'length_m', 'hidden_nodes', 'edges', 'fixes', 'fixes_believed', 'fixes_doubted',
    'fixes_refused', 'fixes_held_out', 'closures', 'closures_believed', 'closures_doubted',
    'closures_refused', 'chi2', 'degrees_of_freedom', 'chi2_per_degree', 'nees_position',
    'nees_pose', 'truth_rms_m', 'truth_median_m', 'truth_p95_m', 'truth_max_m',
    'truth_heading_rms_deg', 'held_out_rms_m', 'held_out_median_m', 'held_out_p95_m',
    'held_out_max_m', 'run_s', 'peak_memory_mb')
FINDINGS = {
    'warning': 'gps: errors are 2.1 times what their covariances claim; set gps.sigma_scale to '
               '2.1',
    'notice': '4 loop closures are not used', 'good': 'nothing was found that needs a person'}


def failed(name: str, reason: str, **changes: Any) -> dict[str, Any]:
    """Return the row of a drive that failed."""
    return {
        'name': name, 'bag': f'/bags/{name}', 'folder': '', 'status': 'failed', 'reason': reason,
        'level': '', 'finding': '', 'warnings': None, 'notices': None, 'start_ns': None,
        **dict.fromkeys(UNKNOWN), 'total_s': 0.4, 'key': 'a' * 16, 'version': '0.1.0',
        'is_new': True, 'map': None, 'parameters': '', **changes}


def drive(name: str, warnings: int = 0, notices: int = 0, **changes: Any) -> dict[str, Any]:
    """Return the row of a drive that came out."""
    level = 'warning' if warnings > 0 else 'notice' if notices > 0 else 'good'
    return failed(name, '', **{
        'folder': f'drives/{name}', 'status': 'converged', 'level': level,
        'finding': FINDINGS[level], 'warnings': warnings, 'notices': notices,
        'start_ns': 1_424_945_472_123_000_000, 'duration_s': 754.2, 'length_m': 1203.4,
        'fixes_believed': 1201, 'fixes_doubted': 12, 'closures_believed': 30,
        'closures_doubted': 2, 'chi2_per_degree': 1.04, 'total_s': 21.5, 'peak_memory_mb': 291.3,
        'map': [[0.0, 0.0], [40.0, 0.0], [40.0, 10.0]]} | changes)


def fleet(count: int) -> list[dict[str, Any]]:
    """Return rows of many drives, with maps of 80 points each."""
    rng = np.random.default_rng(21)
    rows = []
    for k in range(count):
        turns = np.cumsum(rng.normal(0.0, 0.35, 80))
        path = 9.0 * np.cumsum(np.stack((np.cos(turns), np.sin(turns)), axis=1), axis=0)
        warnings, notices = (int(each) for each in rng.poisson(0.4, 2))
        rows.append(failed(f'drive_{k}', 'no odometry: give its topic by --odom') if k % 25 == 7
                    else drive(f'drive_{k}', warnings, notices, duration_s=60.0 + k % 3000,
                               truth_rms_m=float(rng.lognormal(-1.0, 0.6)),
                               truth_p95_m=float(rng.lognormal(-0.4, 0.6)),
                               map=np.round(path, 2).tolist()))
    return rows
