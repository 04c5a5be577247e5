# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Planar graphs in the g2o text format.

Tags that are read and written, one a line:

    VERTEX_SE2 id x y theta
    FIX id ...
    EDGE_SE2 i j x y theta I11 I12 I13 I22 I23 I33
    EDGE_PRIOR_SE2 id x y theta I11 I12 I13 I22 I23 I33     a global pose
    EDGE_PRIOR_SE2_XY id x y I11 I12 I22                    a position
    OBSERVED_SE2_OFFSET id ox oy otheta x y theta I11 I12 I13 I22 I23 I33

The last is this project's own, as g2o has no tag for an observed node with an offset; other
programs pass over it with a warning rather than misread it.

There is no tag for a bias either, nor for what was measured with one: they are left out, and a
comment says how many.

A file does not keep the order of observed nodes with different tags, nor which edges are loop
closures: those are taken to be the ones between ids that do not follow each other. Of a matrix
the upper triangle is written.

The tags `VERTEX2` and `EDGE2` stand for two formats with different numbers behind the same word:
TORO orders the information 11 12 22 33 13 23, iSAM stores its square root R11 R12 R13 R22 R23 R33.
Which of them a file holds must be said.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pose_graph_ros.core import se2
from pose_graph_ros.core.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes, upper
from pose_graph_ros.core.exceptions import FileFormatError, GraphUpdateError
from pose_graph_ros.core.graph import Graph, GraphRows, GraphUpdate
from pose_graph_ros.core.se2 import FloatArray, IntArray

# How the six numbers behind EDGE2 fill a symmetric (TORO) or an upper triangular (iSAM) matrix.
EDGE2_ORDERS = ('toro', 'isam')
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_TORO = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))


# Ids and numbers behind each tag; FIX takes any number of ids.
_LAYOUT = {
    'VERTEX_SE2': (1, 3),
    'VERTEX2': (1, 3),
    'EDGE_SE2': (2, 9),
    'EDGE2': (2, 9),
    'EDGE_PRIOR_SE2': (1, 9),
    'EDGE_PRIOR_SE2_XY': (1, 5),
    'OBSERVED_SE2_OFFSET': (1, 12),
}


@dataclass(frozen=True, slots=True)
class GraphFile:
    """A graph as a file holds it."""

    graph: Graph
    ids: IntArray
    """Id in the file of each hidden node, shape (N,), increasing."""
    has_start: bool
    """Whether the file gives a pose for every node; if not, the poses were integrated."""


class _Rows:
    """Rows of one kind as they are read: ids, numbers and the line that each came from."""

    def __init__(self, n_ids: int) -> None:
        self.n_ids = n_ids
        self.ids: list[list[int]] = []
        self.numbers: list[list[float]] = []
        self.lines: list[int] = []

    def add(self, words: list[str], line: int) -> None:
        self.ids.append([int(np.int64(int(word))) for word in words[:self.n_ids]])
        self.numbers.append([float(word) for word in words[self.n_ids:]])
        self.lines.append(line)


def read_g2o(path: Path, edge2_order: str | None = None) -> GraphFile:
    """
    Read a planar graph.

    Parameters
    ----------
    path : Path
    edge2_order : {'toro', 'isam'}, optional
        What `EDGE2` means in this file.

    Returns
    -------
    GraphFile
        Hidden nodes in the order of their ids. Without any `FIX` and any prior the node with the
        smallest id is fixed. Nodes without a `VERTEX_SE2` start where a walk along the edges from
        the smallest id leads to. Edges between consecutive ids count as odometry, others as loop
        closures.

    Raises
    ------
    FileFormatError
        Names the file and the line, what was expected and what came.

    """
    if edge2_order is not None and edge2_order not in EDGE2_ORDERS:
        raise ValueError(f'edge2_order: expected one of {EDGE2_ORDERS}, got {edge2_order!r}')
    rows = {tag: _Rows(n_ids) for tag, (n_ids, _) in _LAYOUT.items()}
    fixes = _Rows(1)
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f'{path}: cannot be read as text ({error})') from error
    for line, content in enumerate(text.splitlines(), 1):
        words = content.split()
        if len(words) == 0 or words[0].startswith('#'):
            continue
        where = f'{path}:{line}'
        if words[0] == 'FIX':
            for word in words[1:]:
                _add(where, fixes, [word], 'FIX', line)
        else:
            _read_line(where, words, rows, edge2_order, line)
    return _build(path, rows, fixes, edge2_order)


def _read_line(
    where: str, words: list[str], rows: dict[str, _Rows], edge2_order: str | None, line: int,
) -> None:
    tag, values = words[0], words[1:]
    if tag not in rows:
        known = ', '.join(['FIX', *rows])
        raise FileFormatError(f'{where}: tag {tag!r} is not known; known are {known}')
    if len(values) != sum(_LAYOUT[tag]):
        raise FileFormatError(
            f'{where}: {tag} is followed by {sum(_LAYOUT[tag])} numbers, got {len(values)}')
    if tag == 'EDGE2' and edge2_order is None:
        raise FileFormatError(
            f'{where}: EDGE2 means two formats with the information in different order; '
            f'say which this is: {" or ".join(EDGE2_ORDERS)}')
    _add(where, rows[tag], values, tag, line)


