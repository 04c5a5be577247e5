# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A slow reference of the incremental smoother, random worlds, and a reader of the tables.

`SlowGraph` applies updates to its own arrays and solves dense systems of the Jacobians from
`jacobians`; it shares no code with the tables, the tree of cliques and their kernels.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jacobians
import numpy as np

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.config import SmootherConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph import factors, tables as tb
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.priors import packed
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

# Settings with which every update ends at the minimum.
EXACT = SmootherConfig(alpha=0.0, budget=1e-20, budget_share=1e-22, max_iterations=60)


@dataclass(frozen=True)
class SlowGraph:
    """
    A pose graph that is solved with dense matrices.

    Its rows are the ids of a `Graph`: what leaves keeps its row, without a weight.
    """

    poses: FloatArray = field(default_factory=lambda: np.empty((0, 3)))
    fixed: Any = field(default_factory=lambda: np.zeros(0, dtype=bool))
    factors: Factors = field(default_factory=Factors)
    gone: frozenset[int] = frozenset()
    """Nodes that have left."""
    dropped: frozenset[int] = frozenset()
    """Edges that have left without their nodes."""

    @property
    def present(self) -> Any:
        """Which nodes have not left."""
        return ~np.isin(np.arange(len(self.poses)), list(self.gone))

    def has_factors(self) -> Any:
        """Return the factors that have not left."""
        return np.flatnonzero(
            self.present[self.factors.i] & (self.present[self.factors.j] | (self.factors.j < 0))
            & (self.present[self.factors.k] | (self.factors.k < 0))
            & ~np.isin(np.arange(len(self.factors)), list(self.dropped)))

    def edited(self, update: GraphUpdate) -> 'SlowGraph':
        poses = np.vstack((self.poses, se2.wrapped(update.hidden), se2.wrapped(update.biases)))
        fixed = np.append(self.fixed, np.zeros(len(poses) - len(self.poses), dtype=bool))
        fixed[list(update.fix)] = True
        fixed[list(update.free)] = False
        gone = list(self.gone.union(update.remove_nodes))
        factors = Factors.joined([self.factors, update.factors])
        without = np.flatnonzero(np.any(
            np.isin((factors.i, factors.j, factors.k), gone), axis=0))
        return SlowGraph(
            poses, fixed,
            _weighed(_weighed(factors, update.remove, update.weigh), [*update.drop, *without], {}),
            frozenset(gone), self.dropped.union(update.drop))

    def at(self, poses: FloatArray) -> 'SlowGraph':
        """Return the graph with other poses of the nodes that have not left."""
        moved = self.poses.copy()
        moved[self.present] = poses
        return replace(self, poses=moved)

    def chi2(self) -> float:
        error = factors.errors(self.poses, self.factors)
        return float(np.sum(
            factors.energies(error, self.factors.weighted_information)))

    def system(self) -> tuple[FloatArray, FloatArray]:
        """Return H, shape (3N, 3N), and b, shape (3N,), of all nodes, fixed or not."""
        edges, observed = self.factors.edges, self.factors.observed
        edge = jacobians.linearize_edges(self.poses, edges)
        unary = jacobians.linearize_observed(self.poses, observed)
        return _normal_equations(len(self.poses), (
            (edges.weighted_information, edge.error,
             ((edges.i, edge.jacobian_i), (edges.j, edge.jacobian_j),
              (edges.k, edge.jacobian_k))),
            (observed.weighted_information, unary.error, ((observed.i, unary.jacobian),))))

    @property
    def unknown(self) -> Any:
        """Rows of H that belong to free nodes."""
        return np.flatnonzero(np.repeat(~self.fixed & self.present, 3))

    def scaled(self, H: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the free part of H with ones on its diagonal, and the scale of each row."""
        free = H[np.ix_(self.unknown, self.unknown)]
        root = np.sqrt(np.where(np.diag(free) > 0.0, np.diag(free), 1.0))
        return free / root / root[:, None], 1.0 / root

    def null_space(self) -> tuple[float, FloatArray]:
        """Return the smallest eigenvalue of the scaled H and the vectors of all close to it."""
        matrix, _ = self.scaled(self.system()[0])
        if len(matrix) == 0:
            return 1.0, np.zeros((3 * len(self.poses), 0))
        values, vectors = np.linalg.eigh(matrix)
        full = np.zeros((3 * len(self.poses), int(np.sum(values < 2.0 * abs(values[0]) + 1e-13))))
        full[self.unknown] = vectors[:, :full.shape[1]]
        return float(values[0]), full

    def step(self) -> FloatArray:
        """Return the next step of Gauss-Newton, shape (N, 3)."""
        H, b = self.system()
        matrix, scale = self.scaled(H)
        step = np.zeros(len(b))
        step[self.unknown] = -scale * np.linalg.solve(matrix, scale * b[self.unknown])
        return step.reshape(-1, 3)

    def optimized(self, steps: int = 50) -> 'SlowGraph':
        """Return the minimum that Gauss-Newton finds from here."""
        graph = self
        for _ in range(steps):
            step = graph.step()
            graph = replace(graph, poses=se2.wrapped(graph.poses + step))
            if np.max(np.abs(step), initial=0.0) < 1e-11:
                break
        return graph

    def covariance(self, H: FloatArray | None = None) -> FloatArray:
        """Return the inverse of H, shape (3N, 3N), 0 for fixed nodes."""
        matrix, scale = self.scaled(self.system()[0] if H is None else H)
        full = np.zeros((3 * len(self.poses),) * 2)
        full[np.ix_(self.unknown, self.unknown)] = (
            np.linalg.inv(matrix) * scale * scale[:, None])
        return full

    def at_ids(self, H: FloatArray) -> FloatArray:
        """Return a matrix of the nodes that have not left as one of all nodes."""
        full, rows = np.zeros((3 * len(self.poses),) * 2), np.flatnonzero(
            np.repeat(self.present, 3))
        full[np.ix_(rows, rows)] = H
        return full


def _weighed(table: Any, removed: Any, weights: Any) -> Any:
    weight = table.weight.copy()
    weight[list(removed)] = 0.0
    for row, value in weights.items():
        weight[row] = value
    return table.replaced(weight=weight)


def frame_turn(graph: Graph, c: int) -> float:
    """Return the angle of a clique's frame: the mean turn of its separator, unless anchored."""
    row = graph.memory['cliques'][c]
    begin = row['members'] + row['n_frontal']
    separator = graph.memory['pool_i'][begin:begin + row['n_separator']]
    if row['anchored'] != 0 or len(separator) == 0:
        return 0.0
    turns = graph.node_records['delta'][separator, 2]
    return float(np.mean(turns) - row['turn_zero'])


def information(graph: Graph, nodes: list[int] | None = None) -> FloatArray:
    """
    Return H, shape (3N, 3N), as linearized in the tables, of all constraints or those of nodes.

    Each constraint has its own linearization point in the tables, so it gets its own nodes here.
    """
    edges, observed = graph.factors_by_row.edges, graph.factors_by_row.observed
    if nodes is not None:
        edges = edges.replaced(weight=edges.weight * (
            np.isin(edges.i, nodes) | np.isin(edges.j, nodes) | np.isin(edges.k, nodes)))
        observed = observed.replaced(weight=observed.weight * np.isin(observed.i, nodes))
    m, k = len(edges), len(observed)
    is_edge = graph.factors_by_row.j >= 0
    table, headings = graph.factor_records, graph.node_records['reference'][:, 2]
    rows, unary = table[is_edge], table[~is_edge]
    # without an error by third nodes, of which the Jacobian is constant
    ends, hidden = np.zeros((2 * m + 1, 3)), np.zeros((k, 3))
    # the constraints of a clique turn with its frame
    turn = np.array([frame_turn(graph, c) for c in rows['owner']])
    ends[:m, 2] = np.arctan2(rows['lin_sin'], rows['lin_cos']) - edges.mean[:, 2] + turn
    # an edge to a bias has the factors in place of a frame
    to_bias = edges.kind == FactorKind.BIAS
    assert np.all(turn[to_bias & (edges.weight > 0.0)] == 0.0)
    ends[:m][to_bias, 2] = (headings[edges.i] + rows['lin_th'])[to_bias]
    difference = rows['lin_arm']
    ends[m:2 * m, :2] = np.einsum('mij,mj->mi', se2.rotation(turn), difference)
    hidden[:, 2] = headings[observed.i] + unary['lin_th']
    edge = jacobians.linearize_edges(ends, Factors(
        np.arange(m), m + np.arange(m), edges.mean, edges.information, edges.kind,
        constants=edges.constants, k=np.where(edges.k < 0, -1, 2 * m)))
    single = jacobians.linearize_observed(hidden, Factors.on(
        np.arange(k), observed.offset, observed.mean, observed.information, observed.kind))
    return _normal_equations(graph.n_nodes, (
        (edges.weighted_information, edge.error,
         ((edges.i, edge.jacobian_i), (edges.j, edge.jacobian_j),
          (edges.k, edge.jacobian_k))),
        (observed.weighted_information, single.error, ((observed.i, single.jacobian),))))[0]


def _normal_equations(n: int, constraints: Any) -> tuple[FloatArray, FloatArray]:
    H, b = np.zeros((n, 3, n, 3)), np.zeros((n, 3))
    blocks = H.transpose(0, 2, 1, 3)
    for W, error, ends in constraints:
        for row, J_row in ends:
            np.add.at(b, row, np.einsum('mji,mjk,mk->mi', J_row, W, error))
            for column, J_column in ends:
                np.add.at(blocks, (row, column),
                          np.einsum('mji,mjk,mkl->mil', J_row, W, J_column))
    return H.reshape(3 * n, 3 * n), b.ravel()


@dataclass
class World:
    """True poses of nodes, and a simulation of measurements."""

    rng: np.random.Generator
    truth: list[FloatArray]
    stride: float = 1.0
    turn: float = 0.6
    noise: tuple[float, float, float] = (0.05, 0.05, 0.02)
    """Sigmas of all measurements [m, m, rad]."""
    guess: tuple[float, float, float] = (0.1, 0.1, 0.05)
    """Sigmas of the initial poses of new nodes [m, m, rad]."""
    weight: Callable[[np.random.Generator], float] | None = None
    """Factor on the information of each measurement."""
    biases: set[int] = field(default_factory=set)
    """Nodes that are biases."""
    gone: set[int] = field(default_factory=set)
    """Nodes that have left the graph."""

    @property
    def poses(self) -> list[int]:
        """Nodes that are poses."""
        return [node for node in range(len(self.truth))
                if node not in self.biases and node not in self.gone]

    def informative(self) -> FloatArray:
        root = self.rng.normal(size=(3, 3))
        factor = 1.0 if self.weight is None else self.weight(self.rng)
        return factor * (root @ root.T * 30.0 + np.diag([100.0, 100.0, 400.0]))

    def drive(self, start: int) -> FloatArray:
        """Append a node about one stride in front of another; return its initial pose."""
        move = self.rng.normal((self.stride, 0.0, 0.0),
                               (0.3 * self.stride, 0.3 * self.stride, self.turn))
        self.biases.discard(len(self.truth))    # left by an update that failed
        self.truth.append(se2.compose(self.truth[start], move))
        return self.disturbed(self.truth[-1], self.guess)

    def disturbed(self, pose: FloatArray, sigma: tuple[float, float, float]) -> FloatArray:
        return se2.wrapped(pose + self.rng.normal(size=3) * sigma)

    def edges(self, pairs: list[tuple[int, int]]) -> Factors:
        table = Factors(
            [i for i, _ in pairs], [j for _, j in pairs],
            np.reshape([self.disturbed(se2.between(self.truth[i], self.truth[j]), self.noise)
                        for i, j in pairs], (-1, 3)),
            np.reshape([self.informative() for _ in pairs], (-1, 3, 3)),
            [FactorKind.LOOP_CLOSURE] * len(pairs))
        biases = [bias for bias in sorted(self.biases - self.gone) if bias < len(self.truth)]
        for record in table.records if len(biases) > 0 else ():
            self._calibrate(record, int(self.rng.choice(biases)))
        return table

    def _calibrate(self, record: Any, bias: int) -> None:
        """Let some edges be of odometry with a third node, by which the truth is disturbed."""
        duration, (rate, scale, _) = self.rng.uniform(-1.0, 1.0), self.truth[bias]
        by_state = complex(1.0 + scale, -0.5 * duration * rate)
        if abs(by_state) > 0.5 and self.rng.random() < 0.5:
            x, y, heading = record['mean']
            moved = complex(x, y) / by_state
            record['mean'] = moved.real, moved.imag, heading + duration * rate
            record['kind'], record['k'] = FactorKind.ODOMETRY, bias
            record['constants'][3] = duration

    def observed(
        self, nodes: list[int], *, position: bool = False, offset: bool = False,
    ) -> Factors:
        offsets = self.rng.normal(size=(len(nodes), 3)) * offset
        mean = np.reshape([
            self.disturbed(se2.compose(self.truth[node], shift), self.noise)
            for node, shift in zip(nodes, offsets, strict=True)], (-1, 3))
        information = np.reshape([self.informative() for _ in nodes], (-1, 3, 3))
        if position:
            information[:, 2, :] = information[:, :, 2] = mean[:, 2] = 0.0
        kind = FactorKind.POSITION if position else FactorKind.GLOBAL_POSE
        return Factors.on(nodes, offsets, mean, information, [kind] * len(nodes))

    def new_nodes(self, count: int) -> GraphUpdate:
        """Return nodes that branch off random nodes, with edges in both directions."""
        hidden, pairs = [], []
        for _ in range(count):
            node, poses = len(self.truth), self.poses
            n = len(poses)
            start = poses[self.rng.integers(max(0, n - 4) if self.rng.random() < 0.8 else 0, n)]
            hidden.append(self.drive(start))
            pairs.append((start, node) if self.rng.random() < 0.7 else (node, start))
        return GraphUpdate(hidden=np.reshape(hidden, (-1, 3)), factors=self.edges(pairs))

    def new_part(self, anchor: str) -> GraphUpdate:
        """Return a node without edges, which its anchor determines, in part, or not at all."""
        node = len(self.truth)
        hidden = self.drive(self.poses[-1])[None]
        if anchor == 'fixed':
            return GraphUpdate(hidden=hidden, fix=[node])
        if anchor == 'pose':
            return GraphUpdate(hidden=hidden, factors=self.observed([node], offset=True))
        if anchor == 'positions':
            return GraphUpdate(hidden=hidden, factors=Factors.joined([
                self.observed([node], position=True),
                self.observed([node], position=True, offset=True)]))
        if anchor == 'position':
            return GraphUpdate(hidden=hidden, factors=self.observed([node], position=True))
        return GraphUpdate(hidden=hidden)

    def pairs(self, count: int) -> list[tuple[int, int]]:
        """Return `count` pairs of different nodes, sometimes with the first one twice."""
        if len(self.poses) < 2:
            return []
        pairs = [tuple(self.rng.choice(self.poses, 2, replace=False).tolist())
                 for _ in range(count)]
        return pairs + pairs[:1] if self.rng.random() < 0.2 else pairs

    def new_biases(self, count: int, measurements: int) -> GraphUpdate:
        """Return biases, each with a prior or an edge to an older one, and biased measurements."""
        rng, values, edges, priors = self.rng, [], [], []
        spread = np.array([1.0, 1.0, 0.2])
        for _ in range(count):
            node = len(self.truth)
            older = sorted(bias for bias in self.biases - self.gone if bias < node)
            if len(older) > 0 and rng.random() < 0.8:
                before, phi = older[-1 - int(rng.integers(min(len(older), 3)))], rng.uniform(
                    0.3, 0.98)
                left = np.sqrt(1.0 - phi * phi) * spread
                truth = phi * self.truth[before] + left * rng.normal(size=3)
                edges.append(Factors([node], [before], np.zeros((1, 3)), [np.diag(left**-2.0)],
                                   [FactorKind.BIAS], constants=[[0.0, 0.0, phi, phi]]))
            else:
                truth = spread * rng.normal(size=3)
                priors.append(Factors.on([node], None, np.zeros((1, 3)),
                                         [np.diag(spread**-2.0)], [FactorKind.GLOBAL_POSE]))
            self.biases.add(node)
            self.truth.append(truth)
            values.append(truth + 0.3 * spread * rng.normal(size=3))
        biases = sorted(bias for bias in self.biases - self.gone if bias < len(self.truth))
        edges += [self.biased(int(rng.choice(self.poses)), int(rng.choice(biases[-3:])))
                  for _ in range(measurements if len(biases) > 0 else 0)]
        return GraphUpdate(
            biases=np.reshape(values, (-1, 3)), factors=Factors.joined(edges + priors))

    def biased(self, node: int, bias: int) -> Factors:
        """Return a measured position or pose with a bias."""
        offset, factors = self.rng.normal(size=2) * (self.rng.random() < 0.6), self.rng.uniform(
            0.2, 1.0, 2)
        mean = np.append(se2.transform(self.truth[node], offset), self.truth[node][2])
        mean = self.disturbed(mean - factors[[0, 0, 1]] * self.truth[bias], self.noise)
        information = self.informative()
        if self.rng.random() < 0.5:
            information[2] = information[:, 2] = 0.0
        return Factors([node], [bias], [mean], [information], [FactorKind.BIAS],
                     constants=[[*offset, *factors]])

    def joined(self, first: GraphUpdate, **more: Any) -> GraphUpdate:
        """Return an update with more parts; constraints are appended to its own."""
        if 'factors' in more:
            more['factors'] = Factors.joined([first.factors, more['factors']])
        return first._replace(**more)

    def mixture(self, graph: SlowGraph) -> GraphUpdate:
        """Return an update with a random number of edits of each kind."""
        rng = self.rng
        update = self.new_nodes(int(rng.integers(0, 4)))
        if rng.random() < 0.4:
            more = self.new_biases(int(rng.integers(0, 3)), int(rng.integers(0, 3)))
            update = self.joined(
                update, biases=more.biases, factors=more.factors)
        poses = self.poses
        nodes = [poses[k] for k in rng.integers(0, len(poses), int(rng.integers(0, 3)))]
        update = self.joined(
            update, factors=Factors.joined([
                self.edges(self.pairs(int(rng.integers(0, 3)))),
                self.observed(nodes, position=bool(rng.random() < 0.4),
                              offset=bool(rng.random() < 0.5))]))
        rows = graph.has_factors()
        for _ in range(2 if len(rows) > 0 else 0):
            if rng.random() < 0.3:
                update = update._replace(remove=[*update.remove, int(rng.choice(rows))])
            if rng.random() < 0.4:
                update = update._replace(weigh={**update.weigh, int(rng.choice(rows)): float(
                    rng.choice([0.0, 1.0, rng.uniform()]))})
        nodes = [node for node in range(len(self.truth)) if node not in self.gone]
        if rng.random() < 0.15:
            update = update._replace(fix=[int(rng.choice(nodes))])
        if rng.random() < 0.15:
            update = update._replace(free=[int(rng.choice(nodes))])
        return update

    def leaving(self, graph: SlowGraph) -> GraphUpdate:
        """Return an update that nodes and constraints leave the graph with, all but one pose."""
        rng, poses, update = self.rng, self.poses, GraphUpdate()
        nodes = [*poses, *(bias for bias in sorted(self.biases - self.gone)
                           if bias < len(self.truth))]     # of updates that have not failed
        kept = int(rng.choice(poses))
        if rng.random() < 0.8:
            chosen = rng.choice(nodes, min(int(rng.integers(1, 5)), len(nodes)), replace=False)
            update = update._replace(remove_nodes=[v for v in chosen.tolist() if v != kept])
        rows = graph.has_factors()
        for _ in range(2 if len(rows) > 0 else 0):
            if rng.random() < 0.3:
                update = update._replace(drop=[*update.drop, int(rng.choice(rows))])
        return update


def world(seed: int, *, origin: tuple[float, float] = (0.0, 0.0), **how: Any) -> World:
    """Return a world with one node."""
    rng = np.random.default_rng(seed)
    return World(rng, [np.array([*origin, rng.uniform(-np.pi, np.pi)])], **how)


def driven(
    seed: int, steps: int, config: SmootherConfig = EXACT,
) -> tuple[IncrementalSmoother, SlowGraph, World]:
    """Return a smoother after random edits, some of which fail, its reference, and the world."""
    smoother, slow, here = IncrementalSmoother(config), SlowGraph(), world(seed)
    updates = [GraphUpdate(hidden=np.array(here.truth), fix=[0])]
    for _ in range(steps + 1):
        update = updates.pop() if len(updates) > 0 else here.mixture(slow)
        if smoother.update(update).status is not Status.FAILED:
            slow = slow.edited(update).at(smoother.poses)
        del here.truth[len(slow.poses):]
    return smoother, slow, here


# --- the tables ---------------------------------------------------------------------------------

_USED = {'nodes': tb.N_NODES, 'factors': tb.N_FACTORS, 'touched': tb.N_TOUCHED,
         'waiting': tb.N_WAITING, 'node_id': tb.N_NODES, 'factor_id': tb.N_FACTORS}


@dataclass(frozen=True)
class Clique:
    """One clique, read from the tables."""

    parent: int
    children: list[int]
    frontal: list[int]
    separator: list[int]
    R: FloatArray
    """Rows of R of the frontal nodes in map axes, shape (3 F, 3 F + 3 S)."""
    rhs: FloatArray
    update: FloatArray
    """Update matrix in map axes, shape (3 S, 3 S)."""


def triangle(values: FloatArray, rows: int, n: int) -> tuple[FloatArray, int]:
    """Return the first rows of an upper triangle, shape (rows, n + 1), and how many values."""
    full, places = np.zeros((rows, n + 1)), np.triu_indices(rows, m=n + 1)
    full[places] = values[:len(places[0])]
    return full, len(places[0])


def cliques(graph: Graph) -> dict[int, Clique]:
    """Return all cliques by row."""
    memory, found = graph.memory, {}
    for c, row in enumerate(memory['cliques'][:memory.head[tb.N_CLIQUES]]):
        n_frontal, n_separator = int(row['n_frontal']), int(row['n_separator'])
        if n_frontal <= 0:
            continue    # a prior, or an unused row
        nodes = memory['pool_i'][row['members']:][:n_frontal + n_separator].tolist()
        rows, rest = 3 * n_frontal, 3 * n_separator
        values = memory['pool_f'][row['values']:]
        block, n_numbers = triangle(values, rows, rows + rest)
        R = block[:, :-1]
        R[np.diag_indices(rows)] = 1.0 / R[np.diag_indices(rows)]
        update = triangle(values[n_numbers:], rest, rest)[0][:, :-1]
        children, child = [], int(row['child'])
        while child >= 0:
            children.append(child)
            child = int(memory['cliques']['sibling'][child])
        # R and the update matrix are in the frame of the clique
        M = np.eye(3 * len(nodes))
        M.reshape(len(nodes), 3, len(nodes), 3)[
            np.arange(len(nodes)), :2, np.arange(len(nodes)), :2] = (
                se2.rotation(frame_turn(graph, c)).T)
        rest = M[rows:, rows:]
        found[c] = Clique(
            int(row['parent']), children, nodes[:n_frontal], nodes[n_frontal:], R @ M,
            block[:, -1].copy(), rest.T @ (update + np.triu(update, 1).T) @ rest)
    return found


def state(graph: Graph) -> dict[str, bytes]:
    """Return all numbers that later steps depend on as bytes, for comparison bit by bit."""
    memory = graph.memory
    # with the bytes between the fields, which NumPy would not copy
    copies = {name: tb.as_bytes(memory[name][:memory.head[count]]).copy().view(memory[name].dtype)
              for name, count in _USED.items()}
    for table in copies.values():   # all integers of eight bytes are stamps
        for name in table.dtype.names or ():
            if table.dtype[name] == np.int64:
                table[name] = 0
    copies['nodes']['index'] = 0  # work space
    parts = {name: table.tobytes() for name, table in copies.items()}
    parts['cliques'] = b''.join(
        np.array([row, c.parent, -1, *c.children, -1, *c.frontal, -1, *c.separator]).tobytes()
        + c.R.tobytes() + c.rhs.tobytes() + c.update.tobytes()
        for row, c in cliques(graph).items())
    parts['priors'] = b''.join(
        prior.nodes.tobytes() + packed(prior).tobytes() for prior in graph.priors)
    parts['newest'] = memory.head[tb.NEWEST:tb.FIXED + 1].tobytes()
    parts['next'] = memory.head[tb.NEXT_NODE:tb.N_LEAVING + 1].tobytes()
    parts['structure'] = bytes([int(memory.head[tb.STRUCTURE]) != 0])
    return parts


def differences(before: dict[str, bytes], after: dict[str, bytes]) -> list[str]:
    """Return the names of the tables that differ."""
    return [name for name in before if before[name] != after[name]]
