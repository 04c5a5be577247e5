# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a person decides on a constraint by `~/judge`; imports no ROS."""

from functools import partial
import logging

from pose_graph_ros.adapters.conversions import Message
from pose_graph_ros.adapters.verdict_messages import JUDGE, read_decision
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.measurements import Answer, AnswerStatus
from pose_graph_ros.ros.log import ANSWER
from pose_graph_ros.ros.worker import Worker

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
