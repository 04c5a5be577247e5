# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Read a graph from a g2o file or a saved graph, and choose its nodes by their ids in the file.

Such a file can also be read as odometry and loop closures over time, as if a robot sent them: an
edge from each vertex to the next one is odometry; its other edges are loop closures, which come
when the later one of their ends is reached. The vertices are a second apart.
"""

from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
import re
import sys
from typing import TYPE_CHECKING

import numpy as np

from pose_graph_ros.core.exceptions import ConfigError, FileFormatError
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.io.g2o import GraphFile, read_g2o

if TYPE_CHECKING:
    from pose_graph_ros.core.measurements import LoopClosure, OdometrySample

GRAPH_SUFFIXES = ('.g2o', '.graph')
SAVED = b'{\n"sha256": "'  # begin of the .json file of a saved graph
SECOND = 1_000_000_000


def read(path: Path, edge2_order: str | None) -> GraphFile:
    """Return the graph in a file; warnings go to stderr. Raises FileFormatError."""
    side, begin = path if path.suffix == '.json' else path.with_suffix('.json'), b''
    if side != path and side.is_file():
        with side.open('rb') as file:
            begin = file.read(len(SAVED))
    if side == path or begin == SAVED:
        # what reads saved graphs takes longer to load than all else here
        from pose_graph_ros.core.io.graph_files import read_graph  # noqa: PLC0415

        rows = read_graph(path).rows
        return GraphFile(rows, rows.node_ids)
    return read_file(path, edge2_order)


def read_file(path: Path, edge2_order: str | None) -> GraphFile:
    """Return a g2o, TORO or iSAM file; warnings go to stderr."""
    file = read_g2o(path, edge2_order)
    tags = sorted(file.skipped, key=lambda tag: -file.skipped[tag])
    lines = [f'{file.skipped[tag]} lines {tag!r} are skipped'
             + (': TORO may merge these nodes, which their edges connect anyway'
                if tag == 'EQUIV' else '') for tag in tags[:10]]
    if len(tags) > 10:
        lines.append(f'lines with {len(tags) - 10} other tags are skipped')
    lines += file.notes
    if file.found_by:
        lines.append(f'EDGE2 is read in the order of {file.edge2_order}, as {file.found_by}; say '
                     f'which it is with --edge2')
    for line in lines:
        print(f'warning: {path}: {line}', file=sys.stderr)
    return file


def rows_of(ids: IntArray, text: str, option: str) -> IntArray:
    """
    Return the rows of the nodes that a text names, such as `3,7,20:25`, ascending.

    A range has both ends and need not be without gaps. Raises ConfigError that names the option.
    """
    chosen = np.zeros(len(ids), dtype=bool)
    for word in text.split(','):
        match = re.fullmatch(r'[xlb]?(-?\d{1,18})(?::[xlb]?(-?\d{1,18}))?', word.strip())
        if match is None:
            raise ConfigError(f'{option}: expected ids such as 3,7,20:25, got {text!r}')
        low = int(match[1])
        found = ids == low if match[2] is None else (ids >= low) & (ids <= int(match[2]))
        if not np.any(found):
            raise ConfigError(f'{option}: the graph has no hidden node {word.strip()}; ids are '
                              f'{ids[0]} to {ids[-1]}')
        chosen |= found
    return np.flatnonzero(chosen)


def read_measurements(
    path: Path, edge2: str | None = None,
) -> 'list[OdometrySample | LoopClosure]':
    """
    Return the measurements in a g2o file, in the order in which they come.

    The covariance of an odometry edge is that of the twist: `odom.noise: twist` uses it. Raises
    FileFormatError if a vertex has no edge to the next one.
    """
    # what only reads a graph need not load them
    from pose_graph_ros.core.measurements import LoopClosure  # noqa: PLC0415

    file = read_file(path, edge2)
    edges, n = file.graph.factors.edges, file.graph.n_nodes
    steps = np.flatnonzero(np.abs(edges.i - edges.j) == 1)
    # of several edges the first one in the file is odometry
    starts, first = np.unique(np.minimum(edges.i, edges.j)[steps], return_index=True)
    if len(starts) < n - 1:
        lone = int(np.setdiff1d(np.arange(n - 1), starts)[0])
        raise FileFormatError(f'{path}: expected an edge from each vertex '
                              f'to the next, as odometry; there is none from {file.ids[lone]} to '
                              f'{file.ids[lone + 1]}')
    odometry = steps[first]
    closures = np.setdiff1d(np.arange(len(edges)), odometry)
    last = np.maximum(edges.i, edges.j)[closures].tolist()
    others = edges.rows(closures)
    events: list[tuple[int, OdometrySample | LoopClosure]] = [
        *enumerate(_odometry(edges.rows(odometry))),
        # covariances from the axes of the measured pose to those of the reference
        *((when, LoopClosure(_stamp(int(j)), mean, covariance.turned(cov, -float(mean[2])),
                             reference_ns=_stamp(int(i))))
          for when, i, j, mean, cov in zip(
              last, others.i, others.j, others.mean, _covariances(others), strict=True))]
    return [each for _, each in sorted(events, key=itemgetter(0))]


def _odometry(edges: Factors) -> 'Iterator[OdometrySample]':
    """Yield composed poses at all stamps, given the edge from each vertex to the next."""
    from pose_graph_ros.core.measurements import OdometrySample  # noqa: PLC0415

    motions = np.where((edges.i < edges.j)[:, None], edges.mean, se2.inverse(edges.mean))
    variances, pose = np.diagonal(_covariances(edges), axis1=1, axis2=2), np.zeros(3)
    for k in range(len(motions) + 1):
        # in a second each
        motion, variance = (each[min(k, len(motions) - 1)] for each in (motions, variances))
        yield OdometrySample(_stamp(k), pose, float(np.hypot(*motion[:2])), variance)
        pose = se2.compose(pose, motion)


def _stamp(vertex: int) -> int:
    return SECOND * (vertex + 1)


def _covariances(edges: Factors) -> FloatArray:
    """Return the inverses of the information, shape (M, 3, 3); zero if there is none."""
    covariances = np.zeros((len(edges), 3, 3))
    regular = np.linalg.det(edges.information) > 0.0
    covariances[regular] = np.linalg.inv(edges.information[regular])
    return covariances
