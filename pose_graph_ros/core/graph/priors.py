# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Dense priors: what constraints that have left a graph say about the nodes that remain.

A prior is a quadratic form in the displacement d of its nodes from reference poses,

    d^T U d - 2 u^T d + c

with the information U, the vector u and the energy c. An *anchored* prior knows where its nodes
are in the map, a relative one does not. The displacement of a relative one is that in a frame
that turns with its nodes, by the mean turn phi of their headings, and moves with the first of
them, so a rigid motion of all its nodes changes nothing:

    d_k = (R_phi^T (t_k - t_0) - (t_ref_k - t_ref_0), th_k - th_ref_k - phi)

Its derivative by a change delta of the poses is P M delta, with M = diag(R_phi^T, 1) of each node
and P = I - r m^T: r = (S R_phi^T (t_k - t_0), 1) is the derivative of the coordinates by -phi, and
m takes the mean of the headings. So U turns into M^T P^T U P M, which has a rigid motion in its
null space wherever the nodes are.

An anchored prior turns, too, about the reference t_ref_0 of its first node, but its displacement
has the linear effect of the turn:

    d_k = (R_phi^T (t_k - t_ref_0) - (t_ref_k - t_ref_0) + phi S (t_ref_k - t_ref_0),
           th_k - th_ref_k)

Now r = (S (R_phi^T (t_k - t_ref_0) - (t_ref_k - t_ref_0)), 0). At the reference P is I; elsewhere
it maps each rigid motion of the nodes where they are to one of the nodes where they were. So what
the prior knows of relative poses says nothing about the map, as little as the constraints beside
it, however often these are linearized again. With the mere difference of the poses the heading of
the whole would gain information that nobody measured. It is taken for a single node, and where a
node is no pose.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.saved_columns import Integers, Matrix, Numbers, Rows3


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """A quadratic form in the poses of k hidden nodes; see the module."""

    nodes: Integers     # ids, shape (k,)
    reference: Rows3    # poses from which displacements are counted, shape (k, 3)
    information: Matrix     # U, shape (3k, 3k) [1/m^2, 1/(m rad), 1/rad^2]
    vector: Numbers     # u, shape (3k,) [1/m, 1/rad]: minus half the gradient at the reference
    energy: float       # c, at the reference [sigma^2]
    anchored: bool      # whether it says where its nodes are in the map, not only in each other


class PriorModel(NamedTuple):
    """A prior at certain poses of its nodes, for a change of these in map axes."""

    energy: float           # [sigma^2]
    gradient: FloatArray    # half the gradient of the energy, shape (3k,)
    information: FloatArray     # shape (3k, 3k)


def model(prior: Prior, poses: FloatArray, is_pose: BoolArray) -> PriorModel:
    """Return the energy of a prior, with its derivatives, at other poses of its nodes, (k, 3)."""
    k, U = len(prior.nodes), prior.information
    turns = se2.wrap(poses[:, 2] - prior.reference[:, 2])
    if prior.anchored and (k == 1 or not np.all(is_pose)):
        d = (poses - prior.reference)
        d[:, 2] = turns
        P = M = np.eye(3 * k)
    else:
        turns = turns[0] + se2.wrap(turns - turns[0])
        phi = float(np.mean(turns))
        c, s = np.cos(phi), np.sin(phi)
        R = np.array(((c, -s), (s, c)))
        d, r = np.empty((k, 3)), np.empty((k, 3))
        arms = prior.reference[:, :2] - prior.reference[0, :2]
        about = prior.reference[0, :2] if prior.anchored else poses[0, :2]
        local = (poses[:, :2] - about) @ R
        d[:, :2], d[:, 2] = local - arms, turns - phi
        r[:, 0], r[:, 1], r[:, 2] = -local[:, 1], local[:, 0], 1.0
        if prior.anchored:
            rigid = np.column_stack((-arms[:, 1], arms[:, 0], np.ones(k)))
            d += phi * rigid
            r -= rigid
        P = np.eye(3 * k) - np.outer(r.ravel(), np.tile((0.0, 0.0, 1.0 / k), k))
        M = np.kron(np.eye(k), np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0))))
    flat, J = d.ravel(), P @ M
    g = U @ flat - prior.vector
    return PriorModel(float(flat @ (g - prior.vector) + prior.energy), J.T @ g, J.T @ U @ J)


def packed(prior: Prior) -> FloatArray:
    """Return the numbers of a prior as the tables hold them; see `prior_rows`."""
    n = 3 * len(prior.nodes)
    both = 0.5 * (prior.information + prior.information.T)
    rows = np.column_stack((both, prior.vector))
    return np.concatenate((
        rows[np.triu_indices(n, m=n + 1)], prior.reference.ravel(), (prior.energy,)))


def unpacked(nodes: IntArray, values: FloatArray, *, anchored: bool) -> Prior:
    """Return a prior on nodes, by id, whose numbers in the tables begin with these."""
    n = 3 * len(nodes)
    rows, index = np.zeros((n, n + 1)), np.triu_indices(n, m=n + 1)
    at = len(index[0])
    rows[index] = values[:at]
    U = rows[:, :n]
    return Prior(
        nodes, values[at:at + n].reshape(-1, 3).copy(), U + np.triu(U, 1).T, rows[:, n].copy(),
        float(values[at + n]), anchored)
