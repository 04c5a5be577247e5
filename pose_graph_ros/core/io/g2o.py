# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Planar graphs in the g2o text format.

Tags that are read and written, one per line:

    VERTEX_SE2 id x y theta
    FIX id ...
    EDGE_SE2 i j x y theta I11 I12 I13 I22 I23 I33
    VERTEX_XY id x y                                        a landmark
    EDGE_SE2_XY i j x y I11 I12 I22                         landmark j in the frame of i
    EDGE_RANGE_SE2_XY i j distance I11                      distance of landmark j from i
    EDGE_PRIOR_SE2 id x y theta I11 I12 I13 I22 I23 I33     a global pose
    EDGE_PRIOR_SE2_XY id x y I11 I12 I22                    a position
    OBSERVED_SE2_OFFSET id ox oy otheta x y theta I11 I12 I13 I22 I23 I33

The last tag is specific to this project, because g2o has no tag for an observed node with an
offset; other programs skip it with a warning.

Biases and the constraints on them have no tag, nor has a range from another point than the origin
of the robot. They are left out, and a comment gives their number; a measurement with a correlated
error is written as if its error were white. Constraints with weight 0, such as doubted loop
closures, are written as comments, `# not used EDGE_SE2 ...`, so that other programs read the graph
without them. Other weights are not written: the information
is that of the measurement.

A file keeps neither the order of observed nodes with different tags nor the kind of an edge. An
edge between consecutive ids is read as odometry, any other as a loop closure. Of each information
matrix the upper triangle is written.

The tags `VERTEX2` and `EDGE2` are used by two formats with different numbers: TORO orders the
information as 11 12 22 33 13 23, iSAM stores its square root as R11 R12 R13 R22 R23 R33. The
caller has to say which of them a file has. `VERTEX` and `EDGE` are TORO's old tags, `ODOMETRY` is
another one of iSAM's for `EDGE2`.

A loop closure with a switch, `EDGE_SE2_SWITCHABLE i j switch x y theta I11 ...`, is read as an
edge; its switch, `VERTEX_SWITCH` and `EDGE_SWITCH_PRIOR`, is not needed.

Lines with any other tag are skipped and counted: parameters of sensors, constraints in space. So
are the lines `EQUIV i j` of TORO: they allow it to merge two nodes that an edge of the file
connects, and add nothing to that edge.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from pose_graph_ros.core.exceptions import FileFormatError, GraphUpdateError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import (
    EdgeKind,
    Edges,
    NodeKind,
    ObservedKind,
    ObservedNodes,
)
from pose_graph_ros.core.graph.factor_types import FACTORS
from pose_graph_ros.core.graph.graph import Graph, GraphRows, GraphUpdate, NextIds

SWITCHES = ('VERTEX_SWITCH', 'EDGE_SWITCH_PRIOR')
# Formats of EDGE2.
EDGE2_ORDERS = ('toro', 'isam')
# Row and column of each of six numbers: of an upper triangle, and of the information in TORO.
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_TORO = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
# Tags with the format that the caller names, see `edge2_order`.
AMBIGUOUS = ('EDGE2', 'ODOMETRY')
# Kinds of edges to landmarks, that tell where the other end is, and with a tag of their own.
_TO_LANDMARKS = [kind for kind, factor in FACTORS.items() if factor.j == (NodeKind.LANDMARK,)]
_PLACING = [kind for kind, factor in FACTORS.items() if factor.places]
_OWN_TAGS = {kind: factor.tag for kind, factor in FACTORS.items()
             if factor.tag not in {'', 'EDGE_SE2'}}
