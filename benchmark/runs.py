# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Online runs of one tool over one world: the time of each step, and estimates taken along the way.

Tools are run by a function `run(world, plan) -> Run`, interleaved and several times over. Times
are wall time of one thread. Taking an estimate is not part of a step's time.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import gc
import time
from typing import Any, Protocol

import numpy as np

from benchmark.worlds import World
from pose_graph_ros.core.geometry.se2 import FloatArray

MICROSECOND = 1e-6


@dataclass(frozen=True, slots=True)
class Plan:
    """What one run does beyond the steps."""

    samples: frozenset[int] = frozenset()
    """Steps after which the estimate is kept."""
    limit: float = np.inf
    """The run ends early once its steps have taken this long [s]."""


@dataclass(slots=True)
class Run:
    """What one tool did in one run."""

    tool: str
    seconds: FloatArray
    """Time of each step, shape (steps,) [s]; fewer than the world has nodes if it ended early."""
    newest: FloatArray
    """Newest pose after each step, shape (steps, 3), of tools that read it."""
    samples: dict[int, FloatArray] = field(default_factory=dict)
    """Estimates of the last nodes, shape (W, 3), after steps of the plan and after the last."""
    refinement: list[float] = field(default_factory=list)
    """Time of each iteration of the refinements at the samples [s]."""
    note: str = ''
    """What a reader of the figures must know."""

    @property
    def steps(self) -> int:
        """Number of steps that were done."""
        return len(self.seconds)


class Engine(Protocol):
    """A tool on a world, step by step."""

    def next(self, k: int) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Return what is called in a step, and with what: the call is what is timed."""

    def check(self, k: int, result: Any) -> FloatArray | None:
        """Raise if a step has failed; return the newest pose if the step has read it."""

    def poses(self) -> FloatArray:
        """Return the estimate of all nodes that are kept, shape (W, 3)."""


Tool = Callable[[World, Plan], Run]


def run(
    tool: str, engine: Engine, world: World, plan: Plan,
    after_step: Callable[[int], None] | None = None,
) -> Run:
    """
    Run a tool over a world.

    Parameters
    ----------
    tool : str, its name
    engine : Engine
    world : World
    plan : Plan
    after_step : callable, optional
        Called with the step, outside of what is timed.

    """
    n, total = world.n_nodes, 0.0
    done = Run(tool, np.zeros(n), np.zeros((n, 3)))
    seconds = done.seconds
    with quiet():
        for k in range(n):
            step, arguments = engine.next(k)
            begin = time.perf_counter()
            result = step(*arguments)
            seconds[k] = time.perf_counter() - begin
            total += seconds[k]
            newest = engine.check(k, result)
            if newest is not None:
                done.newest[k] = newest
            if after_step is not None:
                after_step(k)
            if k in plan.samples or total > plan.limit:
                done.samples[k] = engine.poses()
            if total > plan.limit:
                done.seconds, done.newest = seconds[:k + 1], done.newest[:k + 1]
                done.note = f'first {k + 1} steps, {plan.limit:.0f} s'
                break
    return done


def timing(runs: list[Run], stop: int | None = None, begin: int = 1) -> FloatArray:
    """
    Return figures of the time of a step, over the same steps of several runs, medians over runs.

    These are mean, p50, p99 and maximum [us], and the total [s].
    """
    rows = []
    for each in runs:
        us = each.seconds[begin:stop] / MICROSECOND
        rows.append((np.mean(us), *np.percentile(us, (50, 99)), np.max(us),
                     np.sum(us) * MICROSECOND))
    return np.asarray(np.median(rows, axis=0))


def sample_steps(n: int, every: int) -> frozenset[int]:
    """Return every so many steps, and the last one."""
    return frozenset({*range(every, n, every), n - 1})


def interleaved(
    world: World, tools: dict[str, Tool], plan: Plan, repeats: int, long: float = 60.0,
) -> dict[str, list[Run]]:
    """
    Run all tools over a world, one after the other, and that `repeats` times.

    Estimates are taken in the first round alone. A tool whose steps took more than `long` [s] is
    not run again.
    """
    runs: dict[str, list[Run]] = {name: [] for name in tools}
    for repeat in range(repeats):
        for name, tool in tools.items():
            if repeat > 0 and float(np.sum(runs[name][0].seconds)) > long:
                continue
            runs[name].append(tool(world, plan if repeat == 0 else Plan(limit=plan.limit)))
    return runs


@contextmanager
def quiet() -> Iterator[None]:
    """Keep Python's garbage collector out of what is timed."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
