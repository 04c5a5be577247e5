# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""GTSAM's fixed-lag smoothers on our worlds: the incremental one on iSAM2, and the batch one."""

from dataclasses import dataclass
import time

import gtsam
import numpy as np

from benchmark.gtsam_peer import Models, poses_of, Setting, step_of
from benchmark.runs import Plan, quiet
from benchmark.window_lag import LagRun
from benchmark.worlds import World


@dataclass(frozen=True, slots=True)
class FixedLag:
    """GTSAM's `IncrementalFixedLagSmoother`, or its `BatchFixedLagSmoother` without a setting."""

    lag: int
    setting: Setting | None

    @property
    def name(self) -> str:
        """As the tables have it."""
        return 'GTSAM batch' if self.setting is None else self.setting.name

    def __call__(self, world: World, plan: Plan) -> LagRun:
        """Run the smoother over a world, with its fastest factorisation that works."""
        if self.setting is None:
            return self._run(world, plan, gtsam.BatchFixedLagSmoother(float(self.lag)))
        try:
            return self._run(world, plan, self._incremental('CHOLESKY'))
        except RuntimeError as error:
            where = f'Cholesky gives up after {error.args[1]} of {world.n_nodes} steps'
        run = self._run(world, plan, self._incremental('QR'))
        run.note = f'QR ({where})' + (f'; {run.note}' if run.note else '')
        return run

    def _incremental(self, factorization: str) -> gtsam.IncrementalFixedLagSmoother:
        assert self.setting is not None
        params = self.setting.params(factorization)
        # as with its default parameters: slots of factors that have gone are used again
        params.findUnusedFactorSlots = True
        return gtsam.IncrementalFixedLagSmoother(float(self.lag), params)

    def _run(self, world: World, plan: Plan, smoother: gtsam.FixedLagSmoother) -> LagRun:
        models = Models()
        run = LagRun(self.name, np.zeros(world.n_nodes), np.zeros((world.n_nodes, 3)))
        total = 0.0
        with quiet():
            for k in range(world.n_nodes):
                factors, values = step_of(world, k, smoother, models)
                stamps = {k: float(k)}
                begin = time.perf_counter()
                try:
                    smoother.update(factors, values, stamps)
                    newest = smoother.calculateEstimatePose2(k)
                except RuntimeError as error:
                    raise RuntimeError(str(error), k) from error
                run.seconds[k] = time.perf_counter() - begin
                total += run.seconds[k]
                run.newest[k] = newest.x(), newest.y(), newest.theta()
                if k in plan.samples:
                    values = smoother.calculateEstimate()
                    run.samples[k] = np.array(list(values.keys())), poses_of(values)
                if total > plan.limit:
                    run.cut(k + 1)
                    run.note = f'first {k + 1} steps, {plan.limit:.0f} s'
                    break
        return run
