# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Reading a graph whose tag `EDGE2` may mean two formats: both are tried, and the better one kept.

TORO writes the information as 11 12 22 33 13 23, iSAM its square root as R11 R12 R13 R22 R23 R33.
Read in the other's order, a file without correlations has the number for one coordinate in the
place of a correlation, so that a matrix is singular or indefinite. If all matrices are positive
definite in both orders, the graph is optimised with each. Then the one is kept with which energies
differ less, as measured by the mean over the median, whatever the unit of the information is.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.exceptions import FileFormatError
from pose_graph_ros.core.graph.graph_update import GraphRows
from pose_graph_ros.core.io.g2o import EDGE2_ORDERS, graph_of, GraphFile
from pose_graph_ros.core.io.g2o_text import AMBIGUOUS, read_lines
from pose_graph_ros.core.solver_config import SolverConfig

# Smallest eigenvalue of a positive definite matrix, its diagonal scaled to 1.
DEFINITE = 1e-9


class Guess(NamedTuple):
    """A graph that was read, with what was guessed of its format."""

    file: GraphFile
    order: str | None
    """Of `EDGE2_ORDERS`; None if the file has no tag with two meanings."""
    reason: str
    """Why this order; empty without a guess."""


def read_guessed(path: Path) -> Guess:
    """
    Return the planar graph in a file as `read_g2o` does, its order found out if need be.

    Raises FileFormatError, with what is wrong in TORO's order, if neither can be read.
    """
    text = read_lines(path)
    if text.tags.isdisjoint(AMBIGUOUS):
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
    if 'LANDMARK' in text.tags and 'isam' in files:
        return Guess(files['isam'], 'isam', 'LANDMARK is a tag of iSAM')
    worst = {order: _smallest(file.rows) for order, file in files.items()}
    definite = [order for order, value in worst.items() if value > DEFINITE]
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
    information = rows.edges.information
    root = np.sqrt(np.maximum(np.einsum('mii->mi', information), np.finfo(float).tiny))
    scaled = information / root[:, :, None] / root[:, None, :]
    return float(np.min(np.linalg.eigvalsh(scaled), initial=1.0))


def _spread(rows: GraphRows) -> float:
    """Return the mean over the median of the energies of edges at the optimum."""
    # loads the compiled kernels
    from pose_graph_ros.core.batch.optimizer import optimize_from_linear_start  # noqa: PLC0415
    from pose_graph_ros.core.graph.graph import Graph  # noqa: PLC0415

    copy = Graph()
    copy.fill(rows)
    optimize_from_linear_start(copy, SolverConfig())
    energies = copy.energies().edges
    median = float(np.median(energies))
    return float(np.mean(energies)) / median if median > 0.0 else np.inf
