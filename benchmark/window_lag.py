# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Online runs of one tool over one world while only the last nodes are kept: time, and estimates.

A step's time is all that a caller from Python pays for the newest pose: adding what arrives,
letting the oldest node go, and reading the newest pose. Of GTSAM the building of factors is not
counted, in its favour.
"""

from dataclasses import dataclass, field
import time

import numpy as np

from benchmark import ours
from benchmark.runs import Plan, quiet
from benchmark.worlds import chain, laps, World
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

FIRST_SIGMA = 1e-5
"""Of the pose of node 0, as GTSAM has it; a fixed node could not go [m, rad]."""
NEVER = 10**9


@dataclass(slots=True)
class LagRun:
    """What one tool did in one run."""

    tool: str
    seconds: FloatArray
    """Time of each step, shape (steps,) [s]; fewer than the world has nodes if it ended early."""
    newest: FloatArray
    """Newest pose after each step, shape (steps, 3)."""
    samples: dict[int, tuple[IntArray, FloatArray]] = field(default_factory=dict)
    """Nodes of the window, shape (W,), and their poses, shape (W, 3), after steps of the plan."""
    note: str = ''
    """What a reader of the figures must know."""

    def cut(self, steps: int) -> None:
        """Keep the first steps only."""
        self.seconds, self.newest = self.seconds[:steps], self.newest[:steps]


def warm_up() -> None:
    """Let nodes go in small worlds, so that nothing is compiled while times are taken."""
    for world in (chain(100), laps(120, 60)):
        for every in (1, 20):
            Ours(70, every)(world, Plan())


@dataclass(frozen=True, slots=True)
class Ours:
    """Our smoother, from which nodes go that are older than the lag."""

    lag: int
    """[nodes]; `NEVER` for the whole graph."""
    every: int = 20
    """Nodes that are let go at a time."""

    @property
    def name(self) -> str:
        """As the tables have it."""
        if self.lag == NEVER:
            return f'{ours.NAME}, unlimited'
        return f'{ours.NAME}, one at a time' if self.every == 1 else ours.NAME

    def __call__(self, world: World, plan: Plan) -> LagRun:
        """Run the smoother over a world; RuntimeError if a step fails."""
        smoother = IncrementalSmoother()
        steps = ours.Steps(world, FIRST_SIGMA)
        n, lag, every = world.n_nodes, self.lag, self.every
        run = LagRun(self.name, np.zeros(n), np.zeros((n, 3)))
        kept, total = 0, 0.0
        with quiet():
            for k in range(n):
                step = steps.extending if steps.plain[k] else steps.updating
                begin = time.perf_counter()
                result = step(smoother, k)
                if k - lag - kept >= every:
                    smoother.forget(range(kept, kept + every))
                    kept += every
                run.newest[k] = smoother.poses[-1]
                run.seconds[k] = time.perf_counter() - begin
                total += run.seconds[k]
                if result.status is Status.FAILED:
                    raise RuntimeError(f'{world.name}, step {k}: {result.reason}')
                if k in plan.samples:
                    run.samples[k] = np.arange(kept, k + 1), smoother.poses.copy()
                if total > plan.limit:
                    run.cut(k + 1)
                    run.note = f'first {k + 1} steps, {plan.limit:.0f} s'
                    break
        return run
