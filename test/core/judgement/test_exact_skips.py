# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is skipped to save time would have had no effect."""

import numpy as np
import pytest
from test_closure_reports import driven

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.judgement import closures as cl
from pose_graph_ros.core.judgement.closures import GATE


@pytest.mark.parametrize('seed', range(3))
def test_every_residual_above_the_gate_is_looked_at(seed: int) -> None:
    # believed while they were plausible, then torn apart by odometry that is moved
    rng = np.random.default_rng(seed)
    backend = driven(*rng.normal(0.0, 0.2, 12))
    judge = backend._judge._closures
    inside = np.flatnonzero(judge._states.in_graph & judge._states.judged)
    assert len(inside) > 5
    for scale in (0.0, 0.1, 0.3, 1.0, 3.0):
        poses = backend.graph.poses + scale * rng.normal(size=backend.graph.poses.shape) * (
            1.0, 1.0, 0.1)
        backend.graph.set_poses(se2.wrapped(poses))
        bad = cl.residuals(backend.graph, judge._table.rows(inside)) > GATE
        assert np.all(cl.are_above(
            backend.graph, judge._states.held[inside], 0.5 * GATE)[bad])
    assert np.any(bad)
