# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a robot would have known of its pose at each moment of a recording, and not later."""

from collections.abc import Iterator

import numpy as np

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.path_files import csv_lines
from pose_graph_ros.core.measurements import Measurement, OdometrySample
from pose_graph_ros.core.prediction import predict


class LivePoses:
    """
    Poses at the messages of odometry, each by the newest estimate that there was by then.

    As in the node, odometry goes on from the estimate of the last update, and the graph is updated
    as often; but each update is ready at once.

    Parameters
    ----------
    frequency : float, of updates [Hz], by the stamps of odometry

    """

    def __init__(self, frequency: float) -> None:
        self._period_ns = round(1e9 / frequency)
        self._estimate: Estimate | None = None
        self._next_ns = self._newest_ns = 0
        self._stamps: list[int] = []
        self._poses: list[FloatArray] = []
        self._covariances: list[FloatArray] = []

    def is_due(self, sample: OdometrySample | Measurement, n_nodes: int) -> bool:
        """
        Return whether the graph is to be updated with a measurement.

        Parameters
        ----------
        n_nodes : int, hidden nodes

        """
        return (isinstance(sample, OdometrySample) and n_nodes > 0
                and sample.stamp_ns >= self._next_ns)

    def updated(self, backend: PoseGraphBackend) -> None:
        """Take the estimate of an update."""
        self._estimate = backend.estimate(with_path=False)
        if self._estimate is not None:
            self._next_ns = self._estimate.stamp_ns + self._period_ns

    def add(self, sample: OdometrySample | Measurement, source: str) -> None:
        """
        Add the pose at a sample of the primary odometry, unless it is late.

        Parameters
        ----------
        source : str

        """
        estimate = self._estimate
        if not isinstance(sample, OdometrySample) or estimate is None or (
                estimate.primary != source or sample.stamp_ns <= self._newest_ns):
            return
        self._newest_ns = sample.stamp_ns
        found = predict(estimate, sample)
        self._stamps.append(sample.stamp_ns)
        self._poses.append(found.T_map_base)
        self._covariances.append(found.covariance)

    def lines(self) -> Iterator[str]:
        """Yield the lines of a table, as that of the path."""
        return csv_lines(Trajectory(np.array(self._stamps, dtype=np.int64),
                                    np.array(self._poses).reshape(-1, 3)),
                         np.array(self._covariances).reshape(-1, 3, 3))
