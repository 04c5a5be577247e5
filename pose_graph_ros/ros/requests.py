# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What a person asks for: poses that are set, decisions on constraints, files of the graph.

Imports no rclpy.
"""

from collections.abc import Mapping, Sequence
import logging
from pathlib import Path
from typing import Any

import numpy as np

from pose_graph_ros.adapters.conversions import frame, Message, pose_in
from pose_graph_ros.adapters.sources import JUDGE, SET_POSE
from pose_graph_ros.adapters.surroundings import datum_of
from pose_graph_ros.core import measurements
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.exceptions import ConfigError, FileFormatError
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.io.graph_files import (
    datum_refusal,
    graph_paths,
    read_datum,
    read_graph,
    SavedGraph,
)
from pose_graph_ros.core.judgement.verdicts import Decision
from pose_graph_ros.core.measurements import Answer, AnswerStatus, GlobalPose, rejected
from pose_graph_ros.ros.log import ANSWER
from pose_graph_ros.ros.worker import Worker

logger = logging.getLogger(__name__)

# Stamps that stand for the newest odometry (if the message has no stamp), and for the first
# odometry (if the message came before it) [ns].
NEWEST, FIRST = 2**62, 1


class SetPoseInput:
    """Keeps the newest pose that was set until there is odometry that it can be applied to."""

    def __init__(self, frames: Sequence[str]) -> None:
        self._frames = frames  # of map, odometry and robot
        self.waiting: tuple[str, GlobalPose] | None = None     # and the frame that it is in

    def receive(self, message: Message, *, early: bool = False) -> Answer | None:
        """Return why a message cannot be used; None if it can and is kept for `pop`."""
        given = pose_in(message, self._frames)
        if isinstance(given, Answer):
            return given
        if (broken := measurements.value_defect(given.pose)) is not None:
            return rejected(broken, f'pose {given.pose.tolist()}')
        cov, variance = given.covariance, np.diagonal(given.covariance)
        if not (np.all(np.isfinite(cov)) and np.all(variance > 0.0)
                and np.all(variance <= covariance.LARGEST_VARIANCE)):
            cov = np.diag((0.5, 0.5, 0.26)) ** 2    # what RViz sends [m, m, rad]
        stamp = FIRST if early else given.stamp_ns
        self.waiting = frame(message.header.frame_id), GlobalPose(
            stamp if stamp > 0 else NEWEST, given.pose, cov)
        return None

    def pop(self, estimate: Estimate) -> GlobalPose | None:
        """Remove and return the pose, transformed to the map by an estimate; None for none."""
        waiting, self.waiting = self.waiting, None
        if waiting is None:
            return None
        named, given = waiting
        _, odom_frame, base_frame = self._frames
        T_map_frame = {odom_frame: estimate.T_map_odom, base_frame: estimate.T_map_base}.get(named)
        if T_map_frame is None:
            return given
        turn = np.eye(3)
        turn[:2, :2] = se2.rotation(float(T_map_frame[2]))
        return GlobalPose(given.stamp_ns, se2.compose(T_map_frame, given.pose),
                          turn @ given.covariance @ turn.T)


def decide(message: Message, worker: Worker) -> None:
    """Hand a decision to the engine, which answers in the log; an update follows at once."""
    def act(backend: PoseGraphBackend) -> None:
        name, text = str(message.key).strip(), str(message.value).strip().lower()
        choices = [decision.value for decision in Decision]
        answer = backend.decide(name, Decision(text)) if text in choices else rejected(
            'unknown_decision', f'expected one of {", ".join(choices)} as the value for the key '
            f'{name!r}, got {text!r}')
        refused = answer.status is AnswerStatus.REJECTED
        backend.counts[JUDGE, answer.reason if refused else 'accepted'] += 1
        _tell(answer, 'nothing is decided', answer.detail or f'{message.key}: {message.value}')
        worker.request_update()     # here, as jobs are done after one that was asked for before
    worker.call(act, 'a decision')


def set_pose(pose: GlobalPose, map_frame: str, worker: Worker) -> None:
    """Hand a pose to the engine, which answers in the log; an update follows at once."""
    def act(backend: PoseGraphBackend) -> None:
        x, y, yaw = pose.pose
        where = f'to ({x:.3f}, {y:.3f}, {yaw:.3f}) in {map_frame}'
        _tell(backend.set_pose(pose, SET_POSE), f'the pose is not set {where}',
              f'the pose is set {where}')
        worker.request_update()
    worker.call(act, 'a pose that is set')


def _tell(answer: Answer, refused: str, done: str) -> None:
    """Log an answer to a person."""
    if answer.status is AnswerStatus.REJECTED:
        logger.warning('%s: %s: %s', refused, answer.reason, answer.detail, extra=ANSWER)
    else:
        logger.info('%s', done)


# --- the file of the graph

def graph_path(values: Mapping[str, Any]) -> Path:
    """Return the file that graph_file names; raises `ConfigError` if it names none."""
    name = values['graph_file']
    if name == '':
        raise ConfigError('parameter graph_file: expected the name of a file, such as '
                          "~/map.g2o, got ''")
    try:
        return Path(name).expanduser().absolute()
    except RuntimeError as error:
        raise ConfigError(f'parameter graph_file: {name!r}: {error}') from error


def initial_graph(values: Mapping[str, Any]) -> tuple[Path, MapOrigin | None] | None:
    """
    Return file and datum of the graph that a node starts with; None before one was saved.

    Only the checksums and the datum are read, as whoever configures the node waits for it.
    """
    if not values['load_graph_on_start']:
        return None
    path, plane = graph_path(values), datum_of(values).plane
    try:
        if not path.is_dir() and not any(map(Path.exists, graph_paths(path))):
            logger.warning('there is no graph in %s yet: starting with an empty one, which '
                           '~/save_graph writes there', path)
            return None
        datum = read_datum(path)
    except (FileFormatError, OSError) as error:
        raise ConfigError(f'parameter load_graph_on_start: {error}') from error
    if datum is not None and plane is not None:
        refusal = datum_refusal(datum, plane.origin)
        if refusal is not None:
            raise ConfigError(f'parameter load_graph_on_start: {path}: {refusal}')
    return path, datum


def continued(path: Path, config: BackendConfig) -> PoseGraphBackend | None:
    """Return an engine that continues a saved graph; None, which is logged, if that fails."""
    try:
        saved, backend = restored(path, config)
    except Exception:
        logger.exception('%s could not be loaded: a new graph is started', path)
        return None
    logger.info('continuing with %d hidden nodes from %s', len(saved.nodes.ids), path)
    return backend


def restored(path: Path, config: BackendConfig) -> tuple[SavedGraph, PoseGraphBackend]:
    """Return a saved graph and an engine that continues it; raises `FileFormatError`."""
    saved = read_graph(path)
    backend = PoseGraphBackend.restored(config, saved)
    backend.update()
    return saved, backend
