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
Which of them a file has is found out unless it is said. `VERTEX` and `EDGE` are TORO's old tags,
`ODOMETRY` is another one of iSAM's for `EDGE2`. iSAM's `LANDMARK i l x y R11 R12 R22` is read as
`EDGE_SE2_XY`, with the square root of the information (M. Kaess, iSAM 1.7, `Loader.cpp`).
Landmarks have their own numbers there, so they get others if a pose has one of these.

A loop closure with a switch, `EDGE_SE2_SWITCHABLE i j switch x y theta I11 ...`, is read as an
edge; its switch, `VERTEX_SWITCH` and `EDGE_SWITCH_PRIOR`, is not needed.

Lines with any other tag are skipped and counted: parameters of sensors, constraints in space. So
are the lines `EQUIV i j` of TORO: they allow it to merge two nodes that an edge of the file
connects, and add nothing to that edge. A file may be compressed by gzip.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, compose_one, FloatArray, IntArray, Pose
from pose_graph_ros.core.graph.checks import are_definite, check, RowError
from pose_graph_ros.core.graph.constraints import FactorKind, FACTORS, Factors, NodeKind
from pose_graph_ros.core.graph.graph_update import GraphRows, NextIds
from pose_graph_ros.core.io import g2o_text as gt

if TYPE_CHECKING:
    from pose_graph_ros.core.batch.plain_optimizer import PlainGraph
    from pose_graph_ros.core.graph.graph import Graph

# Formats of EDGE2.
EDGE2_ORDERS = ('toro', 'isam')
# Row and column of each of the six numbers of the information in TORO.
_TORO = (0, 0, 1, 2, 0, 1), (0, 1, 1, 2, 2, 2)
# Kinds of edges to landmarks, that tell where the other end is.
_TO_LANDMARKS = [kind for kind, factor in FACTORS.items() if factor.j == (NodeKind.LANDMARK,)]
_PLACING = [kind for kind, factor in FACTORS.items() if factor.places]
NOT_USED = '# not used '
"""Begin of the line of a constraint with weight 0."""
STANDING_FOR = '# instead of '
"""Begin of lines behind which is nothing but what stands for that which g2o does not have."""
_BLOCK = 1 << 14    # lines that are made at once


