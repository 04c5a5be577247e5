# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Print figures of evo as JSON: a process of its own, as evo writes settings into a home folder.

The argument is a JSON list of cases: files, alignment, delta, unit, flags.
"""

from copy import deepcopy
import json
import sys
from typing import Any

from evo.core import metrics, sync
from evo.core.sync_method import SyncMethod
from evo.core.units import Unit
from evo.main_ape import ape
from evo.main_rpe import rpe
from evo.tools import file_interface

UNITS = {'frames': Unit.frames, 'metres': Unit.meters, 'rad': Unit.radians}
READ = {'tum': file_interface.read_tum_trajectory_file,
        'kitti': file_interface.read_kitti_poses_file}


def figures(case: dict[str, Any]) -> dict[str, Any]:
    """Return the statistics of one case by the names of `pose-graph compare --json`."""
    paths = [READ[case['format']](case[name]) for name in ('reference', 'estimate')]
    if case['format'] == 'tum':
        paths = sync.associate_trajectories(
            *paths, max_diff=case['max_difference'], offset_2=case['offset'],
            sync_method=SyncMethod.interpolation if case['interpolate']
            else SyncMethod.nearest_time)
    moved = {'align': case['align'] != 'none', 'correct_scale': case['align'] == 'sim2'}
    found = {}
    for suffix, relation in (('', metrics.PoseRelation.translation_part),
                             ('_heading', metrics.PoseRelation.rotation_angle_deg)):
        # both change what they are given
        found[f'ate{suffix}'] = ape(*deepcopy(paths), relation, **moved).stats
        found[f'rpe{suffix}'] = rpe(
            *deepcopy(paths), relation, delta=case['delta'], delta_unit=UNITS[case['unit']],
            all_pairs=case['all_pairs'], pairs_from_reference=case['pairs_from_reference'],
            **moved).stats
    return found


print(json.dumps([figures(case) for case in json.loads(sys.argv[1])]))
