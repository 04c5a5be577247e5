# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is skipped to save time would have had no effect."""

import numpy as np
import pytest
from test_closure_reports import driven

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.judgement import closures as cl
from pose_graph_ros.core.judgement.closures import GATE
from pose_graph_ros.core.judgement.verdicts import State


@pytest.mark.parametrize('seed', range(3))
def test_every_residual_above_the_gate_is_looked_at(
    seed: int, monkeypatch: pytest.MonkeyPatch,
) -> None:
    # believed while they were plausible, then torn apart by odometry that is moved
    rng = np.random.default_rng(seed)
    backend = driven(*rng.normal(0.0, 0.2, 12))
    judge = backend._judge._closures
    inside = np.flatnonzero(judge.states.in_graph & judge.states.judged)
    assert len(inside) > 5
    for scale in (0.0, 0.1, 0.3, 1.0, 3.0):
        poses = backend.graph.poses + scale * rng.normal(size=backend.graph.poses.shape) * (
            1.0, 1.0, 0.1)
        backend.graph.set_poses(se2.wrapped(poses))
        some = judge.states.rows(inside)
        bad = cl.squares(backend.graph.errors(cl.as_edges(some)), some.noise) > GATE
        thrown_out: dict[int, State] = {}
        monkeypatch.setattr(judge, '_change', thrown_out.update)
        judge._throw_out(inside)
        judge.states.resting[:] = 0
        assert [*thrown_out] == inside[bad].tolist()
    assert np.any(bad)
