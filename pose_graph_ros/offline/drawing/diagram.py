# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The four views of a graph as vertices and arcs.

*Pose graph*: hidden nodes and observed nodes; each edge leads from the node in whose frame
something was measured to the node that was measured. An observed node is such a frame as well:
with the identity as the measured pose, (3.48) is the error (3.52) of the hidden node in it.

*Factor graph*: each term of chi2 is a factor, connected to the hidden nodes that it has
(F. Kschischang, B. Frey, H.-A. Loeliger, "Factor graphs and the sum-product algorithm", IEEE
Trans. Inf. Theory 47, 2001).

*Markov random field*: hidden nodes that share a term are connected, which is the pattern of H off
its diagonal. Terms of a single node are on the diagonal alone: they vanish.

*Dynamic Bayesian network*: states with the controls that move them, and measurements that depend
on states; both are known (S. Thrun, W. Burgard, D. Fox, "Probabilistic Robotics", 2005).
A pose follows from the one before it in the file, whichever way an edge of odometry leads.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from typing import NamedTuple

from pose_graph_ros.core.graph.constraints import NodeKind
from pose_graph_ros.offline.drawing.structure import Sort, Structure, Term


class Role(StrEnum):
    """What a vertex stands for; the value is what a legend says."""

    POSE = 'hidden node'
    LANDMARK = 'landmark (hidden)'
    BIAS = 'bias (hidden)'
    OBSERVED = 'observed node'
    FACTOR = 'factor'
    CONTROL = 'control (odometry)'
    MEASUREMENT = 'measurement'
    JOINT = 'constraint of several nodes'


HIDDEN = {NodeKind.POSE: Role.POSE, NodeKind.LANDMARK: Role.LANDMARK, NodeKind.BIAS: Role.BIAS}


class View(StrEnum):
    """Ways to draw a graph."""

    POSE_GRAPH = 'pose-graph'
    FACTOR_GRAPH = 'factor-graph'
    MRF = 'mrf'
    DBN = 'dbn'


class Vertex(NamedTuple):
    """A node of a diagram."""

    name: str
    role: Role
    nodes: tuple[int, ...]
    """Rows of the hidden nodes that it is, or that its term has."""
    sort: Sort | None = None
    """Of its term; None for hidden nodes."""
    fixed: bool = False
    used: bool = True


class Arc(NamedTuple):
    """A line between two vertices, given by their numbers."""

    start: int
    end: int
    directed: bool
    sort: Sort | None = None
    """Of its term; None if it stands for all terms between its ends."""
    used: bool = True


@dataclass(frozen=True, slots=True)
class Diagram:
    """Vertices, arcs and what a reader has to be told; the hidden nodes come first."""

    view: View
    vertices: tuple[Vertex, ...]
    arcs: tuple[Arc, ...]
    notes: tuple[str, ...] = ()


def diagram(graph: Structure, view: View) -> Diagram:
    """Return a view of a graph."""
    return _VIEWS[view](graph)


class _Drawing:
    """A diagram that grows."""

    def __init__(self, graph: Structure) -> None:
        self.vertices = [
            Vertex(name, HIDDEN[kind], (row,), None, fixed) for row, (name, kind, fixed) in
            enumerate(zip(graph.names, graph.kinds, graph.fixed, strict=True))]
        self.arcs: list[Arc] = []
        self.numbers: Counter[str] = Counter()

    def add(self, letter: str, role: Role, term: Term) -> int:
        """Add the vertex of a term; return its number."""
        name = f'{letter}{self.numbers[letter]}'
        self.numbers[letter] += 1
        self.vertices.append(Vertex(name, role, term.nodes, term.sort, used=term.used))
        return len(self.vertices) - 1

    def join(self, start: int, end: int, term: Term, *, directed: bool = True) -> None:
        """Add an arc for a term."""
        self.arcs.append(Arc(start, end, directed, term.sort, term.used))

    def done(self, view: View, *notes: str) -> Diagram:
        """Return the diagram, with those notes that are not empty."""
        return Diagram(view, tuple(self.vertices), tuple(self.arcs),
                       tuple(note for note in notes if note != ''))


def _pose_graph(graph: Structure) -> Diagram:
    drawing = _Drawing(graph)
    for term in graph.terms:
        if term.sort is Sort.OBSERVED or len(term.nodes) == 1:
            observed = drawing.add('z', Role.OBSERVED, term)
            for node in term.nodes:
                drawing.join(observed, node, term)
        elif len(term.nodes) == 2:
            drawing.join(*term.nodes, term)
        else:
            joint = drawing.add('', Role.JOINT, term)
            for node in term.nodes:
                drawing.join(joint, node, term, directed=False)
    n_unused = sum(not term.used for term in graph.terms)
    return drawing.done(View.POSE_GRAPH, '' if n_unused == 0 else
                        f'Dashed: {_n(n_unused, "constraint")} with weight 0.')


def _factor_graph(graph: Structure) -> Diagram:
    drawing = _Drawing(graph)
    for term in _used(graph):
        factor = drawing.add('f', Role.FACTOR, term)
        for node in term.nodes:
            drawing.join(factor, node, term, directed=False)
    return drawing.done(View.FACTOR_GRAPH, _left_out(graph))


def _mrf(graph: Structure) -> Diagram:
    drawing = _Drawing(graph)
    pairs = {pair for term in _used(graph) for pair in combinations(sorted(set(term.nodes)), 2)}
    drawing.arcs = [Arc(i, j, directed=False) for i, j in sorted(pairs)]
    n_unary = sum(len(set(term.nodes)) == 1 for term in _used(graph))
    return drawing.done(
        View.MRF, '' if n_unary == 0 else
        f'{_n(n_unary, "term")} of a single node {"is" if n_unary == 1 else "are"} not in the '
        f'picture: a Markov random field has lines for pairs of nodes only.', _left_out(graph))


def _dbn(graph: Structure) -> Diagram:
    drawing = _Drawing(graph)
    for term in _used(graph):
        if term.sort is Sort.ODOMETRY:
            before, after = sorted(term.nodes)
            drawing.join(before, after, term)
            drawing.join(drawing.add('u', Role.CONTROL, term), after, term)
        elif term.sort is Sort.BIAS:
            before, after = sorted(term.nodes)
            drawing.join(before, after, term)
        else:
            measurement = drawing.add('z', Role.MEASUREMENT, term)
            for node in term.nodes:
                drawing.join(node, measurement, term)
    return drawing.done(View.DBN, _left_out(graph))


_VIEWS: dict[View, Callable[[Structure], Diagram]] = {
    View.POSE_GRAPH: _pose_graph, View.FACTOR_GRAPH: _factor_graph, View.MRF: _mrf,
    View.DBN: _dbn}


def _used(graph: Structure) -> list[Term]:
    return [term for term in graph.terms if term.used]


def _left_out(graph: Structure) -> str:
    """Return the note on terms that are not used."""
    n = len(graph.terms) - len(_used(graph))
    return '' if n == 0 else f'{_n(n, "constraint")} with weight 0 left out.'


def _n(number: int, noun: str) -> str:
    return f'{number} {noun}{"" if number == 1 else "s"}'
