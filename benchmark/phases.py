# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Where the time of a step with a closure goes: its phases, called one by one from Python.

The loop is that of `step.run` without its batch fallback, so each call adds about a microsecond.
"""

from collections import defaultdict
from collections.abc import Callable
import time
from typing import Any

import numpy as np

from benchmark import ours
from benchmark.runs import MICROSECOND, Plan
from benchmark.section import about, Options, Section
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.compiled.jit import INDICES, kernel
from pose_graph_ros.core.graph import tables as tb
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.rows import forget_touched
from pose_graph_ros.core.smoother import step, tree_update
from pose_graph_ros.core.smoother.back_substitution import back_substitute
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother, UpdateResult

ORDER, ELIMINATE, SOLVE, CHECK, RELINEARIZE, REST = PHASES = (
    'affected part and its order', 'elimination', 'back-substitution',
    'check of the linearization', 'choice of what is linearized again', 'Python and new rows')


@kernel(signature=(tb.HEAD,))
def _solve(head):  # type: ignore[no-untyped-def]
    back_substitute(head)


@kernel(signature=(tb.HEAD,))
def _check(head):  # type: ignore[no-untyped-def]
    return step.leave_over(head, step.check(head))


@kernel(signature=(tb.HEAD,))
def _relinearize(head):  # type: ignore[no-untyped-def]
    step.relinearize(head)


@kernel(signature=(tb.HEAD, INDICES), allocates=True)
def _eliminate(head, rows):  # type: ignore[no-untyped-def]
    code = tree_update.eliminate(head, rows)
    forget_touched(head)
    return code


class Phased(IncrementalSmoother):
    """A smoother that keeps the times of the phases of its updates [s]."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds: dict[str, float] = defaultdict(float)

    def _timed(self, phase: str, kernel: Callable[..., Any], *arguments: Any) -> Any:
        begin = time.perf_counter()
        result = kernel(*arguments)
        self.seconds[phase] += time.perf_counter() - begin
        return result

    def _step(self, entered: int, again: GraphUpdate | None = None) -> UpdateResult:
        head, timed = self._memory.head, self._timed
        head[tb.N_RELINEARIZED:tb.N_ITERATIONS + 1] = head[tb.N_TURNED] = 0
        head[tb.HEEDS] = tb.ALL
        settled = False
        while not settled and head[tb.N_ITERATIONS] < self._config.max_iterations:
            timed(RELINEARIZE, _relinearize, head)
            if head[tb.N_TOUCHED] == 0:
                break
            code = tree_update.MORE_MEMORY
            while code == tree_update.MORE_MEMORY:
                self._make_room()
                marked, affected = timed(ORDER, tree_update.mark, head)
                head[tb.ITERATION] += 1
                head[tb.SINCE] = head[tb.ITERATION]
                code, rows = timed(ORDER, *(
                    (tree_update.reordered, head, marked, affected) if head[tb.STRUCTURE]
                    else (tree_update.renewed, head, marked)))
            assert timed(ELIMINATE, _eliminate, head, rows) == tree_update.DONE
            head[tb.STRUCTURE] = 0
            timed(SOLVE, _solve, head)
            settled = timed(CHECK, _check, head)
        self.graph.commit()
        return UpdateResult(Status.CONVERGED, '')


def phases(options: Options) -> Section:
    """
    Measure the phases of the steps with closures, without those along the chain.

    Shares of their whole time, adding the rows and Python included.
    """
    section = Section('Phases of a step with closures', about(phases))
    table = section.table('Shares [%]', 'world', 'steps', 'mean us', *PHASES)
    for world in options.closing(section.notes):
        shares, mean, count = _shares(world)
        table.add(world.name, str(count), f'{mean:.0f}', *(f'{each:.0f}' for each in shares))
    return section


def _shares(world: ours.World) -> tuple[list[float], float, int]:
    """Return the shares of the phases [%], the mean time of a step [us], and the steps."""
    for _ in range(2):  # kernels are compiled in the first run
        engine = ours.Ours(world)
        smoother = engine.smoother = Phased()
        seconds = ours.run(world, Plan(), None, engine).seconds
    closing = np.flatnonzero(~np.array(engine.plain))
    total = float(np.sum(seconds[closing]))
    spent = [smoother.seconds[phase] for phase in PHASES[:-1]]
    return ([100.0 * each / total for each in (*spent, total - sum(spent))],
            total / len(closing) / MICROSECOND, len(closing))