def _add(where: str, rows: _Rows, values: list[str], tag: str, line: int) -> None:
    try:
        rows.add(values, line)
    except (ValueError, OverflowError) as error:
        raise FileFormatError(f'{where}: {tag}: {error}') from error
    if not np.all(np.isfinite(rows.numbers[-1])):
        raise FileFormatError(f'{where}: {tag} holds a number that is not finite')


def _build(
    path: Path, rows: dict[str, _Rows], fixes: _Rows, edge2_order: str | None,
) -> GraphFile:
    vertices = _joined(rows['VERTEX_SE2'], rows['VERTEX2'])
    used = [_ids(table) for table in rows.values() if len(table.lines) > 0]
    if len(used) == 0:
        raise FileFormatError(f'{path}: holds no vertex and no edge')
    ids = np.unique(np.concatenate([table.ravel() for table in used]))
    given, first = np.unique(_ids(vertices).ravel(), return_index=True)
    if len(given) < len(vertices.lines):
        again = sorted(set(range(len(vertices.lines))) - set(first.tolist()))[0]
        raise FileFormatError(f'{path}:{vertices.lines[again]}: vertex '
                              f'{vertices.ids[again][0]} stands in the file twice')

    edges = _edges(rows, ids, edge2_order)
    observed = _observed(rows, ids)
    poses = np.zeros((len(ids), 3))
    poses[np.searchsorted(ids, given)] = _numbers(vertices, 3)[first]
    known = np.isin(ids, given)
    if not np.all(known):
        _walk(poses, known, edges)
    fixed = _fixed(path, fixes, ids)
    if len(fixed) == 0 and len(observed) == 0:
        fixed = [0]
    graph = Graph()
    try:
        graph.apply(GraphUpdate(hidden=poses))
        graph.apply(GraphUpdate(edges=edges, observed=observed, fix=fixed))
    except GraphUpdateError as error:
        raise FileFormatError(f'{_culprit(path, rows, ids, edge2_order)}: {error}') from error
    return GraphFile(graph, ids, bool(len(given) == len(ids)))


def _joined(*tables: _Rows) -> _Rows:
    """Return the rows of all tables, in order."""
    joined = _Rows(tables[0].n_ids)
    for table in tables:
        joined.ids += table.ids
        joined.numbers += table.numbers
        joined.lines += table.lines
    return joined


def _ids(table: _Rows) -> IntArray:
    return np.array(table.ids, dtype=np.int64).reshape(-1, table.n_ids)


def _numbers(table: _Rows, width: int) -> FloatArray:
    return np.array(table.numbers, dtype=np.float64).reshape(-1, width)


def _edges(rows: dict[str, _Rows], ids: IntArray, edge2_order: str | None) -> Edges:
    parts = []
    for tag in ('EDGE_SE2', 'EDGE2'):
        numbers = _numbers(rows[tag], 9)
        ends = np.searchsorted(ids, _ids(rows[tag]))
        order = edge2_order if tag == 'EDGE2' else None
        information = _information(numbers[:, 3:], order)
        kind = np.where(np.diff(_ids(rows[tag]), axis=1)[:, 0] == 1,
                        EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE)
        parts.append(
            Edges(ends[:, 0], ends[:, 1], se2.wrapped(numbers[:, :3]), information, kind))
    return Edges.joined(parts)


def _information(numbers: FloatArray, order: str | None) -> FloatArray:
    """Return matrices, shape (M, 3, 3), from six numbers each."""
    matrix = np.zeros((len(numbers), 3, 3))
    for column, (row, col) in enumerate(_TORO if order == 'toro' else _UPPER):
        matrix[:, row, col] = numbers[:, column]
        if order != 'isam':
            matrix[:, col, row] = numbers[:, column]
    return np.swapaxes(matrix, 1, 2) @ matrix if order == 'isam' else matrix


def _observed(rows: dict[str, _Rows], ids: IntArray) -> ObservedNodes:
    parts = []
    for tag in ('EDGE_PRIOR_SE2', 'EDGE_PRIOR_SE2_XY', 'OBSERVED_SE2_OFFSET'):
        numbers = _numbers(rows[tag], _LAYOUT[tag][1])
        node = np.searchsorted(ids, _ids(rows[tag])[:, 0])
        offset = np.zeros((len(node), 3))
        if tag == 'OBSERVED_SE2_OFFSET':
            offset, numbers = numbers[:, :3], numbers[:, 3:]
        if tag == 'EDGE_PRIOR_SE2_XY':
            mean = np.column_stack((numbers[:, :2], np.zeros(len(node))))
            information = np.zeros((len(node), 3, 3))
            information[:, 0, 0], information[:, 1, 1] = numbers[:, 2], numbers[:, 4]
            information[:, 0, 1] = information[:, 1, 0] = numbers[:, 3]
        else:
            mean, information = se2.wrapped(numbers[:, :3]), _information(numbers[:, 3:], None)
        position = information[:, 2, 2] == 0.0
        kind = np.where(position, ObservedKind.POSITION, ObservedKind.GLOBAL_POSE)
        parts.append(ObservedNodes(node, offset, mean, information, kind))
    return ObservedNodes.joined(parts)


