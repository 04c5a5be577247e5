# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Writing of graphs in the g2o text format; `g2o` has the tags, and what is left out."""

from pathlib import Path
from typing import Protocol

import numpy as np

from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, FACTORS, Factors, upper
from pose_graph_ros.core.graph.graph_update import GraphRows
from pose_graph_ros.core.graph.priors import model

NOT_USED = '# not used '
"""Begin of the line of a constraint with weight 0."""
STANDING_FOR_PRIORS = '# instead of dense priors, which g2o does not have, '
"""Begin of the line behind which there is nothing but edges and observed nodes for priors."""


class _HasRows(Protocol):
    def rows(self) -> GraphRows: ...


def write_g2o(graph: _HasRows, path: Path, ids: IntArray | None = None) -> None:
    """
    Write a graph so that its numbers read back bit for bit.

    `ids` are numbers of the hidden nodes, by default their ids.
    """
    path.write_text(g2o_text(graph.rows(), ids), encoding='ascii')


def g2o_text(rows: GraphRows, ids: IntArray | None = None) -> str:
    """
    Return the text of a g2o file: vertices, FIX, edges and observed nodes, each in their order.

    Edges and observed nodes that tell about the same as dense priors are the last lines. `ids` are
    numbers of the hidden nodes, by default their ids.
    """
    ids = rows.node_ids if ids is None else ids
    factors = rows.factors.renumbered(rows.rows_of)
    edges, observed = factors.edges, factors.observed
    n_edges, n_observed = len(edges), len(observed)
    is_pose = rows.is_pose
    used = _is_used(observed, edges)
    lines = []
    if not np.all(is_pose):
        used = used[~rows.is_bias[observed.i]]
        edges = edges.rows(np.isin(edges.kind, [kind for kind in FACTORS if FACTORS[kind].tag])
                           & ~np.any(edges.constants, axis=1))
        observed = observed.rows(~rows.is_bias[observed.i])
    if len(edges) < n_edges or np.any(rows.is_bias):
        lines.append(f'# left out: {np.sum(rows.is_bias)} biases, {n_edges - len(edges)} '
                     f'edges to them and {n_observed - len(observed)} observed ones')
    lines += [f'VERTEX_SE2 {name} {numbers}' for name, numbers in zip(
        ids[is_pose].tolist(), _texts(rows.poses[is_pose]), strict=True)]
    is_landmark = ~is_pose & ~rows.is_bias
    lines += [f'VERTEX_XY {name} {numbers}' for name, numbers in zip(
        ids[is_landmark].tolist(), _texts(rows.poses[is_landmark, :2]), strict=True)]
    lines += [f'FIX {name}' for name in ids[rows.fixed & ~rows.is_bias].tolist()]
    lines += [*_edge_lines(edges, ids), *_observed_lines(observed, ids, used)]
    if len(rows.priors) > 0:
        lines += _lines_for_priors(rows, ids)
    return '\n'.join(lines) + '\n'


def _lines_for_priors(rows: GraphRows, ids: IntArray) -> list[str]:
    factors = standing_for(rows).renumbered(rows.rows_of)
    observed = factors.observed
    lines = [*_edge_lines(factors.edges, ids),
             *_observed_lines(observed, ids, np.ones(len(observed), dtype=bool))]
    return [f'{STANDING_FOR_PRIORS}of which there are {len(rows.priors)}: {len(lines)} lines',
            *lines]


def _is_used(observed: Factors, edges: Factors) -> BoolArray:
    """
    Return which measurements are used, shape (K,).

    One with a correlated error has weight 0; an edge from its node to a bias holds it instead.
    """
    to_bias = edges.rows((edges.kind == FactorKind.BIAS) & (edges.weight > 0.0))
    held = set(zip(to_bias.i.tolist(), *to_bias.mean[:, :2].T.tolist(), strict=True))
    used = observed.weight > 0.0
    for k in np.flatnonzero(~used).tolist() if len(held) > 0 else ():
        used[k] = (int(observed.i[k]), *observed.mean[k, :2].tolist()) in held
    return np.asarray(used)


def _edge_lines(edges: Factors, ids: IntArray) -> list[str]:
    lines, triangles = np.empty(len(edges), dtype=object), upper(edges.information)
    for kind, factor in FACTORS.items():
        chosen = np.flatnonzero(edges.kind == kind)
        measured = [column for column, pair in enumerate(zip(*np.triu_indices(3), strict=True))
                    if set(pair) <= set(factor.rows)]
        some = edges.rows(chosen)
        lines[chosen] = [f'{begin}{factor.tag} {i} {j} {numbers}' for begin, i, j, numbers in zip(
            _begins(some.weight > 0.0), ids[some.i].tolist(), ids[some.j].tolist(),
            _texts(np.hstack((some.mean[:, list(factor.rows)], triangles[chosen][:, measured]))),
            strict=True)]
    return list(lines)


def _observed_lines(observed: Factors, ids: IntArray, used: BoolArray) -> list[str]:
    triangles = upper(observed.information)
    moved = np.any(observed.offset != 0.0, axis=1)
    placed = np.all(observed.information[:, 2] == 0.0, axis=1) & (observed.mean[:, 2] == 0.0)
    tags = np.where(moved, 'OBSERVED_SE2_OFFSET',
                    np.where(placed, 'EDGE_PRIOR_SE2_XY', 'EDGE_PRIOR_SE2'))
    numbers = {
        'OBSERVED_SE2_OFFSET': (observed.offset, observed.mean, triangles),
        'EDGE_PRIOR_SE2': (observed.mean, triangles),
        'EDGE_PRIOR_SE2_XY': (observed.mean[:, :2], triangles[:, (0, 1, 3)]),
    }
    lines = np.empty(len(observed), dtype=object)
    for tag, columns in numbers.items():
        rows = np.flatnonzero(tags == tag)
        lines[rows] = [f'{begin}{tag} {name} {text}' for begin, name, text in zip(
            _begins(used[rows]), ids[observed.i[rows]].tolist(),
            _texts(np.hstack(columns)[rows]), strict=True)]
    return list(lines)


def _begins(used: BoolArray) -> list[str]:
    """Return what the lines of constraints begin with, given which are used, shape (M,)."""
    return ['' if each else NOT_USED for each in used.tolist()]


def _texts(rows: FloatArray) -> list[str]:
    """Return the numbers of each row with the digits needed to read them back bit for bit."""
    # the text of a list is made at once
    return [repr(row)[1:-1].replace(',', '') for row in rows.tolist()]


def standing_for(rows: GraphRows) -> Factors:
    """
    Return edges and observed nodes that tell no more of the poses than the priors of a graph.

    They have the minimum of the priors, linear at the present poses, and their ends are ids.
    Biases and landmarks in priors are marginalised out.
    """
    # takes long to load, and most graphs have none
    from pose_graph_ros.core.marginalization.marginalize import schur_complement  # noqa: PLC0415
    from pose_graph_ros.core.marginalization.sparsification import sparsify  # noqa: PLC0415

    factors = []
    for prior in rows.priors:
        at = rows.rows_of(prior.nodes)
        is_pose = rows.is_pose[at]
        linear = model(prior, rows.poses[at], is_pose)
        if not np.any(is_pose):
            continue
        U, u = schur_complement(
            linear.information, -linear.gradient, np.flatnonzero(~is_pose))
        sparse = sparsify(prior.nodes[is_pose], rows.poses[at[is_pose]], U, u,
                          anchored=prior.anchored)
        factors.append(sparse.factors)
    return Factors.joined(factors)
