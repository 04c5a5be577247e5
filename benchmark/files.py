# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Worlds from graph files: recordings and the public sets, put into the order of an online run.

Node k comes with all edges whose later end is k. `EDGE2` is read in TORO's order.
"""

from dataclasses import replace
from functools import cache
import os
from pathlib import Path

import numpy as np

from benchmark.worlds import arranged, World
from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.graph.constraints import FactorKind
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.io.g2o import read_g2o

DATA = Path(os.environ.get('POSE_GRAPH_DATA') or (
    Path(__file__).resolve().parents[2] / 'shared' / 'data'))
"""Where the public data are."""
SUFFIXES = ('.g2o', '.graph')
TRUTH_MARKS = ('_gt', 'groundtruth')
"""What the names of ground-truth files hold; those are passed over."""


@cache
def load_folder(folder: Path) -> tuple[list[World], list[str]]:
    """
    Read all graphs of a folder.

    Returns
    -------
    worlds : list of World
        In the order of their sizes.
    complaints : list of str
        One sentence for each file that could not be read, or not run online.

    """
    worlds, complaints = [], []
    for path in sorted(folder.glob('*')):
        truth = any(mark in path.stem.lower() for mark in TRUTH_MARKS)
        if path.suffix not in SUFFIXES or truth:
            continue
        try:
            worlds.append(load(path))
        except (FileFormatError, ValueError) as error:
            # without the folder: reports are made on one machine and read on another
            where = str(error).removeprefix(str(path))
            complaints.append(f'{path.name}{where}' if where.startswith(':')
                              else f'{path.name}: {where}')
    return sorted(worlds, key=lambda world: world.n_nodes), complaints


def load(path: Path) -> World:
    """
    Read one graph.

    Raises
    ------
    FileFormatError, ValueError
        If the file cannot be read, or a node has no edge to an earlier one.

    """
    content = read_g2o(path, 'toro')
    return online(path.stem, content.graph, has_start=content.has_start)


def online(name: str, graph: Graph, *, has_start: bool) -> World:
    """Put the constraints of a graph into the order of an online run."""
    edges, observed = graph.factors.edges, graph.factors.observed
    later, gap = np.maximum(edges.i, edges.j), np.abs(edges.j - edges.i)
    # of the edges that arrive with a node the one from the node before it comes first, forward
    # ones before backward ones, then in the order of the file
    world = arranged(name, graph.poses, edges.rows(np.lexsort(
        (edges.i > edges.j, np.minimum(gap, 2), later))), observed)
    stops = world.edge_stops
    alone = np.flatnonzero(np.diff(stops) == 0) + 1
    if len(alone) > 0:
        raise ValueError(f'node {alone[0]} has no edge to an earlier one, and {len(alone) - 1} '
                         f'others: no online run')
    kind = np.full(len(edges), FactorKind.LOOP_CLOSURE)
    kind[stops[:-1]] = FactorKind.ODOMETRY
    return replace(world, edges=world.edges.replaced(kind=kind), truth=None,
                   start=graph.poses.copy() if has_start else None)
