# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Online runs of one tool over one world: the time of each step, and estimates taken along the way.

Both tools are run by a function `run(world, plan) -> Run`, interleaved and several times over.
Times are wall time of one thread. Taking an estimate is not part of a step's time.
"""

from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
import gc
from typing import TYPE_CHECKING

import numpy as np

from benchmark.worlds import World
from pose_graph_ros.core.geometry.se2 import FloatArray

if TYPE_CHECKING:
    from collections.abc import Iterator

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
    samples: dict[int, FloatArray] = field(default_factory=dict)
    """Estimates, shape (step + 1, 3), after the steps of the plan and after the last one."""
    refinement: list[float] = field(default_factory=list)
    """Time of each iteration of the refinements at the samples [s]."""
    note: str = ''
    """What a reader of the figures must know."""

    @property
    def steps(self) -> int:
        """Number of steps that were done."""
        return len(self.seconds)


@dataclass(frozen=True, slots=True)
class Timing:
    """Figures of the time of a step over the same first steps of several runs [us]."""

    mean: float
    p50: float
    p99: float
    maximum: float
    total: float
    """Of all the steps [s]."""


def timing(runs: list[Run], steps: int | None = None) -> Timing:
    """Return the medians over runs of the figures of the first steps (all by default)."""
    rows = []
    for run in runs:
        seconds = run.seconds[1:steps] / MICROSECOND
        rows.append((np.mean(seconds), *np.percentile(seconds, (50, 99)), np.max(seconds),
                     np.sum(seconds) * MICROSECOND))
    return Timing(*np.median(rows, axis=0).tolist())


def sample_steps(n: int, every: int) -> frozenset[int]:
    """Return every so many steps, and the last one."""
    return frozenset({*range(every, n, every), n - 1})


def interleaved(
    world: World, tools: dict[str, Callable[[World, Plan], Run]], plan: Plan, repeats: int,
    long: float = 60.0,
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
def quiet() -> 'Iterator[None]':
    """Keep Python's garbage collector out of what is timed."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
