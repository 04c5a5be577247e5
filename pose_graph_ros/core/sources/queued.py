# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Constraints on their way into the graph."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from pose_graph_ros.core import measurements as ms
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.saved_columns import Pairs, Rows2

NO_NOISE: Final[FloatArray] = np.zeros(2)


class Queued(NamedTuple):
    """
    A constraint for the next update, with what is needed to add, to name and to undo it.

    An end at a state of the bias of its source is -1 until it is added.
    """

    source: str
    factor: Factors  # one row
    stamp_ns: int = -1  # of the measurement [ns]; -1 for an edge of odometry
    reference_ns: int = -1  # stamp of the other end of a loop closure [ns]; else -1
    # what the motion since the node adds to the variances of its position and heading
    noise: FloatArray = NO_NOISE

    @property
    def measured(self) -> type[ms.PoseMeasurement]:
        """What was measured; `LoopClosure` for all edges between poses."""
        kinds = {FactorKind.GLOBAL_POSE: ms.GlobalPose, FactorKind.POSITION: ms.Position,
                 FactorKind.HEADING: ms.HeadingOnly, FactorKind.RANGE: ms.Range}
        return kinds.get(FactorKind(int(self.factor.kind[0])), ms.LoopClosure)

    @property
    def nodes(self) -> list[int]:
        """Ids of the nodes that it is on, without biases."""
        return [int(end[0]) for end in (self.factor.i, self.factor.j) if end[0] >= 0]

    @property
    def is_in_map(self) -> bool:
        """Whether it is a measurement relative to the map."""
        factor = self.factor
        return bool(factor.kind[0] >= FactorKind.GLOBAL_POSE and factor.j[0] < 0 <= factor.i[0])

    @property
    def is_placed(self) -> bool:
        """Whether it is one that contains a position: not if it is a heading."""
        return self.is_in_map and int(self.factor.kind[0]) != FactorKind.HEADING

    @property
    def needs_bias(self) -> bool:
        """Whether one of its ends is a state of the bias, as those of a gyroscope."""
        return len(self.nodes) == 0 or int(self.factor.kind[0]) == FactorKind.TURN


@dataclass(frozen=True, slots=True)
class SavedQueue:
    """The columns of a queue."""

    sources: tuple[str, ...]
    factors: Factors
    stamps_ns: Pairs  # of measurements and of the other ends of loop closures [ns]
    noise: Rows2

    @classmethod
    def of(cls, queue: Sequence[Queued]) -> 'SavedQueue':
        stamps_ns = np.array([(each.stamp_ns, each.reference_ns) for each in queue], np.int64)
        return cls(tuple(each.source for each in queue),
                   Factors.joined([each.factor for each in queue]), stamps_ns.reshape(-1, 2),
                   np.array([each.noise for each in queue]).reshape(-1, 2))

    def queue(self) -> list[Queued]:
        return [Queued(source, self.factors.rows(slice(k, k + 1)), stamp_ns, reference_ns, noise)
                for k, (source, (stamp_ns, reference_ns), noise) in enumerate(zip(
                    self.sources, self.stamps_ns.tolist(), self.noise, strict=True))]
