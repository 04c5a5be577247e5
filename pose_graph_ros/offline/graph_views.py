# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A graph as a factor graph of networkx, the four views of it, and where their vertices stand.

*Factor graph*: each term of chi2 is a factor, connected to the hidden nodes that it has
(F. Kschischang, B. Frey, H.-A. Loeliger, "Factor graphs and the sum-product algorithm", IEEE
Trans. Inf. Theory 47, 2001).

*Pose graph*: hidden nodes and observed nodes; each edge leads from the node in whose frame
something was measured to the node that was measured. An observed node is such a frame as well:
with the identity as the measured pose, (3.48) is the error (3.52) of the hidden node in it.

*Markov random field*: hidden nodes that share a term are connected, which is the pattern of H off
its diagonal. Terms of a single node are on the diagonal alone: they vanish.

*Dynamic Bayesian network*: states with the controls that move them, and measurements that depend
on states; both are known (S. Thrun, W. Burgard, D. Fox, "Probabilistic Robotics", 2005).
A pose follows from the one before it in the file, whichever way an edge of odometry leads.

Hidden nodes are named by their rows. They have the attributes `name`, `role`, `fixed`, `size`
(number of coordinates) and `pose`; vertices of a term `name`, `role` and `term`. Arcs of a view
have `directed`, and `sort` and `used` of their term; `view.graph['notes']` is for the reader.
"""

from collections import Counter, defaultdict
from enum import StrEnum
from itertools import chain, combinations
from typing import Any, NamedTuple

import networkx as nx
import numpy as np

from pose_graph_ros.core.exceptions import GraphUpdateError
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors, NodeKind
from pose_graph_ros.core.graph.graph import Graph, GraphRows, GraphUpdate


class Sort(StrEnum):
    """Where a term comes from; the value is what a legend says."""

    ODOMETRY = 'odometry'
    LOOP_CLOSURE = 'loop closure'
    TURN = 'turn (gyro)'
    LANDMARK = 'landmark seen'
    OBSERVED = 'measured in the map'
    BIAS = 'change of a bias'
    PRIOR = 'left by marginalisation'


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


class Term(NamedTuple):
    """A constraint."""

    sort: Sort
    nodes: tuple[int, ...]
    """Rows of its hidden nodes; an edge leads from the first to the second."""
    used: bool = True
    """Whether it has a weight above 0."""


SORTS = {FactorKind.ODOMETRY: Sort.ODOMETRY, FactorKind.LOOP_CLOSURE: Sort.LOOP_CLOSURE,
         FactorKind.BIAS: Sort.BIAS, FactorKind.TURN: Sort.TURN, FactorKind.POINT: Sort.LANDMARK,
         FactorKind.RANGE: Sort.LANDMARK, FactorKind.PRIOR: Sort.PRIOR,
         FactorKind.NODE_PRIOR: Sort.PRIOR}
HIDDEN = {NodeKind.POSE: ('x', Role.POSE), NodeKind.LANDMARK: ('l', Role.LANDMARK),
          NodeKind.BIAS: ('b', Role.BIAS)}


def factor_graph(rows: GraphRows, ids: IntArray | None = None) -> Any:
    """
    Return a graph with its terms as factors, as a `networkx.Graph`.

    `ids` are the numbers of the hidden nodes, by default their own. A position whose error is
    correlated in time is in the rows twice, as an edge to a bias and as an observed node without
    weight; only the edge counts.
    """
    graph = nx.Graph()
    kinds = [NodeKind(kind) for kind in rows.node_kind.tolist()]
    for node, (node_kind, number) in enumerate(zip(
            kinds, (rows.node_ids if ids is None else ids).tolist(), strict=True)):
        letter, role = HIDDEN[node_kind]
        graph.add_node(node, name=f'{letter}{number}', role=role, fixed=bool(rows.fixed[node]),
                       size=int(rows.dimension[node]), pose=rows.poses[node].copy())
    factors = rows.factors.renumbered(rows.rows_of)
    found, measured = [], set()
    stepped = set(factors.i[factors.kind == FactorKind.ODOMETRY].tolist())
    # those to biases come first
    for row in np.argsort(factors.j < 0, kind='stable').tolist():
        kind, i, j, k = (int(column[row]) for column in (
            factors.kind, factors.i, factors.j, factors.k))
        place, used = (i, *factors.mean[row, :2].tolist()), bool(factors.weight[row] > 0.0)
        sort = SORTS.get(FactorKind(kind), Sort.OBSERVED)
        if sort is Sort.LOOP_CLOSURE and i == j + 1 and j not in stepped:
            sort = Sort.ODOMETRY    # that leads back
            stepped.add(j)
        if kind == FactorKind.BIAS and kinds[i] is NodeKind.POSE:
            sort = Sort.OBSERVED
            measured.add(place)
        if j >= 0 or used or place not in measured:
            found.append(Term(sort, tuple(node for node in (i, j, k) if node >= 0), used))
    found += [Term(Sort.PRIOR, tuple(rows.rows_of(prior.nodes).tolist())) for prior in rows.priors]
    for n, term in enumerate(found):
        factor = graph.number_of_nodes()
        graph.add_node(factor, name=f'f{n}', role=Role.FACTOR, term=term)
        graph.add_edges_from((factor, node) for node in term.nodes)
    return graph


def terms(graph: Any) -> list[Term]:
    """Return the terms of a factor graph."""
    return [data['term'] for _, data in graph.nodes(data=True) if 'term' in data]


def hidden(graph: Any) -> list[int]:
    """Return the rows of the hidden nodes of a factor graph or of a view."""
    return [node for node, data in graph.nodes(data=True) if 'term' not in data]


def part(graph: Any, chosen: set[int]) -> tuple[Any, int]:
    """Return some hidden nodes with the terms among them, and how many terms lead to others."""
    if not chosen:
        raise GraphUpdateError('none of the hidden nodes is chosen')
    shown, n_cut = graph.copy(), 0
    for node, data in graph.nodes(data=True):
        nodes = set(data['term'].nodes) if 'term' in data else {node}
        if not nodes <= chosen:
            shown.remove_node(node)
            n_cut += bool(nodes & chosen)
    return shown, n_cut


def pose_graph(graph: Any) -> Any:
    """Return the view of a factor graph as a pose graph."""
    view = _begun(graph)
    for term in terms(graph):
        if term.sort is Sort.OBSERVED or len(term.nodes) == 1:
            _add(view, 'z', Role.OBSERVED, term)
        elif len(term.nodes) == 2:
            _join(view, *term.nodes, term)
        else:
            _add(view, '', Role.JOINT, term, directed=False)
    n_unused = sum(not term.used for term in terms(graph))
    if n_unused > 0:
        view.graph['notes'].append(f'Dashed: {_n(n_unused, "constraint")} with weight 0.')
    return view


def factors(graph: Any) -> Any:
    """Return the view of a factor graph as such, without the terms that are not used."""
    view = _begun(graph)
    for term in _used(graph, view):
        _add(view, 'f', Role.FACTOR, term, directed=False)
    return view


def markov_random_field(graph: Any) -> Any:
    """Return the view of a factor graph as a Markov random field."""
    view, notes = _begun(graph), list[str]()
    used = _used(graph, view)
    for i, j in sorted({pair for term in used
                        for pair in combinations(sorted(set(term.nodes)), 2)}):
        view.add_edge(i, j, directed=False, sort=None, used=True)
    n_unary = sum(len(set(term.nodes)) == 1 for term in used)
    if n_unary > 0:
        notes = [f'{_n(n_unary, "term")} of a single node {"is" if n_unary == 1 else "are"} not '
                 'in the picture: a Markov random field has lines for pairs of nodes only.']
    view.graph['notes'] = [*notes, *view.graph['notes']]
    return view


def bayesian_network(graph: Any) -> Any:
    """Return the view of a factor graph as a dynamic Bayesian network."""
    view = _begun(graph)
    for term in _used(graph, view):
        if term.sort in {Sort.ODOMETRY, Sort.BIAS}:
            before, after = sorted(term.nodes[:2])
            for parent in (before, *term.nodes[2:]):
                _join(view, parent, after, term)
            if term.sort is Sort.ODOMETRY:
                _add(view, 'u', Role.CONTROL, term, ends=(after,))
        else:
            _add(view, 'z', Role.MEASUREMENT, term, away=False)
    return view


VIEWS = {'pose-graph': pose_graph, 'factor-graph': factors, 'mrf': markov_random_field,
         'dbn': bayesian_network}


def _begun(graph: Any) -> Any:
    """Return a view with the hidden nodes alone."""
    view = nx.MultiDiGraph(notes=[], numbers=Counter())
    view.add_nodes_from((node, graph.nodes[node]) for node in hidden(graph))
    return view


def _used(graph: Any, view: Any) -> list[Term]:
    """Return the terms that are used; a note says how many are not."""
    used = [term for term in terms(graph) if term.used]
    n_unused = len(terms(graph)) - len(used)
    if n_unused > 0:
        view.graph['notes'].append(f'{_n(n_unused, "constraint")} with weight 0 left out.')
    return used


def _add(view: Any, letter: str, role: Role, term: Term, *, ends: tuple[int, ...] | None = None,
         away: bool = True, directed: bool = True) -> None:
    """Add the vertex of a term, with arcs to its hidden nodes or some of them, or from them."""
    vertex, numbers = max(view, default=-1) + 1, view.graph['numbers']
    view.add_node(vertex, name=f'{letter}{numbers[letter]}', role=role, term=term)
    numbers[letter] += 1
    for node in term.nodes if ends is None else ends:
        start, end = (vertex, node) if away else (node, vertex)
        _join(view, start, end, term, directed=directed)


def _join(view: Any, start: int, end: int, term: Term, *, directed: bool = True) -> None:
    view.add_edge(start, end, directed=directed, sort=term.sort, used=term.used)


def _n(number: int, noun: str) -> str:
    return f'{number} {noun}{"" if number == 1 else "s"}'


def map_places(view: Any, *, spring: bool = False) -> tuple[dict[int, FloatArray], int]:
    """
    Return where the vertices of a view stand, and how many hidden nodes lie on another one.

    The unit is the median distance of neighbours. Hidden nodes stand as in the map, but for
    biases, which are nowhere in it; with `spring` only near that. Springs place the others.
    """
    nodes = {node: {node} if 'term' not in data else set(data['term'].nodes)
             for node, data in view.nodes(data=True)}
    in_map = [node for node in hidden(view) if view.nodes[node]['role'] is not Role.BIAS]
    at = np.array([view.nodes[node]['pose'][:2] for node in in_map]).reshape(-1, 2)
    lines = nx.Graph(chain(view.edges(), *(combinations(each, 2) for each in nodes.values())))
    lines = nx.Graph(lines.subgraph(in_map))
    lines.add_nodes_from(in_map)
    # so that vertices at the same place leave in different directions
    turns = 2.4 * np.arange(len(nodes))
    aside = np.column_stack((np.cos(turns), np.sin(turns)))
    if spring:
        start = {node: place + 0.01 * way for node, place, way in zip(
            in_map, _to_unit(at, in_map, lines), aside, strict=False)}
        found = nx.spring_layout(lines, pos=start, iterations=200, seed=0)
        at = np.array([found[node] for node in in_map]).reshape(-1, 2)
    at = _to_unit(at, in_map, lines)
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1)) + np.diag(
        np.full(len(at), np.inf))
    n_near = int(np.sum(np.min(apart, axis=1, initial=np.inf) < 0.1))
    placed = dict(zip(in_map, at, strict=True))
    start = dict(placed)
    for n, node in enumerate(view):
        if node not in placed:
            near = nodes[node] & placed.keys() or set(nx.all_neighbors(view, node)) & placed.keys()
            middle = np.mean([placed[each] for each in near], axis=0) if near else np.zeros(2)
            start[node] = middle + 0.3 * aside[n]
    if len(placed) == len(nodes):
        return start, n_near
    # nodes repel from afar: the more there are, the weaker
    return nx.spring_layout(nx.Graph(view), pos=start, fixed=in_map or None, iterations=100,
                            k=0.7 * len(nodes)**(-1.0 / 6.0), seed=0), n_near


def _to_unit(at: FloatArray, names: list[int], lines: Any) -> FloatArray:
    """Return places around the origin with a median distance of 1 of those with a line."""
    row = {node: n for n, node in enumerate(names)}
    lengths = np.array([np.hypot(*(at[row[i]] - at[row[j]])) for i, j in lines.edges()])
    lengths = lengths[lengths > 1e-9]
    spread = float(np.max(np.ptp(at, axis=0), initial=0.0)) / max(len(at) - 1, 1)
    unit = float(np.median(lengths)) if len(lengths) > 0 else spread or 1.0
    return np.asarray((at - np.mean(at, axis=0)) / unit) if len(at) > 0 else at


LEVELS = {Role.CONTROL: 1.0, Role.MEASUREMENT: -1.0, Role.BIAS: -2.4, Role.LANDMARK: -3.6}
"""Rows of a dynamic Bayesian network, whose poses are at 0."""
ABOVE = 2.0  # row of measurements of several poses


def time_slices(view: Any) -> dict[int, FloatArray]:
    """Return where the vertices of a dynamic Bayesian network stand: a column for each pose."""
    data = dict(view.nodes(data=True))
    column = {node: 1.2 * n for n, node in enumerate(
        node for node in view if data[node]['role'] is Role.POSE)}
    at = {node: np.array((x, 0.0)) for node, x in column.items()}
    taken: dict[float, list[float]] = defaultdict(list)
    poses = {node: sorted(column[other] for other in set(data[node]['term'].nodes) & column.keys())
             for node in view if 'term' in data[node]}
    for node, xs in sorted(poses.items(), key=lambda each: each[1]):
        role, level, x = data[node]['role'], LEVELS[data[node]['role']], (xs or [0.0])[-1]
        if role is Role.CONTROL:
            x -= 0.6
        elif len(xs) > 1 and data[node]['term'].sort is not Sort.TURN:
            x, level = 0.5 * (xs[0] + xs[-1]), ABOVE
        at[node] = _free(x, taken[level], level)
    for node in view:
        if node not in at:
            others = [at[other][0] for other in nx.all_neighbors(view, node) if other in at]
            level = LEVELS[data[node]['role']]
            at[node] = _free(float(np.mean(others or [0.0])), taken[level], level)
    return at


def _free(x: float, taken: list[float], level: float) -> FloatArray:
    """Return the next free place at a level, from x on to the right; it is taken then."""
    while any(abs(x - other) < 0.6 - 1e-9 for other in taken):
        x += 0.3
    taken.append(x)
    return np.array((x, level))


def five_states() -> list[tuple[str, GraphRows]]:
    """Return a pose graph after each of five updates, as in Figure 3.10 of the thesis."""
    states = []
    for title, n, observed in (
            ('a) a hidden node x0 and an observed node z0', 1, [0]),
            ('b) another observed node on x0: same pattern, other values', 1, [0, 0]),
            ('c) a node x1 and an edge: two by two blocks', 2, [0, 0]),
            ('d) an observed node on x1: same pattern', 2, [0, 0, 1]),
            ('e) a chain: block-tridiagonal', 5, [0, 0, 1, 3])):
        poses, graph = np.zeros((n, 3)), Graph()
        poses[:, 0] = 2.0 * np.arange(n)
        i, eyes = np.arange(n - 1), np.tile(np.eye(3), (5, 1, 1))
        m, odometry = len(observed), [FactorKind.ODOMETRY] * (n - 1)
        graph.apply(GraphUpdate(hidden=poses, factors=Factors.joined([
            Factors(i, i + 1, np.diff(poses, axis=0), eyes[:n - 1], odometry), Factors.on(
                observed, None, np.zeros((m, 3)), eyes[:m], [FactorKind.GLOBAL_POSE] * m)])))
        states.append((title, graph.rows()))
    return states
