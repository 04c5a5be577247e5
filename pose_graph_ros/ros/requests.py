# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a person asks for by messages: poses that are set, decisions on constraints; no rclpy."""

from functools import partial
import logging

import numpy as np

from pose_graph_ros.adapters.conversions import frame, Message, PLANAR, planar_pose, stamp_ns
from pose_graph_ros.adapters.verdict_messages import JUDGE, read_decision
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.measurements import (
    Answer,
    AnswerStatus,
    GlobalPose,
    rejected,
    value_defect,
)
from pose_graph_ros.ros.log import ANSWER
from pose_graph_ros.ros.worker import Worker

# Used if a message has no valid covariance: what RViz sends [m, m, rad].
DEFAULT_SIGMA = (0.5, 0.5, 0.26)
# Stamps that stand for the newest odometry (if the message has no stamp), and for the first
# odometry (if the message came before it) [ns].
NEWEST, FIRST = 2**62, 1


class SetPoseInput:
    """
    Keeps the newest pose that was set until there is odometry that it can be applied to.

    Parameters
    ----------
    map_frame, odom_frame, base_frame : str, those in which a pose may be given

    """

    def __init__(self, map_frame: str, odom_frame: str, base_frame: str) -> None:
        self._frames = (map_frame, odom_frame, base_frame)
        self._waiting: Message | None = None
        self._early = False

    def receive(self, message: Message, *, early: bool = False) -> Answer | None:
        """
        Return why a message cannot be used; None if it can and is kept for `pop`.

        Parameters
        ----------
        message : geometry_msgs/PoseWithCovarianceStamped
        early : bool, whether there is no odometry yet: the pose then applies to the first odometry

        """
        named = frame(message.header.frame_id)
        if named not in ('', *self._frames):
            return rejected('wrong_frame', f'expected {", ".join(self._frames)}, got {named!r}')
        pose = planar_pose(message.pose.pose)
        if pose is None:
            return rejected('not_finite', 'expected a finite position and a quaternion')
        if (broken := value_defect(pose)) is not None:
            return rejected(broken, f'pose {pose.tolist()}')
        self._waiting, self._early = message, early
        return None

    def pop(self, estimate: Estimate) -> GlobalPose | None:
        """Remove and return the pose, transformed to the map by an estimate; None for none."""
        message, self._waiting = self._waiting, None
        if message is None:
            return None
        pose = planar_pose(message.pose.pose)
        assert pose is not None
        cov = np.asarray(message.pose.covariance, dtype=float).reshape(6, 6)[PLANAR]
        variance = np.diagonal(cov)
        if not (np.all(np.isfinite(cov)) and np.all(variance > 0.0)
                and np.all(variance <= covariance.LARGEST_VARIANCE)):
            cov = np.diag(DEFAULT_SIGMA) ** 2
        _, odom_frame, base_frame = self._frames
        T_map_frame = {odom_frame: estimate.T_map_odom, base_frame: estimate.T_map_base}.get(
            frame(message.header.frame_id))
        if T_map_frame is not None:
            pose = se2.compose(T_map_frame, pose)
            turn = np.eye(3)
            turn[:2, :2] = se2.rotation(float(T_map_frame[2]))
            cov = turn @ cov @ turn.T
        stamp = FIRST if self._early else stamp_ns(message)
        return GlobalPose(stamp if stamp > 0 else NEWEST, pose, cov)

    def forget(self) -> None:
        """Discard the pose."""
        self._waiting = None


logger = logging.getLogger(__name__)


def decide(message: Message, worker: Worker) -> None:
    """
    Hand a decision to the engine, which answers in the log; an update follows at once.

    Parameters
    ----------
    message : diagnostic_msgs/KeyValue, the id of a constraint, and `in`, `out` or `auto`

    """
    worker.call(partial(_hand_over, message, worker), 'a decision')


def _hand_over(message: Message, worker: Worker, backend: PoseGraphBackend) -> None:
    """Decide in the engine, count and log its answer; for the worker's thread."""
    read = read_decision(message)
    answer = read if isinstance(read, Answer) else backend.decide(*read)
    if answer.status is AnswerStatus.REJECTED:
        backend.counts[JUDGE, answer.reason] += 1
        logger.warning(
            'nothing is decided: %s: %s', answer.reason, answer.detail, extra=ANSWER)
    else:
        backend.counts[JUDGE, 'accepted'] += 1
        logger.info('%s', answer.detail or f'{message.key}: {message.value}')
    # asked for here, as jobs are done after an update that was asked for before
    worker.request_update()
