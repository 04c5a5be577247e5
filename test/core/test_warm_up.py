# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""After the warm-up nothing is left to be compiled, whatever happens on the way."""

import subprocess
import sys

import pytest

from pose_graph_ros.core import warm_up

# In an interpreter of its own, where nothing has been compiled or loaded before.
RUN = """
import numpy as np
from pose_graph_ros.core.warm_up import warm_up
from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.compiled import jit
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, SmootherConfig
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.measurements import GlobalPose, LoopClosure, OdometrySample, Position

def signatures():
    return {name: [str(s) for s in kernel.signatures] for name, kernel in jit._registered.items()}

assert warm_up() > 0.0
before = signatures()

rng = np.random.default_rng(0)
SECOND = 10**9
for config in (BackendConfig(), BackendConfig(smoother=SmootherConfig(max_iterations=1))):
    backend, pose, truth = PoseGraphBackend(config), np.array([3.0, 1.0, 0.4]), [np.zeros(3)]
    step = np.array([1.0, 0.0, 2.0 * np.pi / 100])
    for k in range(700):
        stamp = (k + 1) * SECOND
        backend.add_odometry(OdometrySample(stamp, pose))
        at = truth[-1]
        if k > 60 and k % 5 == 0:
            backend.add_measurement(Position(
                stamp, at[:2] + rng.normal(0.0, 0.5, 2), 0.25 * np.eye(2), np.array([0.3, 0.1])),
                'fix')
        if k > 60 and k % 11 == 0:
            backend.add_measurement(GlobalPose(
                stamp - 30 * SECOND, truth[-31], 0.01 * np.eye(3)), 'late')
        if k > 110 and k % 17 == 0:
            backend.add_measurement(LoopClosure(
                stamp, se2.between(truth[-101], at), 0.01 * np.eye(3),
                reference_ns=stamp - 100 * SECOND), 'scan')
        if k == 600:    # far off: it is optimised as a whole
            backend.add_measurement(GlobalPose(stamp, at + 500.0, 0.01 * np.eye(3)), 'outlier')
        pose = se2.compose(pose, step + rng.normal(0.0, (0.02, 0.01, 0.003)))
        truth.append(se2.compose(at, step))
        backend.update()
        backend.estimate()
    smoother = backend._smoother
    for update in (
            GraphUpdate(remove_edges=(800,)) if backend.graph.n_edges > 800 else GraphUpdate(),
            GraphUpdate(weigh_observed={3: 0.1}, weigh_edges={5: 2.0}),
            GraphUpdate(fix=(7,)), GraphUpdate(free=(7,)), GraphUpdate(remove_observed=(4,))):
        smoother.update(update)
    smoother.covariances()
    smoother.joint_covariance(5, 600)
    alone = smoother.update(GraphUpdate(hidden=np.zeros((1, 3))))
    assert alone.status is Status.FAILED, alone
    backend.optimize()
    backend.update()

grown = {name: found for name, found in signatures().items() if found != before[name]}
assert not grown, grown
"""


# The next start must not say that it compiles.
COMPLETE = """
from pose_graph_ros.core.warm_up import warm_up
from pose_graph_ros.core.compiled import jit
warm_up()
missing = [name for name, kernel in jit._registered.items() if not kernel._cache.holds_code()]
assert jit.is_cached(), missing
"""


def run_alone(code: str) -> None:
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f'exit code {done.returncode}: {done.stderr[-3000:]}'


@pytest.mark.timeout(300)
def test_after_the_warm_up_the_code_of_all_kernels_is_kept() -> None:
    run_alone(COMPLETE)


@pytest.mark.timeout(300)
def test_a_long_run_after_the_warm_up_compiles_nothing() -> None:
    run_alone(RUN)


def test_the_warm_up_can_be_stopped_between_its_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[int] = []
    monkeypatch.setattr(warm_up, 'STEPS', tuple(lambda k=k: done.append(k) for k in range(5)))
    assert warm_up.warm_up(lambda: len(done) == 2) >= 0.0
    assert done == [0, 1]
    warm_up.warm_up()
    assert done == [0, 1, 0, 1, 2, 3, 4]
