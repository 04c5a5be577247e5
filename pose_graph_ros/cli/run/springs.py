# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The constraints under most tension in run.json: by name, with their ends and residuals."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pose_graph_ros.cli.run.lines import number, rounded
from pose_graph_ros.cli.run.places import Frame
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.judgement.texts import short
from pose_graph_ros.core.judgement.verdicts import Verdict
from pose_graph_ros.core.residuals.source_residuals import SourceResiduals
from pose_graph_ros.core.sources.constraint_names import ConstraintEnergy

MOST = 10


def springs(
    backend: PoseGraphBackend, path: Trajectory, residuals: Mapping[str, SourceResiduals],
    verdicts: Sequence[Verdict], frame: Frame,
) -> list[dict[str, Any]]:
    """
    Return the constraints with the largest weighted energies, in descending order.

    Parameters
    ----------
    path : Trajectory, of the hidden nodes
    residuals : mapping, by source
    verdicts : sequence of Verdict

    """
    names = {(each.edge, each.number): each.id for each in verdicts}
    stamps = backend.node_stamps_ns
    found = []
    for rank, each in enumerate(backend.largest_energies(MOST), 1):
        place = residual = sigma = expected = None
        source = residuals.get(each.source)
        at = [] if source is None else np.flatnonzero(
            (source.ids == each.number) & (source.is_edge == each.edge)).tolist()
        if source is not None and len(at) == 1:
            one = source.rows(np.array(at))
            residual, sigma = one.errors[0], one.sigmas[0] * one.measured[0]
            left = float(one.redundancies[0])
            expected = left if np.isfinite(left) else None
        ends: list[dict[str, Any]] = []
        for node in each.nodes:
            if node < len(path):
                x, y = frame.places(path.poses[node, :2])
                ends.append({'node': node, 't': frame.seconds(stamps[[node]])[0],
                             'x': x[0], 'y': y[0]})
        if len(ends) == 0 and each.stamp_ns >= 0 and path.covers(each.stamp_ns):
            # a bias is shown where the robot was
            x, y = frame.places(path.at(each.stamp_ns)[:2])
            ends = [{'node': None, 't': frame.seconds(np.array([each.stamp_ns]))[0],
                     'x': x[0], 'y': y[0]}]
        elif len(ends) == 1 and residual is not None and each.kind != 'heading':
            # from where the estimate has it to where it was measured
            x, y = frame.places(path.poses[each.nodes[0], :2] + residual[:2])
            place = {'node': None, 't': ends[0]['t'], 'x': x[0], 'y': y[0]}
        found.append({
            'rank': rank, 'name': names.get((each.edge, each.number), _name(
                each, frame.start_ns)),
            'source': each.source, 'kind': each.kind.replace('_', ' '),
            'energy': number(each.energy), 'expected': number(
                float(each.freedom) if expected is None else expected),
            'from': ends[0] if len(ends) > 0 else None,
            'to': ends[1] if len(ends) > 1 else place,
            'residual': None if residual is None else rounded(residual, 4),
            'sigma': None if sigma is None else rounded(sigma, 4),
            'text': _text(each, ends, residual)})
    return found


def _name(each: ConstraintEnergy, start_ns: int) -> str:
    """Return the name of a constraint, with the time since the start of the drive [ns]."""
    if each.stamp_ns < 0:
        return each.name
    what, _, rest = each.name.partition(' at ')
    return f'{what} at {(each.stamp_ns - start_ns) * 1e-9:.1f} s{rest.partition(" s")[2]}'


def _text(
    each: ConstraintEnergy, ends: Sequence[Mapping[str, Any]], residual: FloatArray | None,
) -> str:
    """
    Return what a constraint is and how far it is off.

    Parameters
    ----------
    residual : ndarray, shape (3,), or None if unknown

    """
    times = ' to '.join(f'{end["t"]:.1f}' for end in sorted(ends, key=lambda end: end['t']))
    at = f' at {times} s' if len(ends) > 0 else ''
    if each.kind == 'bias':
        return f'error of {each.source}{at}: it changes faster than its correlation time says'
    off = '' if residual is None else (
        f': {short(np.hypot(*residual[:2]))} m' + ('' if residual[2] == 0.0 else
                                                f' and {short(abs(residual[2]))} rad') + ' off')
    name = each.name.partition(' at ')[0] if len(ends) > 0 else each.name
    return f'{name}{at}{off}'