# Numbers of ids and of values behind each tag; FIX is followed by any number of ids.
LAYOUT = {
    'VERTEX_SE2': (1, 3),
    'VERTEX2': (1, 3),
    'VERTEX': (1, 3),
    'EDGE_SE2': (2, 9),
    'EDGE2': (2, 9),
    'ODOMETRY': (2, 9),
    'EDGE': (2, 9),
    'EDGE_PRIOR_SE2': (1, 9),
    'EDGE_PRIOR_SE2_XY': (1, 5),
    'OBSERVED_SE2_OFFSET': (1, 12),
    'VERTEX_XY': (1, 2),
    **{tag: (2, len(FACTORS[kind].rows) * (len(FACTORS[kind].rows) + 3) // 2)
       for kind, tag in _OWN_TAGS.items()},
}


@dataclass(frozen=True, slots=True)
class GraphFile:
    """A graph that was read from a file."""

    graph: Graph
    ids: IntArray
    """Id in the file of each hidden node, shape (N,), increasing."""
    has_start: bool
    """Whether the file has the poses of all nodes; else missing ones were composed from edges."""
    skipped: dict[str, int]
    """Number of lines that were skipped, by their tag."""


class _Rows:
    """Rows with one tag: ids, values and line number of each."""

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
    Return the planar graph in a file, its hidden nodes in the order of their ids.

    Without `FIX` and without priors the node with the smallest id is fixed. The pose of a node
    without `VERTEX_SE2` is composed from edges, breadth-first from the nodes with a pose, else
    from the smallest id. Lines with tags that are not known are skipped. If the file is not such
    a graph, a FileFormatError names the file and the line, what was expected and what was found.

    Parameters
    ----------
    edge2_order : {'toro', 'isam'}, optional, format of `EDGE2` in this file, else ValueError

    """
    if edge2_order is not None and edge2_order not in EDGE2_ORDERS:
        raise ValueError(f'edge2_order: expected one of {EDGE2_ORDERS}, got {edge2_order!r}')
    rows = {tag: _Rows(n_ids) for tag, (n_ids, _) in LAYOUT.items()}
    fixes = _Rows(1)
    skipped: dict[str, list[list[str]]] = {}
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f'{path}: cannot be read as text ({error})') from error
    for line, content in enumerate(text.splitlines(), 1):
        words = content.split()
        if words[:1] == ['EDGE_SE2_SWITCHABLE']:
            words = ['EDGE_SE2', *words[1:3], *words[4:]]
        if len(words) == 0 or words[0].startswith('#') or words[0] in SWITCHES:
            continue
        where = f'{path}:{line}'
        if words[0] == 'FIX':
            for word in words[1:]:
                _add(where, fixes, [word], 'FIX', line)
        elif words[0] in rows:
            _read_line(where, words, rows, edge2_order, line)
        else:
            skipped.setdefault(words[0], []).append([str(line), *words[1:2]])
    _forget_landmarks(fixes, skipped)
    if all(len(table.lines) == 0 for table in rows.values()):
        _raise_empty(path, skipped)
    graph, ids, has_start = _build(path, rows, fixes, edge2_order)
    return GraphFile(graph, ids, has_start, {tag: len(found) for tag, found in skipped.items()})


def _forget_landmarks(fixes: _Rows, skipped: dict[str, list[list[str]]]) -> None:
    """Remove the FIX of vertices that were skipped."""
    names = {words[1] for tag, found in skipped.items() if tag.startswith('VERTEX')
             for words in found if len(words) > 1}
    kept = [k for k, (name,) in enumerate(fixes.ids) if str(name) not in names]
    fixes.ids, fixes.lines = [fixes.ids[k] for k in kept], [fixes.lines[k] for k in kept]


def _raise_empty(path: Path, skipped: dict[str, list[list[str]]]) -> NoReturn:
    for tag, found in skipped.items():
        raise FileFormatError(
            f'{path}:{found[0][0]}: tag {tag!r} is not known, and there is no line with one of '
            f'{", ".join(LAYOUT)}')
    raise FileFormatError(f'{path}: holds no vertex and no edge')


def _read_line(
    where: str, words: list[str], rows: dict[str, _Rows], edge2_order: str | None, line: int,
) -> None:
    tag, values = words[0], words[1:]
    if len(values) != sum(LAYOUT[tag]):
        raise FileFormatError(
            f'{where}: {tag} is followed by {sum(LAYOUT[tag])} numbers, got {len(values)}')
    if tag in AMBIGUOUS and edge2_order is None:
        raise FileFormatError(
            f'{where}: {tag} means two formats with the information in different order; '
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
) -> tuple[Graph, IntArray, bool]:
    vertices = _joined(rows['VERTEX_SE2'], rows['VERTEX2'], rows['VERTEX'])
    points = rows['VERTEX_XY']
    vertices.ids += points.ids
    vertices.numbers += [[*position, 0.0] for position in points.numbers]
    vertices.lines += points.lines
    ids = np.unique(np.concatenate([_ids(table).ravel() for table in rows.values()]))
    given, first = np.unique(_ids(vertices).ravel(), return_index=True)
    if len(given) < len(vertices.lines):
        again = sorted(set(range(len(vertices.lines))) - set(first.tolist()))[0]
        raise FileFormatError(f'{path}:{vertices.lines[again]}: vertex '
                              f'{vertices.ids[again][0]} is in the file twice')

    is_landmark = np.isin(ids, np.concatenate(
        (_ids(points)[:, 0], *(_ids(rows[FACTORS[kind].tag])[:, 1] for kind in _TO_LANDMARKS))))
    kind = np.where(is_landmark, NodeKind.LANDMARK, NodeKind.POSE)
    edges = _edges(rows, ids, edge2_order)
    observed = _observed(rows, ids)
    poses, known = np.zeros((len(ids), 3)), np.isin(ids, given)
    poses[known] = _numbers(vertices, 3)[first]
    if not np.all(known):
        compose_missing(poses, known, edges)
        poses[is_landmark, 2] = 0.0
    fixed = _fixed(path, fixes, ids)
    if len(fixed) == 0 and len(observed) == 0:
        fixed = [int(np.argmin(is_landmark))]
    try:
        graph = _graph(poses, kind)
        graph.apply(GraphUpdate(edges=edges, observed=observed, fix=fixed))
    except GraphUpdateError as error:
        raise FileFormatError(
            f'{_refused_line(path, rows, ids, edge2_order, kind)}: {error}') from error
    return graph, ids, bool(len(given) == len(ids))


def _graph(poses: FloatArray, kind: IntArray) -> Graph:
    """Return a graph of hidden nodes without constraints."""
    graph, n = Graph(), len(poses)
    graph.fill(GraphRows(
        poses, kind, np.zeros(n, dtype=bool), Edges(), ObservedNodes(), np.arange(n),
        np.empty(0, np.int64), np.empty(0, np.int64), NextIds(n, 0, 0)))
    return graph


def _joined(*tables: _Rows) -> _Rows:
    """Return the rows of all tables in one."""
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
    for tag, order in (('EDGE_SE2', None), ('EDGE', 'toro'),
                       *((tag, edge2_order) for tag in AMBIGUOUS)):
        numbers, ends = _numbers(rows[tag], 9), _ids(rows[tag])
        kind = np.where(np.diff(ends, axis=1)[:, 0] == 1, EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE)
        i, j = np.searchsorted(ids, ends).T
        parts.append(Edges(
            i, j, se2.wrapped(numbers[:, :3]), _information(numbers[:, 3:], order), kind))
    for each, tag in _OWN_TAGS.items():
        size = len(FACTORS[each].rows)
        numbers, ends = _numbers(rows[tag], LAYOUT[tag][1]), _ids(rows[tag])
        mean, information = np.zeros((len(ends), 3)), np.zeros((len(ends), 3, 3))
        mean[:, :size] = numbers[:, :size]
        for column, (row, col) in enumerate(zip(*np.triu_indices(size), strict=True), size):
            information[:, row, col] = information[:, col, row] = numbers[:, column]
        i, j = np.searchsorted(ids, ends).T
        parts.append(Edges(i, j, mean, information, np.full(len(ends), each)))
    return Edges.joined(parts)


def _information(numbers: FloatArray, order: str | None) -> FloatArray:
    """Return information matrices, shape (M, 3, 3), from six numbers each."""
    matrix = np.zeros((len(numbers), 3, 3))
    for column, (row, col) in enumerate(_TORO if order == 'toro' else UPPER):
        matrix[:, row, col] = numbers[:, column]
        if order != 'isam':
            matrix[:, col, row] = numbers[:, column]
    return np.swapaxes(matrix, 1, 2) @ matrix if order == 'isam' else matrix


def _observed(rows: dict[str, _Rows], ids: IntArray) -> ObservedNodes:
    parts = []
    for tag in ('EDGE_PRIOR_SE2', 'EDGE_PRIOR_SE2_XY', 'OBSERVED_SE2_OFFSET'):
        numbers = _numbers(rows[tag], LAYOUT[tag][1])
        node = np.searchsorted(ids, _ids(rows[tag])[:, 0])
        offset = np.zeros((len(node), 3))
        if tag == 'OBSERVED_SE2_OFFSET':
            offset, numbers = numbers[:, :3], numbers[:, 3:]
        if tag == 'EDGE_PRIOR_SE2_XY':
            # as a pose with zeros for the heading
            numbers = np.insert(numbers, (2, 4, 5, 5), 0.0, axis=1)
        information = _information(numbers[:, 3:], None)
        kind = np.where(
            information[:, 2, 2] == 0.0, ObservedKind.POSITION, ObservedKind.GLOBAL_POSE)
        parts.append(
            ObservedNodes(node, offset, se2.wrapped(numbers[:, :3]), information, kind))
    return ObservedNodes.joined(parts)


def compose_missing(poses: FloatArray, known: BoolArray, edges: Edges) -> None:
    """
    Set the poses of the nodes that are not known by composing edges, breadth-first.

    Parameters
    ----------
    poses : ndarray, shape (N, 3), is changed in place [m, m, rad]
    known : ndarray of bool, shape (N,); in a part without any, its first node stays
    edges : Edges

    """
    neighbours: dict[int, list[tuple[int, FloatArray]]] = {}
    placing = edges.rows(np.isin(edges.kind, _PLACING))
    for i, j, mean, kind in zip(placing.i.tolist(), placing.j.tolist(), placing.mean,
                                placing.kind.tolist(), strict=True):
        neighbours.setdefault(i, []).append((j, mean))
        if kind not in _TO_LANDMARKS:
            neighbours.setdefault(j, []).append((i, se2.inverse(mean)))
    known = known.copy()
    for start in (*np.flatnonzero(known).tolist(), *range(len(known))):
        known[start] = True
        frontier = [start]
        while len(frontier) > 0:
            reached = []
            for node in frontier:
                for neighbour, mean in neighbours.get(node, ()):
                    if not known[neighbour]:
                        poses[neighbour] = se2.compose(poses[node], mean)
                        known[neighbour] = True
                        reached.append(neighbour)
            frontier = reached


def _fixed(path: Path, fixes: _Rows, ids: IntArray) -> list[int]:
    fixed = []
    for (name,), line in zip(fixes.ids, fixes.lines, strict=True):
        node = int(np.searchsorted(ids, name))
        if node == len(ids) or ids[node] != name:
            raise FileFormatError(f'{path}:{line}: FIX {name}: there is no such vertex')
        fixed.append(node)
    return fixed


def _refused_line(
    path: Path, rows: dict[str, _Rows], ids: IntArray, edge2_order: str | None, kind: IntArray,
) -> str:
    """Return file and number of the first line whose row the graph refuses, tried one by one."""
    lines = [(line, tag, k) for tag, table in rows.items() if not tag.startswith('VERTEX')
             for k, line in enumerate(table.lines)]
    for line, tag, k in sorted(lines):
        single = {name: _Rows(table.n_ids) for name, table in rows.items()}
        single[tag].ids, single[tag].numbers = [rows[tag].ids[k]], [rows[tag].numbers[k]]
        graph = _graph(np.zeros((len(ids), 3)), kind)
        try:
            graph.apply(GraphUpdate(edges=_edges(single, ids, edge2_order),
                                    observed=_observed(single, ids)))
        except GraphUpdateError:
            return f'{path}:{line}'
    return str(path)
