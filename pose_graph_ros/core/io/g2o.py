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
information as 11 12 22 33 13 23, iSAM stores its square root as R11 R12 R13 R22 R23 R33.
`read_guessed` finds out which of them a file has. `VERTEX` and `EDGE` are TORO's old tags,
`ODOMETRY` is another one of iSAM's for `EDGE2`. iSAM's `LANDMARK i l x y R11 R12 R22` is read as
`EDGE_SE2_XY`, with the square root of the information (M. Kaess, iSAM 1.7, `Loader.cpp`).
Landmarks have their own numbers there, so they get others if a pose has one of these.

A loop closure with a switch, `EDGE_SE2_SWITCHABLE i j switch x y theta I11 ...`, is read as an
edge; its switch, `VERTEX_SWITCH` and `EDGE_SWITCH_PRIOR`, is not needed.

Lines with any other tag are skipped and counted: parameters of sensors, constraints in space. So
are the lines `EQUIV i j` of TORO: they allow it to merge two nodes that an edge of the file
connects, and add nothing to that edge. A file may be compressed by gzip.
"""

from dataclasses import dataclass, replace
from functools import cached_property
import math
from pathlib import Path
from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from pose_graph_ros.core.config import SolverConfig
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.checks import check, RowError, scaled
from pose_graph_ros.core.graph.constraints import (
    FactorKind,
    FACTORS,
    Factors,
    NodeKind,
)
from pose_graph_ros.core.graph.graph_update import GraphRows, NextIds
from pose_graph_ros.core.io.g2o_text import (
    AMBIGUOUS,
    GraphText,
    Lines,
    OWN_TAGS,
    read_lines,
)

if TYPE_CHECKING:
    from pose_graph_ros.core.graph.graph import Graph

# Formats of EDGE2.
EDGE2_ORDERS = ('toro', 'isam')
# Row and column of each of the six numbers of the information in TORO.
_TORO = ((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2))
# Kinds of edges to landmarks, that tell where the other end is.
_TO_LANDMARKS = [kind for kind, factor in FACTORS.items() if factor.j == (NodeKind.LANDMARK,)]
_PLACING = [kind for kind, factor in FACTORS.items() if factor.places]
_POINT = OWN_TAGS[FactorKind.POINT]
_EDGES = ('EDGE_SE2', 'EDGE', *AMBIGUOUS, *OWN_TAGS.values())
OBSERVED = ('EDGE_PRIOR_SE2', 'EDGE_PRIOR_SE2_XY', 'OBSERVED_SE2_OFFSET')


@dataclass
class GraphFile:
    """A graph that was read from a file."""

    rows: GraphRows
    ids: IntArray  # id in the file of each hidden node, increasing
    has_start: bool  # whether the file has the poses of all nodes; else missing ones were composed
    skipped: dict[str, int]  # number of lines that were skipped, by their tag
    notes: tuple[str, ...] = ()  # sentences about what was read otherwise than it is in the file

    @cached_property
    def graph(self) -> 'Graph':
        """The graph for the solvers, made at first use: that loads the compiled kernels."""
        from pose_graph_ros.core.graph.graph import Graph  # noqa: PLC0415

        graph = Graph()
        graph.fill(self.rows)
        return graph


def read_g2o(path: Path, edge2_order: str | None = None) -> GraphFile:
    """
    Return the planar graph in a file, its hidden nodes in the order of their ids.

    Without `FIX` and without priors the node with the smallest id is fixed. The pose of a node
    without `VERTEX_SE2` is composed from edges, breadth-first from the nodes with a pose, else
    from the smallest id. Lines with tags that are not known are skipped. If the file is not such
    a graph, a FileFormatError names the file and the line, what was expected and what was found.
    `edge2_order` is the format of `EDGE2` in this file, one of `EDGE2_ORDERS`.
    """
    if edge2_order is not None and edge2_order not in EDGE2_ORDERS:
        raise ValueError(f'edge2_order: expected one of {EDGE2_ORDERS}, got {edge2_order!r}')
    return graph_of(read_lines(path), edge2_order)


def graph_of(text: GraphText, edge2_order: str | None = None) -> GraphFile:
    """Return the graph in the lines of a file, as `read_g2o` does."""
    ambiguous = [(int(text.rows[tag].lines[0]), tag) for tag in AMBIGUOUS if len(text.rows[tag])]
    if edge2_order is None and len(ambiguous) > 0:
        line, tag = min(ambiguous)
        raise FileFormatError(
            f'{text.where(line)}: {tag} means two formats with the information in different '
            f'order; say which this is: {" or ".join(EDGE2_ORDERS)}')
    rows, loops = _without_loops(text.rows)
    vertices = Lines.joined(rows[tag] for tag in ('VERTEX_SE2', 'VERTEX2', 'VERTEX'))
    points = rows['VERTEX_XY']
    vertices = Lines.joined((vertices, Lines(points.ids, np.pad(
        points.numbers, ((0, 0), (0, 1))), points.lines)))
    rows[_POINT], notes = _with_landmarks(text, rows)
    notes = (*loops, *notes)
    # with an index, as NumPy loads its masked arrays otherwise, which takes 7 ms
    ids, _ = np.unique(np.concatenate([table.ids.ravel() for tag, table in rows.items()
                                       if tag != 'LANDMARK']), return_index=True)
    given, first = np.unique(vertices.ids.ravel(), return_index=True)
    if len(given) < len(vertices):
        again = np.setdiff1d(np.arange(len(vertices)), first)[0]
        raise FileFormatError(f'{text.where(vertices.lines[again])}: vertex '
                              f'{vertices.ids[again, 0]} is in the file twice')
    is_landmark = np.isin(ids, np.concatenate((
        points.ids[:, 0], *(rows[FACTORS[kind].tag].ids[:, 1] for kind in _TO_LANDMARKS))))
    kind = np.where(is_landmark, NodeKind.LANDMARK, NodeKind.POSE)
    factors = Factors.joined([
        _with_rows(Factors.joined(tables), ids, ends) for tables, ends in (
            ([edges_of(tag, rows[tag], edge2_order) for tag in _EDGES], 'ij'),
            ([observed_of(tag, rows[tag]) for tag in OBSERVED], 'i'))])
    try:
        check(factors, kind)
    except RowError as error:
        line = np.concatenate([rows[tag].lines for tag in (*_EDGES, *OBSERVED)])[error.row]
        raise FileFormatError(f'{text.where(line)}: {error}') from error
    poses, known = np.zeros((len(ids), 3)), np.isin(ids, given)
    poses[known] = vertices.numbers[first]
    if not np.all(known):
        compose_missing(poses, known, factors)
        poses[is_landmark, 2] = 0.0
    if not np.all(np.isfinite(poses)):
        raise FileFormatError(f'{text.path}: poses composed from edges are not finite')
    fixed = _fixed(text, ids)
    if not np.any(fixed) and np.all(factors.j >= 0):
        fixed[np.argmin(is_landmark)] = True
    n = len(ids)
    graph = GraphRows(
        se2.wrapped(poses), kind, fixed, factors, np.arange(n), np.arange(len(factors)),
        NextIds(n, len(factors)))
    return GraphFile(graph, ids, bool(len(given) == n), text.skipped, notes)


def _without_loops(rows: dict[str, Lines]) -> tuple[dict[str, Lines], tuple[str, ...]]:
    """Return lines without edges from a node to itself, which tell nothing, and a note of them."""
    kept, n = dict(rows), 0
    for tag, table in rows.items():
        if table.ids.shape[1] == 2 and tag != 'LANDMARK':
            loop = table.ids[:, 0] == table.ids[:, 1]
            if np.any(loop):
                n += int(np.sum(loop))
                kept[tag] = table.rows(np.flatnonzero(~loop))
    return kept, () if n == 0 else (f'{n} edges from a node to itself are skipped',)


def _with_landmarks(
    text: GraphText, rows: dict[str, Lines],
) -> tuple[Lines, tuple[str, ...]]:
    """Return the lines of `EDGE_SE2_XY` with those of `LANDMARK`, and a note of other numbers."""
    seen = rows['LANDMARK']
    if len(seen) == 0:
        return rows[_POINT], ()
    ids = seen.ids.copy()
    others = np.unique(np.concatenate(
        [table.ids.ravel() for tag, table in rows.items() if tag != 'LANDMARK']
        + [ids[:, 0], text.fixes.ids.ravel()]))
    notes: tuple[str, ...] = ()
    if np.any(np.isin(ids[:, 1], others)):
        first = max(int(np.max(others)), 0) + 1 - min(int(np.min(ids[:, 1])), 0)
        if first + int(np.max(ids[:, 1])) > np.iinfo(np.int64).max:
            raise FileFormatError(f'{text.where(seen.lines[0])}: LANDMARK: the ids are too large')
        ids[:, 1] += first
        notes = (f'landmark 0 of iSAM is node {first} here, 1 is {first + 1} and so on, as poses '
                 f'have the same numbers',)
    a, b, c = seen.numbers[:, 2:].T
    numbers = np.column_stack((seen.numbers[:, :2], a * a, a * b, b * b + c * c))
    return Lines.joined((rows[_POINT], Lines(ids, numbers, seen.lines))), notes


def edges_of(tag: str, lines: Lines, edge2_order: str | None = None) -> Factors:
    """Return the edges of a tag; their ends are ids of the file."""
    i, j = lines.ids.T
    order = {'EDGE': 'toro'}.get(tag, edge2_order if tag in AMBIGUOUS else None)
    # the next id; a difference could overflow
    kind = np.where(j == i + 1, FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE)
    for own, own_tag in OWN_TAGS.items():
        if tag == own_tag:
            kind[:] = own
    return Factors(i, j, *_measured(lines.numbers, order), kind)


def observed_of(tag: str, lines: Lines) -> Factors:
    """Return the observed nodes of a tag; their nodes are ids of the file."""
    numbers, offset = lines.numbers, None
    if tag == 'OBSERVED_SE2_OFFSET':
        offset, numbers = numbers[:, :3], numbers[:, 3:]
    mean, information = _measured(numbers)
    kind = np.where(
        information[:, 2, 2] == 0.0, FactorKind.POSITION, FactorKind.GLOBAL_POSE)
    return Factors.on(lines.ids[:, 0], offset, mean, information, kind)


def _measured(numbers: FloatArray, order: str | None = None) -> tuple[FloatArray, FloatArray]:
    """Return means and information matrices from the 2, 5 or 9 numbers for 1 to 3 coordinates."""
    size = {2: 1, 5: 2, 9: 3}[numbers.shape[1]]
    mean, matrix = np.zeros((len(numbers), 3)), np.zeros((len(numbers), 3, 3))
    mean[:, :size] = numbers[:, :size]
    row, column = np.transpose(_TORO) if order == 'toro' else np.triu_indices(size)
    matrix[:, row, column] = numbers[:, size:]
    if order == 'isam':
        return mean, np.swapaxes(matrix, 1, 2) @ matrix
    matrix[:, column, row] = numbers[:, size:]
    return mean, matrix


def _with_rows(table: Factors, ids: IntArray, ends: str) -> Factors:
    """Return factors with rows in place of ids of the file, and headings wrapped."""
    # these ids may be negative
    columns = {end: np.searchsorted(ids, getattr(table, end)).astype(np.int64) for end in ends}
    return replace(table, mean=se2.wrapped(table.mean), **columns)


def compose_missing(poses: FloatArray, known: BoolArray, factors: Factors) -> None:
    """
    Set the poses of the nodes that are not known by composing edges, breadth-first.

    In a part without any that is known, its first node stays.
    """
    neighbours: dict[int, list[tuple[int, list[float]]]] = {}
    placing = factors.rows(np.isin(factors.kind, _PLACING))
    for i, j, forward, backward, kind in zip(
            placing.i.tolist(), placing.j.tolist(), placing.mean.tolist(),
            se2.inverse(placing.mean).tolist(), placing.kind.tolist(), strict=True):
        neighbours.setdefault(i, []).append((j, forward))
        if kind not in _TO_LANDMARKS:
            neighbours.setdefault(j, []).append((i, backward))
    # Python's numbers, as NumPy takes several times as long for a single pose
    found, reached = poses.tolist(), known.tolist()
    for start in (*np.flatnonzero(known).tolist(), *range(len(known))):
        reached[start] = True
        frontier = [start]
        while len(frontier) > 0:
            further = []
            for node in frontier:
                for neighbour, mean in neighbours.get(node, ()):
                    if not reached[neighbour]:
                        found[neighbour] = _composed(found[node], mean)
                        reached[neighbour] = True
                        further.append(neighbour)
            frontier = further
    poses[:] = found


def _composed(pose: list[float], motion: list[float]) -> list[float]:
    """Return the pose after a motion [m, m, rad], its heading not wrapped."""
    if not math.isfinite(pose[2]):
        return [math.nan] * 3
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return [pose[0] + c * motion[0] - s * motion[1], pose[1] + s * motion[0] + c * motion[1],
            math.remainder(pose[2] + motion[2], math.tau)]


def _fixed(text: GraphText, ids: IntArray) -> BoolArray:
    """Return which nodes are fixed."""
    fixed, names = np.zeros(len(ids), dtype=bool), text.fixes.ids.ravel()
    rows = np.minimum(np.searchsorted(ids, names), len(ids) - 1)
    missing = np.flatnonzero(ids[rows] != names)
    if len(missing) > 0:
        raise FileFormatError(f'{text.where(text.fixes.lines[missing[0]])}: FIX '
                              f'{names[missing[0]]}: there is no such vertex')
    fixed[rows] = True
    return fixed


class Guess(NamedTuple):
    """A graph that was read, with what was guessed of its format."""

    file: GraphFile
    order: str | None  # of `EDGE2_ORDERS`; None if the file has no tag with two meanings
    reason: str  # why this order; empty without a guess


def read_guessed(path: Path) -> Guess:
    """
    Return the planar graph in a file as `read_g2o` does, its order found out if need be.

    Read in the other's order, a file without correlations has the number for one coordinate in the
    place of a correlation, so that a matrix is singular or indefinite. If all matrices are
    positive definite in both orders, the graph is optimised with each. Then the one is kept with
    which energies differ less, as measured by the mean over the median, whatever the unit of the
    information is. Raises FileFormatError, with what is wrong in TORO's order, if neither can be
    read.
    """
    text = read_lines(path)
    if not any(len(text.rows[tag]) for tag in AMBIGUOUS):
        return Guess(graph_of(text), None, '')
    files: dict[str, GraphFile] = {}
    errors: dict[str, FileFormatError] = {}
    for order in EDGE2_ORDERS:
        try:
            files[order] = graph_of(text, order)
        except FileFormatError as error:
            errors[order] = error
    if len(files) == 0:
        raise errors[EDGE2_ORDERS[0]]
    if len(text.rows['LANDMARK']) > 0 and 'isam' in files:
        return Guess(files['isam'], 'isam', 'LANDMARK is a tag of iSAM')
    worst = {order: _smallest(file.rows) for order, file in files.items()}
    definite = [order for order, value in worst.items() if value > 1e-9]
    if len(definite) == 1:
        other = next(order for order in EDGE2_ORDERS if order != definite[0])
        return Guess(files[definite[0]], definite[0], (
            f'in the order of {other} not all information matrices are positive definite'))
    if len(files) == 1:
        order, = files
        return Guess(files[order], order, 'the other order is refused')
    spread = {order: _spread(file.rows) for order, file in files.items()}
    order = min(EDGE2_ORDERS, key=lambda each: spread[each])
    other = next(each for each in EDGE2_ORDERS if each != order)
    return Guess(files[order], order, (
        f'at the optimum the mean energy of an edge is {spread[order]:.3g} times the median, in '
        f'the order of {other} {spread[other]:.3g} times'))


def _smallest(rows: GraphRows) -> float:
    """Return the smallest eigenvalue of an information matrix, its diagonal scaled to 1."""
    return float(np.min(np.linalg.eigvalsh(scaled(rows.factors.edges.information)), initial=1.0))


def _spread(rows: GraphRows) -> float:
    """Return the mean over the median of the energies of edges at the optimum."""
    # loads the compiled kernels
    from pose_graph_ros.core.batch.optimizer import optimize_from_linear_start  # noqa: PLC0415
    from pose_graph_ros.core.graph.graph import Graph  # noqa: PLC0415

    copy = Graph()
    copy.fill(rows)
    optimize_from_linear_start(copy, SolverConfig())
    energies = copy.energies().factors[rows.factors.j >= 0]
    median = float(np.median(energies))
    return float(np.mean(energies)) / median if median > 0.0 else np.inf
