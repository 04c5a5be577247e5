# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Dense priors as columns of saved graphs, and as the edges that other programs read."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from pose_graph_ros.core.graph.constraints import Edges, ObservedNodes
from pose_graph_ros.core.graph.graph import GraphRows
from pose_graph_ros.core.graph.priors import model, packed, Prior, unpacked
from pose_graph_ros.core.marginalization.marginalize import schur_complement
from pose_graph_ros.core.marginalization.sparsification import sparsify
from pose_graph_ros.core.saved_columns import Flags, Integers, Numbers


@dataclass(frozen=True, slots=True)
class SavedPriors:
    """Dense priors, one behind the other."""

    sizes: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Number k of nodes of each prior, shape (P,)."""
    anchored: Flags = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    """Shape (P,)."""
    nodes: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """Ids of the nodes of all priors, shape (sum of the sizes,)."""
    numbers: Numbers = field(default_factory=lambda: np.empty(0))
    """
    Of each prior the upper triangle of its information row by row, each row followed by the number
    of the vector, then the reference poses and the energy.
    """


def saved_priors(priors: Sequence[Prior]) -> SavedPriors:
    """Return priors as columns."""
    if len(priors) == 0:
        return SavedPriors()
    return SavedPriors(
        np.array([len(prior.nodes) for prior in priors], dtype=np.int64),
        np.array([prior.anchored for prior in priors], dtype=np.bool_),
        np.concatenate([prior.nodes for prior in priors]).astype(np.int64),
        np.concatenate([packed(prior) for prior in priors]))


def restored_priors(saved: SavedPriors) -> tuple[Prior, ...]:
    """Return saved priors; raise ValueError if the lengths of the columns do not fit."""
    sizes = saved.sizes
    counts = 3 * sizes * (3 * sizes + 3) // 2 + 3 * sizes + 1
    if (np.any(sizes < 1) or len(saved.anchored) != len(sizes)
            or len(saved.nodes) != np.sum(sizes) or len(saved.numbers) != np.sum(counts)):
        raise ValueError('graph.priors: expected columns whose lengths fit the sizes of the '
                         'priors')
    of_nodes, of_numbers = np.cumsum(sizes)[:-1], np.cumsum(counts)[:-1]
    return tuple(unpacked(nodes, numbers, anchored=anchored) for nodes, numbers, anchored in zip(
        np.split(saved.nodes, of_nodes) if len(sizes) > 0 else (),
        np.split(saved.numbers, of_numbers) if len(sizes) > 0 else (),
        saved.anchored.tolist(), strict=True))


def standing_for(rows: GraphRows) -> tuple[Edges, ObservedNodes]:
    """
    Return edges and observed nodes that tell no more of the poses than the priors of a graph.

    They have the minimum of the priors, linear at the present poses, and their ends are ids.
    Biases and landmarks in priors are marginalised out.
    """
    edges, observed = [], []
    for prior in rows.priors:
        at = rows.rows_of(prior.nodes)
        is_pose = rows.is_pose[at]
        linear = model(prior, rows.poses[at], is_pose)
        if not np.any(is_pose):
            continue
        U, u = schur_complement(
            linear.information, -linear.gradient, np.repeat(~is_pose, 3))
        sparse = sparsify(prior.nodes[is_pose], rows.poses[at[is_pose]], U, u,
                          anchored=prior.anchored)
        edges.append(sparse.edges)
        observed.append(sparse.observed)
    return Edges.joined(edges), ObservedNodes.joined(observed)