def _walk(poses: FloatArray, known: npt.NDArray[np.bool_], edges: Edges) -> None:
    """Give the nodes without a vertex a pose, along the edges, nearest in the walk first."""
    neighbours: dict[int, list[tuple[int, FloatArray]]] = {}
    for i, j, mean in zip(edges.i.tolist(), edges.j.tolist(), edges.mean, strict=True):
        neighbours.setdefault(i, []).append((j, mean))
        neighbours.setdefault(j, []).append((i, se2.inverse(mean)))
    known = known.copy()
    for seed in (*np.flatnonzero(known).tolist(), *range(len(known))):
        known[seed] = True
        front = [seed]
        while len(front) > 0:
            reached = []
            for node in front:
                for neighbour, mean in neighbours.get(node, ()):
                    if not known[neighbour]:
                        poses[neighbour] = se2.compose(poses[node], mean)
                        known[neighbour] = True
                        reached.append(neighbour)
            front = reached


def _fixed(path: Path, fixes: _Rows, ids: IntArray) -> list[int]:
    fixed = []
    for (name,), line in zip(fixes.ids, fixes.lines, strict=True):
        node = int(np.searchsorted(ids, name))
        if node == len(ids) or ids[node] != name:
            raise FileFormatError(f'{path}:{line}: FIX {name}: there is no such vertex')
        fixed.append(node)
    return fixed


def _culprit(
    path: Path, rows: dict[str, _Rows], ids: IntArray, edge2_order: str | None,
) -> str:
    """Find the first line whose row the graph refuses, by trying them one at a time."""
    lines = [(line, tag, k) for tag, table in rows.items() if not tag.startswith('VERTEX')
             for k, line in enumerate(table.lines)]
    for line, tag, k in sorted(lines):
        single = {name: _Rows(table.n_ids) for name, table in rows.items()}
        single[tag].ids, single[tag].numbers = [rows[tag].ids[k]], [rows[tag].numbers[k]]
        graph = Graph()
        graph.apply(GraphUpdate(hidden=np.zeros((len(ids), 3))))
        try:
            graph.apply(GraphUpdate(edges=_edges(single, ids, edge2_order),
                                    observed=_observed(single, ids)))
        except GraphUpdateError:
            return f'{path}:{line}'
    return str(path)


def write_g2o(graph: Graph, path: Path, ids: IntArray | None = None) -> None:
    """
    Write a graph; numbers read back bit for bit.

    Parameters
    ----------
    graph : Graph
    path : Path
    ids : ndarray, shape (N,), optional
        Id for each hidden node; their numbers if not given.

    """
    path.write_text(g2o_text(graph.rows(), ids), encoding='ascii')


def g2o_text(rows: GraphRows, ids: IntArray | None = None) -> str:
    """
    Return a graph as text: vertices, FIX, edges and observed nodes, in their order each.

    Parameters
    ----------
    rows : GraphRows
    ids : ndarray, shape (N,), optional
        Id for each hidden node; their numbers if not given.

    """
    ids = np.arange(len(rows.poses)) if ids is None else ids
    edges, observed, is_pose = rows.edges, rows.observed, ~rows.is_bias
    lines = []
    if not np.all(is_pose):
        edges = edges.rows(edges.kind != EdgeKind.BIAS)
        observed = observed.rows(is_pose[observed.node])
        lines.append(f'# left out: {np.sum(~is_pose)} biases, {len(rows.edges) - len(edges)} '
                     f'edges to them and {len(rows.observed) - len(observed)} observed ones')
    lines += [f'VERTEX_SE2 {name} {numbers}' for name, numbers in zip(
        ids[is_pose].tolist(), _texts(rows.poses[is_pose]), strict=True)]
    lines += [f'FIX {name}' for name in ids[rows.fixed & is_pose].tolist()]
    lines += [f'EDGE_SE2 {i} {j} {numbers}' for i, j, numbers in zip(
        ids[edges.i].tolist(), ids[edges.j].tolist(),
        _texts(np.hstack((edges.mean, upper(edges.information)))), strict=True)]
    return '\n'.join([*lines, *_observed_lines(observed, ids)]) + '\n'


def _observed_lines(observed: ObservedNodes, ids: IntArray) -> list[str]:
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
        lines[rows] = [f'{tag} {name} {text}' for name, text in zip(
            ids[observed.node[rows]].tolist(), _texts(np.hstack(columns)[rows]), strict=True)]
    return list(lines)


def _texts(rows: FloatArray) -> list[str]:
    """Return the numbers of each row, as many digits as it takes to read them back."""
    return [' '.join(map(repr, row)) for row in rows.tolist()]
