# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random dense priors for tests."""

import numpy as np

from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.priors import Prior


def rigid_motions(poses: FloatArray) -> FloatArray:
    """Return the three infinitesimal rigid motions of poses, shape (3k, 3)."""
    motions = np.zeros((len(poses), 3, 3))
    motions[:, 0, 0] = motions[:, 1, 1] = motions[:, 2, 2] = 1.0
    motions[:, 0, 2], motions[:, 1, 2] = -poses[:, 1], poses[:, 0]
    return motions.reshape(-1, 3)


def random_prior(
    rng: np.random.Generator, nodes: list[int], reference: FloatArray, *, anchored: bool,
) -> Prior:
    k = len(nodes)
    root = 10.0 * rng.normal(size=(3 * k, 3 * k))
    if not anchored:
        null = np.linalg.qr(rigid_motions(reference))[0]
        root -= root @ null @ null.T
    U = root.T @ root
    return Prior(np.array(nodes), reference, U, U @ rng.normal(0.0, 0.01, 3 * k),
                 float(rng.uniform(0.0, 9.0)), anchored)
