# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Our engine on the same worlds, the one module that knows its interface.

A step's time is all that a caller from Python pays: building the tables and the update, the call,
and with its return an estimate of all nodes that is up to date (`poses` is a view). A step that
brings no more than the edge from the node before goes through `extend`; what else a step brings
goes through `update`, as in the back end.

Estimates taken during a run, of any tool, are compared with the batch optimum of the graph as it
was then. The excess is half the chi2 above that optimum, found from the estimate itself, each tool
under its own error model. So it tells how well the tool follows the minimum that it is in; whether
that is the best one, the final chi2 tells. The excess hides soft modes, hence the position
distance, in metres and in posterior sigmas.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math
import time
from typing import Any

import numpy as np

from benchmark import runs
from benchmark.runs import Plan, Run, Tool
from benchmark.worlds import chain, laps, World
from pose_graph_ros.core.batch import linear_starts, optimizer
from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother, UpdateResult
from pose_graph_ros.core.warm_up import warm_up as load_kernels

NAME, REFINED = 'ours', 'ours, refined'
FIRST_SIGMA = 1e-5
"""Of the pose of node 0, as GTSAM has it, where nodes go [m, rad]."""
NEVER = 10**9
"""A lag with which none goes."""
BATCH = SolverConfig(max_iterations=100, step_tolerance=1e-5)
SINGLE = SolverConfig(max_iterations=1)
EXACT = SolverConfig(max_iterations=200, step_tolerance=1e-10)
AfterStep = Callable[[IncrementalSmoother, int], None]


def run(
    world: World, plan: Plan, after_step: AfterStep | None = None, engine: 'Ours | None' = None,
) -> Run:
    """
    Run the smoother over a world; RuntimeError if a step fails.

    Parameters
    ----------
    world : World
    plan : Plan
    after_step : callable, optional
        Called with the smoother and the step, outside of what is timed.
    engine : Ours, optional, if it is not that of the whole graph

    """
    engine = engine or Ours(world)
    smoother = engine.smoother
    return runs.run(engine.name, engine, world, plan, None if after_step is None else (
        lambda k: after_step(smoother, k)))


def run_refined(world: World, plan: Plan) -> Run:
    """Run the smoother over a world, and refine each sample, as the node does between updates."""
    seconds: list[float] = []

    def refine(smoother: IncrementalSmoother, k: int) -> None:
        finished = k not in plan.samples
        while not finished:
            begin = time.perf_counter()
            finished = smoother.refine().finished
            seconds.append(time.perf_counter() - begin)

    done = run(world, plan, refine)
    done.tool, done.refinement = REFINED, seconds
    done.samples = {k: poses for k, poses in done.samples.items() if k in plan.samples}
    return done


def kept(lag: int, every: int = 20) -> tuple[str, Tool]:
    """Return name and tool of a smoother from which nodes go, so many at a time."""
    name = (f'{NAME}, unlimited' if lag == NEVER else
            f'{NAME}, one at a time' if every == 1 else NAME)
    return name, lambda world, plan: run(world, plan, None, Ours(world, name, lag, every))


def fresh_covariances(world: World, step: int, poses: FloatArray) -> FloatArray:
    """Return the covariances of all nodes after a step, all linearized at poses, (N, 3, 3)."""
    edges, observed = world.part(step)
    smoother = IncrementalSmoother()
    smoother.update(GraphUpdate(hidden=poses, factors=Factors.joined([edges, observed]), fix=(0,)))
    return smoother.covariances()


def warm_up() -> None:
    """Run everything on small worlds, so that nothing is compiled while times are taken."""
    load_kernels()  # also those of the batch fallback, which no small world needs
    for world in (chain(100), chain(100, 'late'), laps(120, 60)):
        run_refined(world, Plan(frozenset({world.n_nodes - 1})))
        for every in (1, 20):
            kept(70, every)[1](world, Plan())
        smoother = smoothed(world)
        smoother.newest_covariance()
        smoother.covariances()
        smoother.joint_covariance(1, 2)
        graph = world.graph(world.dead_reckoning())
        solve_from_nothing(graph)
        solve(graph)


def smoothed(world: World) -> IncrementalSmoother:
    """Return the smoother after all of a world."""
    engine = Ours(world)
    run(world, Plan(), None, engine)
    return engine.smoother


