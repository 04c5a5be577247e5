# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
An engine from what a journal holds: its state at a checkpoint, and then all that came, once more.

Measurements come in the same order, with updates between them as there were. The path that was
published last is taken as it was, as solving again does not give the same bits.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
import logging

import numpy as np

from pose_graph_ros.core import measurements as ms
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.io.graph_files import SavedGraph
from pose_graph_ros.core.io.journal_file import Entry, Found, KnownPath, measurement_of, Place
from pose_graph_ros.core.judgement.verdicts import Decision
from pose_graph_ros.core.saved_columns import MISMATCHES

logger = logging.getLogger(__name__)

Over = Callable[[PoseGraphBackend, str], AbstractContextManager[None]]


def recovered(config: BackendConfig, found: Found, place: Place,
              over: Over = lambda *_: nullcontext()) -> PoseGraphBackend:
    """
    Return an engine that continues where the journal ends.

    `place` returns the position in the map of a latitude, longitude and altitude; what takes long
    is done within `over`, which may interrupt the engine. What cannot be done again is logged and
    left out. Raises FileFormatError where the state does not fit.
    """
    if found.state is None:
        backend = PoseGraphBackend(config)
    else:
        backend = PoseGraphBackend.restored(config, found.state.saved)
        try:
            backend.take_pending((source, measurement_of(values, place))
                                 for source, values in found.state.pending)
        except MISMATCHES as error:
            raise FileFormatError(f'what waited cannot be read: {error!r}') from error
    n_failed = 0
    for entry in found.entries:
        try:
            if entry.name == 'resume' and entry.act > 0:
                backend = _again(backend, config, KnownPath())
            else:
                _do(backend, entry, place, over)
        except Exception:
            n_failed += 1
            if n_failed == 1:
                logger.exception('from the journal, %s cannot be done again', entry[:3])
    # the map can be elsewhere than where a path from before its alignment is
    fits = found.path.is_aligned == backend.parts.alignment.is_aligned
    return _again(backend, config, found.path if fits else KnownPath())


def _do(backend: PoseGraphBackend, entry: Entry, place: Place, over: Over) -> None:
    if entry.act == 0:
        measurement = measurement_of(entry.values, place)
        if isinstance(measurement, ms.OdometrySample):
            backend.add_odometry(measurement, entry.name)
        else:
            backend.add_measurement(measurement, entry.name)
    elif entry.name == 'decide':
        name, decision = entry.values
        backend.decide(name, Decision(decision))
    elif entry.name == 'set_pose':
        pose, source = entry.values
        backend.set_pose(measurement_of(pose, place), source)
    else:
        with over(backend, 'what was done before'):
            if entry.name == 'optimize':
                backend.optimize()
            else:
                backend.update()


def _again(backend: PoseGraphBackend, config: BackendConfig, path: KnownPath) -> PoseGraphBackend:
    """Return an engine like one, with another path, whose odometry may have another origin."""
    if len(backend.node_stamps_ns) == 0:
        return backend
    again = PoseGraphBackend.restored(config, _on(backend.saved(texts=False), path))
    again.take_pending(backend.pending)
    again.counts.update(backend.counts)
    return again


def _on(saved: SavedGraph, path: KnownPath) -> SavedGraph:
    """Return a graph whose nodes lie on a path, as far as it has them."""
    nodes, rows = saved.nodes, saved.rows
    n = min(len(path.stamps_ns), len(nodes.stamps_ns))
    known = np.flatnonzero(path.stamps_ns[:n] == nodes.stamps_ns[:n])
    frozen, poses = nodes.frozen.copy(), rows.poses.copy()
    left, present = known[known < len(frozen)], known[known >= len(frozen)]
    frozen[left] = path.poses[left]
    at = np.searchsorted(rows.node_ids, nodes.ids[present])
    found = at < len(rows.node_ids)
    found[found] = rows.node_ids[at[found]] == nodes.ids[present][found]
    poses[at[found]] = path.poses[present][found]
    return replace(saved, nodes=nodes._replace(frozen=frozen), rows=rows._replace(poses=poses))
