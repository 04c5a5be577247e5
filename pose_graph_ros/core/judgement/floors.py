# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The information to decide on closures by: front ends claim too small sigmas.

A closure is turned to lead from the earlier to the later node before its variances are raised, so
that it does not matter in which direction it was measured.
"""

from dataclasses import replace

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.solver_config import CLOSURE_FLOORS

FLOORS = np.array(CLOSURE_FLOORS)
# Added to an information, relative to its largest entry, before it is inverted.
_SINGULAR = 1e-12


def floored(edges: Edges, sigmas: FloatArray = FLOORS) -> Edges:
    """
    Return edges with the variances of their errors raised to at least those given.

    What is not measured, and so has an infinite variance, stays so.

    Parameters
    ----------
    sigmas : ndarray, shape (3,), in the frames of the measured poses [m, m, rad]

    """
    information = edges.information
    most = np.max(np.abs(information), axis=(1, 2), initial=0.0)
    covariance = np.linalg.inv(
        information + _SINGULAR * most[:, None, None] * np.eye(3))
    missing = np.maximum(sigmas**2 - np.einsum('mii->mi', covariance), 0.0)
    # (C + D)^-1 = I (1 + D I)^-1 with D the diagonal of what is missing
    softer = information @ np.linalg.inv(np.eye(3) + missing[:, :, None] * information)
    softer = 0.5 * (softer + softer.transpose(0, 2, 1))
    return replace(edges, information=softer)


def forward(edges: Edges) -> Edges:
    """Return the same edges, each leading from the smaller row to the larger one."""
    back = np.flatnonzero((edges.i > edges.j) & (edges.kind <= EdgeKind.LOOP_CLOSURE))
    if len(back) == 0:
        return edges
    i, j = edges.i.copy(), edges.j.copy()
    mean, information = edges.mean.copy(), edges.information.copy()
    i[back], j[back] = edges.j[back], edges.i[back]
    # the error of the inverse is the error, moved from the end to the start
    mean[back] = se2.inverse(edges.mean[back])
    adjoint = se2.adjoint(mean[back])
    information[back] = adjoint.transpose(0, 2, 1) @ information[back] @ adjoint
    return replace(edges, i=i, j=j, mean=mean, information=information)