@dataclass
class GraphFile:
    """A graph that was read from a file."""

    rows: GraphRows
    ids: IntArray  # id in the file of each hidden node, increasing
    # whether the file has the poses of all nodes; else missing ones were composed
    has_start: bool = True
    # number of lines that were skipped, by their tag
    skipped: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # sentences about what was read otherwise than it is in the file
    edge2_order: str | None = None  # of `EDGE2_ORDERS`, as it was said or found out
    found_by: str = ''  # why this order, if it was found out

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

    `edge2_order` is the format of `EDGE2` in this file, one of `EDGE2_ORDERS`. By default both are
    tried. Read in the other's order, a file without correlations has the number for one coordinate
    in the place of a correlation, so that a matrix is singular or indefinite. If all matrices are
    positive definite in both orders, the graph is optimised with each. Then the one is kept with
    which energies differ less, as measured by the mean over the median, whatever the unit of the
    information is. If neither can be read, the error is that in TORO's order.
    """
    if edge2_order is not None and edge2_order not in EDGE2_ORDERS:
        raise ValueError(f'edge2_order: expected one of {EDGE2_ORDERS}, got {edge2_order!r}')
    text = gt.read(path)
    if edge2_order is not None or not any(len(text.rows[tag]) for tag in gt.AMBIGUOUS):
        return _graph_of(text, edge2_order)
    files: dict[str, GraphFile] = {}
    refused: list[FileFormatError] = []
    for order in EDGE2_ORDERS:
        try:
            files[order] = _graph_of(text, order)
        except FileFormatError as error:
            refused.append(error)
    if len(files) == 0:
        raise refused[0]
    order, why = ('isam', 'LANDMARK is a tag of iSAM') if (
        len(text.rows['LANDMARK']) > 0 and 'isam' in files) else _likelier(files)
    return replace(files[order], found_by=why)


def _likelier(files: dict[str, GraphFile]) -> tuple[str, str]:
    """Return in which order the numbers of a file make more sense, and why."""
    definite = [order for order, file in files.items()
                if np.all(are_definite(file.rows.factors.edges.information))]
    if len(definite) == 1:
        other = next(order for order in EDGE2_ORDERS if order != definite[0])
        return definite[0], (
            f'in the order of {other} not all information matrices are positive definite')
    if len(files) == 1:
        return next(iter(files)), 'the other order is refused'
    spread = {order: _spread(file) for order, file in files.items()}
    order, other = sorted(EDGE2_ORDERS, key=lambda each: spread[each])
    return order, (f'at the optimum the mean energy of an edge is {spread[order]:.3g} times the '
                   f'median, in the order of {other} {spread[other]:.3g} times')


def _spread(file: GraphFile) -> float:
    """Return the mean over the median of the energies of edges at the optimum."""
    # loads the compiled kernels
    from pose_graph_ros.core.batch.optimizer import optimize_from_linear_start  # noqa: PLC0415
    from pose_graph_ros.core.config import SolverConfig  # noqa: PLC0415

    # another graph than the one that is returned, with the rows as they were read
    optimize_from_linear_start(file.graph, SolverConfig())
    energies = file.graph.energies().factors[file.rows.factors.j >= 0]
    median = float(np.median(energies))
    return float(np.mean(energies)) / median if median > 0.0 else np.inf


def _graph_of(text: gt.GraphText, edge2_order: str | None) -> GraphFile:
    """Return the graph in the lines of a file."""
    rows, order = dict(text.rows), edge2_order or ''
    # edges from a node to itself tell nothing
    n_loops, loops = 0, tuple[str, ...]()
    for tag, table in text.rows.items():
        if gt.TAGS[tag].n_ids == 2 and tag != 'LANDMARK':
            is_loop = table['ids'][:, 0] == table['ids'][:, 1]
            if np.any(is_loop):
                n_loops, rows[tag] = n_loops + int(np.sum(is_loop)), table[~is_loop]
    if n_loops > 0:
        loops = (f'{n_loops} edges from a node to itself are skipped',)
    rows['LANDMARK'], notes = _numbered(text, rows)
    vertices = [rows[tag] for tag in ('VERTEX_SE2', 'VERTEX2', 'VERTEX', 'VERTEX_XY')]
    names, lines = (np.concatenate([table[name].ravel() for table in vertices])
                    for name in ('ids', 'line'))
    # with an index, as NumPy loads its masked arrays otherwise, which takes 7 ms
    ids, _ = np.unique(np.concatenate([
        table['ids'].ravel() for tag, table in rows.items() if tag != 'FIX']), return_index=True)
    if len(ids) == 0:
        raise FileFormatError(
            f'{text.path}: all edges lead from a vertex to itself, and no vertex is given')
    given, first = np.unique(names, return_index=True)
    if len(given) < len(names):
        again = np.setdiff1d(np.arange(len(names)), first)[0]
        raise FileFormatError(
            f'{text.where(lines[again])}: vertex {names[again]} is in the file twice')
    factors = Factors.joined([
        factors_of(tag, rows[tag], order if tag in gt.AMBIGUOUS else '', ids)
        for tag in gt.MEASURED if len(rows[tag]) > 0])
    is_landmark = np.isin(ids, rows['VERTEX_XY']['ids'])
    is_landmark[factors.j[np.isin(factors.kind, _TO_LANDMARKS)]] = True
    kind = np.where(is_landmark, NodeKind.LANDMARK, NodeKind.POSE)
    try:
        check(factors, kind)
    except RowError as error:
        line = np.concatenate([rows[tag]['line'] for tag in gt.MEASURED])[error.row]
        raise FileFormatError(f'{text.where(line)}: {error}') from error
    poses, known = np.zeros((len(ids), 3)), np.isin(ids, given)
    poses[known] = np.concatenate([np.pad(table['numbers'], (
        (0, 0), (0, 3 - table['numbers'].shape[1]))) for table in vertices])[first]
    if not np.all(known):
        compose_missing(poses, known, factors)
        poses[is_landmark, 2] = 0.0
    if not np.all(np.isfinite(poses)):
        raise FileFormatError(f'{text.path}: poses composed from edges are not finite')
    fixed, held = np.zeros(len(ids), dtype=bool), text.rows['FIX']['ids'].ravel()
    places = np.minimum(np.searchsorted(ids, held), len(ids) - 1)
    missing = np.flatnonzero(ids[places] != held)
    if len(missing) > 0:
        where = text.where(text.rows['FIX']['line'][missing[0]])
        raise FileFormatError(f'{where}: FIX {held[missing[0]]}: there is no such vertex')
    fixed[places] = True
    if len(ids) > 0 and not np.any(fixed) and np.all(factors.j >= 0):
        fixed[np.argmin(is_landmark)] = True
    n = len(ids)
    graph = GraphRows(
        se2.wrapped(poses), kind, fixed, factors, np.arange(n), np.arange(len(factors)),
        NextIds(n, len(factors)), np.where(is_landmark, 2, 3))
    return GraphFile(
        graph, ids, bool(len(given) == n), text.skipped, (*loops, *notes), edge2_order)


def _numbered(text: gt.GraphText, rows: dict[str, gt.Lines]) -> tuple[gt.Lines, tuple[str, ...]]:
    """Return the lines of `LANDMARK`, landmarks with other numbers than poses, and a note."""
    seen = rows['LANDMARK']
    if len(seen) == 0:
        return seen, ()
    others = np.unique(np.concatenate([
        (table['ids'][:, 0] if tag == 'LANDMARK' else table['ids']).ravel()
        for tag, table in rows.items()]))
    names = seen['ids'][:, 1]
    if not np.any(np.isin(names, others)):
        return seen, ()
    first = max(int(np.max(others)), 0) + 1 - min(int(np.min(names)), 0)
    if first + int(np.max(names)) > np.iinfo(np.int64).max:
        raise FileFormatError(f'{text.where(seen[0]["line"])}: LANDMARK: the ids are too large')
    moved = seen.copy()
    moved['ids'][:, 1] += first
    return moved, (
        f'landmark 0 of iSAM is node {first} here, 1 is {first + 1} and so on, as poses have the '
        f'same numbers',)


def factors_of(tag: str, lines: gt.Lines, order: str = '', ids: IntArray | None = None) -> Factors:
    """
    Return the factors in the lines of a tag.

    Their ends are ids of the file, or the places of these among the sorted ids of all nodes.
    """
    layout, n, size = gt.TAGS[tag], len(lines), gt.TAGS[tag].rows
    order, begin = order or layout.order, 3 * layout.has_offset
    mean, information, constants = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 4))
    constants[:, :begin] = lines['numbers'][:, :begin]
    mean[:, :size] = lines['numbers'][:, begin:begin + size]
    row, column = _TORO if order == 'toro' else np.triu_indices(size)
    information[:, row, column] = lines['numbers'][:, begin + size:]
    if order == 'isam':
        information = np.swapaxes(information, 1, 2) @ information
    else:
        information[:, column, row] = information[:, row, column]
    names = lines['ids']
    ends = names if ids is None else np.searchsorted(ids, names).astype(np.int64)
    if layout.n_ids == 1:
        i, j, kind = ends[:, 0], np.full(n, -1), np.where(
            information[:, 2, 2] == 0.0, FactorKind.POSITION, FactorKind.GLOBAL_POSE)
    else:
        # the next id; a difference could overflow
        i, j, kind = *ends.T, np.where(
            names[:, 1] == names[:, 0] + 1, FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE)
    if layout.kind is not None:
        kind[:] = layout.kind
    return Factors(i, j, mean if ids is None else se2.wrapped(mean), information, kind,
                   constants=constants)


def compose_missing(poses: FloatArray, known: BoolArray, factors: Factors) -> None:
    """
    Set the poses of the nodes that are not known by composing edges, breadth-first.

    In a part without any that is known, its first node stays.
    """
    neighbours: dict[int, list[tuple[int, Pose]]] = {}
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
                        found[neighbour] = compose_one(found[node], mean)
                        reached[neighbour] = True
                        further.append(neighbour)
            frontier = further
    poses[:] = found


def write_g2o(graph: 'Graph | PlainGraph', path: Path, ids: IntArray | None = None) -> None:
    """
    Write a graph so that its numbers read back bit for bit.

    `ids` are numbers of the hidden nodes, by default their ids.
    """
    with path.open('w', encoding='ascii') as file:
        file.writelines(_parts(graph.rows(), ids))


def g2o_text(rows: GraphRows, ids: IntArray | None = None) -> str:
    """
    Return the text of a g2o file: vertices, FIX, edges and observed nodes, each in their order.

    Edges and observed nodes that tell about the same as calibrated odometry and dense priors are
    the last lines. `ids` are numbers of the hidden nodes, by default their ids.
    """
    return ''.join(_parts(rows, ids))


def _parts(rows: GraphRows, ids: IntArray | None) -> Iterator[str]:
    """Yield the text in parts, so that not all of its lines are objects at once."""
    ids = rows.node_ids if ids is None else ids
    factors = rows.factors
    used = factors.weight > 0.0
    # a measurement with a correlated error has weight 0; an edge from its node to a bias holds it
    to_bias = factors.rows((factors.kind == FactorKind.BIAS) & used)
    held = set(zip(to_bias.i.tolist(), *to_bias.mean[:, :2].T.tolist(), strict=True))
    for k in np.flatnonzero(~used & (factors.j < 0)).tolist() if len(held) > 0 else ():
        used[k] = (int(factors.i[k]), *factors.mean[k, :2].tolist()) in held
    is_edge, n_biases = factors.j >= 0, int(np.sum(rows.is_bias))
    written = np.where(
        is_edge, np.isin(factors.kind, [kind for kind in FACTORS if FACTORS[kind].tag])
        & ~np.any(factors.constants, axis=1) & (factors.k < 0),
        ~rows.is_bias[rows.rows_of(factors.i)])
    calibrated = (factors.kind == FactorKind.ODOMETRY) & (factors.k >= 0)
    n_edges = np.sum(is_edge & ~written & ~calibrated)
    if n_edges > 0 or n_biases > 0:
        yield (f'# left out: {n_biases} biases, {n_edges} edges that g2o does not have and '
               f'{np.sum(~is_edge & ~written)} observed biases\n')
    is_landmark = ~rows.is_pose & ~rows.is_bias
    for tag, is_written in (('VERTEX_SE2', rows.is_pose), ('VERTEX_XY', is_landmark)):
        for some in _blocks(np.flatnonzero(is_written)):
            yield ''.join(_lines([tag] * len(some), ids[some, None],
                                 rows.poses[some, :gt.TAGS[tag].rows]))
    yield ''.join(f'FIX {name}\n' for name in ids[rows.fixed & ~rows.is_bias].tolist())
    for edges in (is_edge, ~is_edge):
        for some in _blocks(np.flatnonzero(written & edges)):
            yield _factor_lines(factors.rows(some).renumbered(rows.rows_of), ids, used[some])
    if np.any(calibrated):
        # what it needs takes long to load as well
        from pose_graph_ros.core.odometry.motion import as_calibrated  # noqa: PLC0415
        instead = as_calibrated(
            factors.rows(calibrated).renumbered(rows.rows_of), rows.poses)
        yield (f'{STANDING_FOR}odometry with a bias and an error of the scale: {len(instead)} '
               f'lines\n')
        yield _factor_lines(instead, ids, used[calibrated])
    if len(rows.priors) > 0:
        # takes long to load, and most graphs have none
        from pose_graph_ros.core.marginalization.marginalize import standing_for  # noqa: PLC0415
        instead = standing_for(rows).renumbered(rows.rows_of)
        yield (f'{STANDING_FOR}dense priors, which g2o does not have, of which there are '
               f'{len(rows.priors)}: {len(instead)} lines\n')
        yield _factor_lines(instead, ids, np.ones(len(instead), dtype=bool))


def _blocks(rows: IntArray) -> list[IntArray]:
    return np.split(rows, np.arange(_BLOCK, len(rows), _BLOCK))


def _factor_lines(factors: Factors, ids: IntArray, used: BoolArray) -> str:
    """Return a line for each factor, those of edges first, given which of them are used."""
    moved = np.any(factors.offset != 0.0, axis=1)
    placed = np.all(factors.information[:, 2] == 0.0, axis=1) & (factors.mean[:, 2] == 0.0)
    tags = np.where(factors.j >= 0, np.array([factor.tag for factor in FACTORS.values()])[
        factors.kind], np.where(moved, 'OBSERVED_SE2_OFFSET', np.where(
            placed, 'EDGE_PRIOR_SE2_XY', 'EDGE_PRIOR_SE2')))
    lines = np.empty(len(factors), dtype=object)
    for tag in sorted(set(tags.tolist())):
        layout, chosen = gt.TAGS[tag], np.flatnonzero(tags == tag)
        some = factors.rows(chosen)
        row, column = np.triu_indices(layout.rows)
        numbers = np.hstack((
            some.offset[:, :3 * layout.has_offset], some.mean[:, :layout.rows],
            0.5 * (some.information + np.swapaxes(some.information, 1, 2))[:, row, column]))
        lines[chosen] = _lines(np.where(used[chosen], tag, NOT_USED + tag).tolist(), np.stack(
            (ids[some.i], ids[some.j])[:layout.n_ids], axis=1), numbers)
    return ''.join(lines[np.argsort(factors.j < 0, kind='stable')])


def _lines(tags: list[str], ids: IntArray, numbers: FloatArray) -> list[str]:
    """Return a line for each row, with the digits needed to read numbers back bit for bit."""
    columns = [map(str, column) for column in ids.T.tolist()]
    # as integers, which tell 0.0 and -0.0 apart; those of the information are mostly the same
    for column in np.ascontiguousarray(numbers.T).view(np.int64):
        each, place = ((column[:1], np.zeros_like(column)) if np.all(column == column[:1])
                       else np.unique(column, return_inverse=True))
        texts = [*map(repr, each.view(np.float64).tolist())]
        columns.append(map(texts.__getitem__, place.tolist()))
    return [' '.join(words) + '\n' for words in zip(tags, *columns, strict=True)]