class Ours:
    """
    Our smoother, and what arrives in each step, as a caller has it: lists of arrays.

    With a lag [nodes] older nodes go, `every` so many at a time, and node 0 is not fixed, as it
    could not go.
    """

    def __init__(self, world: World, name: str = NAME, lag: int = 0, every: int = 20) -> None:
        edges = world.edges
        self.world, self.name, self.lag, self.every = world, name, lag, every
        self.smoother, self.kept = IncrementalSmoother(), 0
        self.edge_stops = [0, *world.edge_stops.tolist()]
        self.observed_stops = [0, *world.observed_stops.tolist()]
        self.i, self.j = edges.i.tolist(), edges.j.tolist()
        self.mean, self.information = list(edges.mean), list(edges.information)
        self.ahead, self.plain = [], []
        for k in range(world.n_nodes):
            edge, edge_stop = self.edge_stops[k:k + 2]
            seen, seen_stop = self.observed_stops[k:k + 2]
            ahead = k > 0 and (self.i[edge], self.j[edge]) == (k - 1, k)
            self.ahead.append(ahead)
            self.plain.append(ahead and edge_stop == edge + 1 and seen_stop == seen)

    def next(self, k: int) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Return what is called in a step."""
        step = self.extending if self.plain[k] else self.updating
        return (self.lagging, (step, k)) if self.lag else (step, (self.smoother, k))

    def check(self, k: int, result: Any) -> FloatArray | None:
        """Raise if a step has failed, saying which and why; return the newest pose with a lag."""
        result, newest = result if self.lag else (result, None)
        if result.status is optimizer.Status.FAILED:
            raise RuntimeError(f'{self.world.name}, step {k}: {result.reason}')
        return newest

    def poses(self) -> FloatArray:
        """Return the estimate."""
        return self.smoother.poses.copy()

    def lagging(self, step: Any, k: int) -> tuple[UpdateResult, FloatArray]:
        """Do a step, let old nodes go, and read the newest pose."""
        result = step(self.smoother, k)
        if k - self.lag - self.kept >= self.every:
            self.smoother.forget(range(self.kept, self.kept + self.every))
            self.kept += self.every
        return result, self.smoother.poses[-1].copy()

    def _first(self) -> GraphUpdate:
        first = self.world.first[None]
        if self.lag == 0:
            return GraphUpdate(hidden=first, fix=(0,))
        return GraphUpdate(hidden=first, factors=Factors.on(
            [0], None, first, np.eye(3)[None] / FIRST_SIGMA**2, [FactorKind.GLOBAL_POSE]))

    def extending(self, smoother: IncrementalSmoother, k: int) -> UpdateResult:
        """Do a step that only adds a node to the end."""
        edge = self.edge_stops[k]
        return smoother.extend(self.mean[edge], self.information[edge])

    def updating(self, smoother: IncrementalSmoother, k: int) -> UpdateResult:
        """Do any other step; a node that goes on from the last one is added along the chain."""
        if k == 0:
            return smoother.update(self._first())
        changes: dict[str, Any] = {}
        new: list[Factors] = []
        begin, end = self.edge_stops[k:k + 2]
        if self.ahead[k]:
            smoother.extend(self.mean[begin], self.information[begin])
            begin += 1
        else:
            changes['hidden'] = np.array([self._guess(smoother, begin)])
        if end > begin:
            rows, table = slice(begin, end), self.world.edges
            new.append(table.rows(rows))
        begin, end = self.observed_stops[k:k + 2]
        if end > begin:
            new.append(self.world.observed.rows(slice(begin, end)))
        return smoother.update(GraphUpdate(**changes, factors=Factors.joined(new)))

    def _guess(self, smoother: IncrementalSmoother, edge: int) -> tuple[float, float, float]:
        """Compose the estimate of the node that the new one hangs on with their edge."""
        i, j, mean = self.i[edge], self.j[edge], self.mean[edge]
        if i > j:
            i, mean = j, se2.inverse(mean)
        x, y, theta = smoother.poses[i].tolist()
        dx, dy, dtheta = mean.tolist()
        c, s = math.cos(theta), math.sin(theta)
        return x + c * dx - s * dy, y + s * dx + c * dy, theta + dtheta


def solve_from_nothing(graph: Graph) -> float:
    """Optimise a graph without a guess and return chi2."""
    return float(optimizer.optimize_from_linear_start(graph, BATCH).chi2)


def solve(graph: Graph) -> float:
    """Optimise a graph from its poses and return chi2."""
    return float(optimizer.optimize(graph, BATCH).chi2)


def iterate(graph: Graph) -> None:
    """Linearize, factorise and solve once: what a factorisation costs with all around it."""
    optimizer.optimize(graph, SINGLE)


def polished(world: World, poses: FloatArray) -> float:
    """Return chi2 of the minimum downhill of poses, shape (N, 3)."""
    poses = poses.copy()
    poses[0] = world.first      # fixed; GTSAM's prior gives way a little
    graph = world.graph(poses)
    config = SolverConfig(max_iterations=300, step_tolerance=1e-9)
    return float(optimizer.optimize(graph, config).chi2)


def start_of_batch(world: World) -> FloatArray:
    """Return the start that both tools are given in the batch comparison, shape (N, 3)."""
    return linear_starts.chordal(world.graph(world.dead_reckoning()))


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


def excess(world: World, run: Run) -> Excess:
    """Judge the samples of a run of either tool."""
    steps = sorted(run.samples)
    rows = []
    for step in steps:
        before, after, best = optimum(world, step, run.samples[step], run.tool)
        off = (run.samples[step] - best)[1:, :2]     # node 0 is fixed
        weighted = np.linalg.solve(
            fresh_covariances(world, step, best)[1:, :2, :2], off[..., None])[..., 0]
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
