# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
How far estimates taken during a run are from the batch optimum of the graph as it was then.

The excess is half the chi2 above that optimum, found from the estimate itself, each tool under its
own error model. So it tells how well the tool follows the minimum that it is in; whether that is
the best one, the final chi2 tells. The excess hides soft modes, hence the position distance, in
metres and in posterior sigmas.
"""

from dataclasses import dataclass

import numpy as np

from benchmark import ours
from benchmark.runs import Run
from benchmark.worlds import World
from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry.se2 import FloatArray

EXACT = SolverConfig(max_iterations=200, step_tolerance=1e-10)


@dataclass(frozen=True, slots=True)
class Excess:
    """Figures of S samples of a run."""

    steps: FloatArray
    """After which each was taken, shape (S,)."""
    half_chi2: FloatArray
    """Half of chi2 above the optimum, shape (S,)."""
    worst: FloatArray
    """Largest distance of a node to its place in the optimum, shape (S,) [m]."""
    sigmas: FloatArray
    """Largest such distance in posterior sigmas of the position, shape (S,)."""
    final_chi2: float
    """chi2 of the last sample, without a factor 1/2."""
    optimum_chi2: float
    """chi2 of the optimum that the last sample leads to."""

    def figures(self) -> tuple[float, float, float]:
        """Return median, 95 % and maximum of the excess."""
        return (float(np.median(self.half_chi2)), float(np.percentile(self.half_chi2, 95)),
                float(np.max(self.half_chi2)))


def of_run(world: World, run: Run) -> Excess:
    """Judge the samples of a run of either tool."""
    steps = sorted(run.samples)
    rows = []
    for step in steps:
        before, after, best = optimum(world, step, run.samples[step], run.tool)
        off = (run.samples[step] - best)[1:, :2]     # node 0 is fixed
        weighted = np.linalg.solve(
            ours.fresh_covariances(world, step, best)[1:, :2, :2], off[..., None])[..., 0]
        rows.append((before, after, np.max(np.hypot(*off.T)),
                     np.sqrt(np.max(np.sum(off * weighted, axis=1)))))
    table = np.array(rows)
    return Excess(
        np.array(steps, dtype=float), np.maximum(0.5 * (table[:, 0] - table[:, 1]), 0.0),
        table[:, 2], table[:, 3], float(table[-1, 0]), float(table[-1, 1]))


def optimum(
    world: World, step: int, poses: FloatArray, tool: str,
) -> tuple[float, float, FloatArray]:
    """Return chi2 of poses and of the minimum below them, and its poses, as the tool has them."""
    if tool.startswith('GTSAM'):
        # only here: the rest of the benchmark can be imported without GTSAM
        from benchmark import gtsam_peer  # noqa: PLC0415

        factors, start = gtsam_peer.whole_graph(world, step), gtsam_peer.values_of(poses)
        best = gtsam_peer.optimum(factors, start)
        return (2.0 * factors.error(start), 2.0 * factors.error(best), gtsam_peer.poses_of(best))
    graph = world.graph(poses, step)
    before = graph.energies().chi2
    return before, optimizer.optimize(graph, EXACT).chi2, graph.poses
