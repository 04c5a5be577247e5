# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the calls of the incremental smoother return."""

from typing import NamedTuple

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray


class UpdateResult(NamedTuple):
    """Status and statistics of an update."""

    status: Status
    """
    CONVERGED; MAX_ITERATIONS if linearization errors above the budget remain for the next update;
    FAILED if the update was rolled back.
    """
    reason: str
    """Cause of a failure in one sentence, else empty."""
    relinearized: int
    """Constraints and turned clique frames that were linearized again."""
    eliminated: int
    """Nodes whose cliques were eliminated again, summed over the iterations."""
    visited: int
    """Cliques that were solved for, summed over the iterations."""
    iterations: int
    """Back-substitutions of the update."""


class Refinement(NamedTuple):
    """What a call of `IncrementalSmoother.refine` has done."""

    finished: bool
    """Whether there is nothing more to do before the next update."""
    moved: float
    """Largest change of a coordinate of a position [m]."""


class Forgotten(NamedTuple):
    """What `IncrementalSmoother.forget` has taken out of the graph."""

    nodes: IntArray
    """Ids of the hidden nodes, ascending, shape (N,)."""
    poses: FloatArray
    """Their last estimates, shape (N, 3) [m, m, rad]."""
    edges: IntArray
    """Ids of all edges that ended at them."""
    observed: IntArray
    """Ids of all observed nodes on them."""


DIVERGED = 'the iterations diverge'
"""Reason of an update that has failed because it must not fall back to the batch optimiser."""
