# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read a graph from a g2o file or a saved graph, and choose its nodes by their ids in the file."""

from pathlib import Path
import re
import sys
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.geometry.se2 import IntArray
from pose_graph_ros.core.graph.graph_update import GraphRows
from pose_graph_ros.core.io.edge2_order import Guess, read_guessed
from pose_graph_ros.core.io.g2o import GraphFile, read_g2o

N_TAGS = 10  # number of tags that are warned of
SAVED = b'{\n"sha256": "'
"""Begin of the JSON file of a saved graph."""


class NamedRows(NamedTuple):
    """The rows of a graph, and the number of each hidden node in its file."""

    rows: GraphRows
    ids: IntArray


def read(path: Path, edge2_order: str | None) -> NamedRows:
    """Return the graph in a file; warnings go to stderr. Raises FileFormatError."""
    side = path if path.suffix == '.json' else path.with_suffix('.json')
    if side == path or (side.is_file() and _begins_as_saved(side)):
        # what reads saved graphs takes longer to load than all else here
        from pose_graph_ros.core.io.graph_files import read_graph  # noqa: PLC0415

        rows = read_graph(path).rows
        return NamedRows(rows, rows.node_ids)
    file, _ = read_file(path, edge2_order)
    return NamedRows(file.rows, file.ids)


def read_file(path: Path, edge2_order: str | None) -> tuple[GraphFile, str | None]:
    """Return a g2o, TORO or iSAM file with the order of its EDGE2; warnings go to stderr."""
    file, order, reason = (read_guessed(path) if edge2_order is None
                           else Guess(read_g2o(path, edge2_order), edge2_order, ''))
    tags = sorted(file.skipped, key=lambda tag: -file.skipped[tag])
    lines = [f'{file.skipped[tag]} lines {tag!r} are skipped'
             + (': TORO may merge these nodes, which their edges connect anyway'
                if tag == 'EQUIV' else '') for tag in tags[:N_TAGS]]
    if len(tags) > N_TAGS:
        lines.append(f'lines with {len(tags) - N_TAGS} other tags are skipped')
    lines += file.notes
    if reason:
        lines.append(f'EDGE2 is read in the order of {order}, as {reason}; say which it is with '
                     f'--edge2')
    for line in lines:
        print(f'warning: {path}: {line}', file=sys.stderr)
    return file, order


def _begins_as_saved(path: Path) -> bool:
    with path.open('rb') as file:
        return file.read(len(SAVED)) == SAVED


def rows_of(ids: IntArray, text: str, option: str) -> IntArray:
    """
    Return the rows of the nodes that a text names, such as `3,7,20:25`, ascending.

    A range has both ends and need not be without gaps. Raises ConfigError that names the option.

    Parameters
    ----------
    ids : ndarray, shape (N,), of all hidden nodes
    text : str
    option : str, for the message

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
