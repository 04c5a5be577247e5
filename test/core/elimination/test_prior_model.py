# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The linearization error of a prior that has turned, beside differences of its displacement."""

from dataclasses import replace

import numpy as np
import pytest
from random_graphs import random_poses
from random_priors import random_prior
from slow_smoother import EXACT

from pose_graph_ros.core.elimination.clique_frames import slip_error2
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import prior_rows
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.graph.priors import model, Prior
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

K = 4


def displacement(prior: Prior, poses: FloatArray) -> FloatArray:
    """Return the displacement of poses, shape (3k,), by differences of energies."""
    n, is_pose = prior.reference.size, np.ones(len(prior.nodes), np.bool_)
    unit = replace(prior, information=np.eye(n), vector=np.zeros(n), energy=0.0)
    squared = model(unit, poses, is_pose).energy
    return np.array([0.5 * (squared - model(replace(unit, vector=axis), poses, is_pose).energy)
                     for axis in np.eye(n)])


@pytest.mark.parametrize('anchored', [False, True])
@pytest.mark.parametrize('seed', range(4))
def test_the_error_of_a_turned_prior_is_that_of_its_displacement(
    seed: int, *, anchored: bool,
) -> None:
    """Where the gradient is zero, and the shape has hardly changed."""
    rng = np.random.default_rng(seed)
    reference = random_poses(rng, K)
    before = se2.wrapped(reference + rng.normal(0.0, 0.1, (K, 3)))
    turn = np.array((0.0, 0.0, 0.2))
    about = np.append(reference[0, :2], 0.0)
    after = se2.compose(about, se2.compose(turn, se2.between(about, before)))
    after = se2.wrapped(after + rng.normal(0.0, 0.004, (K, 3)))
    prior = random_prior(rng, list(range(K)), reference, anchored=anchored)
    prior = replace(prior, vector=prior.information @ displacement(prior, after))
    smoother = IncrementalSmoother(EXACT)
    smoother.update(GraphUpdate(hidden=before, priors=[prior], factors=Factors.on(
        range(K), None, before, [1e12 * np.eye(3)] * K, [FactorKind.GLOBAL_POSE] * K)))
    head, nodes = smoother.graph.memory.head, smoother.graph.node_records
    before = smoother.poses.copy()
    change = se2.wrapped(after - before)
    nodes['pose'] = after
    nodes['delta'] += change
    c, = prior_rows.all_priors(head)
    found = slip_error2(head, int(c), np.zeros(15 * K))

    step = 1e-6
    J = np.column_stack([
        displacement(prior, before + move) - displacement(prior, before - move)
        for move in step * np.eye(3 * K).reshape(-1, K, 3)]) / (2.0 * step)
    w = displacement(prior, after) - displacement(prior, before) - J @ change.ravel()
    # a changed shape adds a little whatever the information
    np.testing.assert_allclose(found, w @ prior.information @ w, rtol=1e-3)
