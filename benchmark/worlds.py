# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Worlds: graphs in the order in which their parts arrive, generated here or read by `files`.

In step k node k arrives, with everything that is known by then and was not before: the rows
`edge_stops[k - 1]:edge_stops[k]` of the edges, where the first of them ties node k to an earlier
node, and `observed_stops[k - 1]:observed_stops[k]` of the observed nodes. Node 0 is fixed.

Measurements are `compose(truth, noise)` with the noise in the frame of the measured pose, where
the errors (3.48) and (3.52) live. Everything is drawn from a seed.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges, ObservedKind, ObservedNodes
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

SEED = 20260
CHAIN_SIGMA = (0.05, 0.02, 0.003)
"""Of one odometry step of the chains, of about 1 m [m, m, rad]."""
GLOBAL_SIGMA = (0.5, 0.5, 0.03)
"""Of a global pose [m, m, rad]."""
GLOBAL_EVERY = 10
LATE = 30
"""Nodes that a late global pose is behind."""


@dataclass(frozen=True, slots=True)
class World:
    """A graph of N nodes that arrives step by step; see the module's docstring."""

    name: str
    first: FloatArray
    """Pose of node 0, shape (3,)."""
    edges: Edges
    edge_stops: IntArray
    """Number of edges that have arrived after each step, shape (N,)."""
    observed: ObservedNodes
    observed_stops: IntArray
    """Number of observed nodes that have arrived after each step, shape (N,)."""
    truth: FloatArray | None = None
    """True poses, shape (N, 3); None for recordings."""
    start: FloatArray | None = None
    """Poses that a file gives, shape (N, 3)."""

    @property
    def n_nodes(self) -> int:
        """Number of nodes, and of steps."""
        return len(self.edge_stops)

    def closures(self) -> int:
        """Return the number of edges beyond those that introduce a node."""
        return len(self.edges) - (self.n_nodes - 1)

    def part(self, step: int) -> tuple[Edges, ObservedNodes]:
        """Return all constraints that have arrived after a step."""
        return (self.edges.rows(slice(0, int(self.edge_stops[step]))),
                self.observed.rows(slice(0, int(self.observed_stops[step]))))

    def graph(self, poses: FloatArray, step: int | None = None) -> Graph:
        """Return the graph after a step (the last by default) with these poses, shape (N, 3)."""
        edges, observed = self.part(self.n_nodes - 1 if step is None else step)
        graph = Graph()
        graph.apply(GraphUpdate(hidden=poses, edges=edges, observed=observed, fix=[0]))
        return graph

    def dead_reckoning(self) -> FloatArray:
        """Return the poses by composing, for every node, its first edge, shape (N, 3)."""
        rows = np.concatenate(([0], self.edge_stops[:-1]))[1:]
        i, j = self.edges.i[rows], self.edges.j[rows]
        mean = self.edges.mean[rows]
        backward = i > j
        mean[backward] = se2.inverse(mean[backward])
        parent = np.minimum(i, j)
        if np.all(parent == np.arange(len(rows))):
            return integrate(self.first, mean)
        poses = np.empty((self.n_nodes, 3))
        poses[0] = self.first
        for k, node in enumerate(parent, 1):
            poses[k] = se2.compose(poses[node], mean[k - 1])
        return poses


def integrate(first: FloatArray, steps: FloatArray) -> FloatArray:
    """Return the poses, shape (N + 1, 3), that steps (N, 3) lead to, one after the other."""
    heading = first[2] + np.concatenate(([0.0], np.cumsum(steps[:, 2])))
    moves = np.einsum('nij,nj->ni', se2.rotation(heading[:-1]), steps[:, :2])
    position = np.concatenate((first[None, :2], first[:2] + np.cumsum(moves, axis=0)))
    return se2.wrapped(np.column_stack((position, heading)))


def information(sigma: tuple[float, float, float]) -> FloatArray:
    """Return the information matrix, shape (3, 3), of independent errors."""
    return np.diag(1.0 / np.square(sigma))


def measured(
    true: FloatArray, sigma: tuple[float, float, float], rng: np.random.Generator,
) -> FloatArray:
    """Return measurements of true poses, shape (M, 3), with noise in the measured frame."""
    return se2.compose(true, rng.normal(size=true.shape) * sigma)


def odometry(
    truth: FloatArray, sigma: tuple[float, float, float], rng: np.random.Generator, *,
    pessimism: float = 1.0, weight: FloatArray | None = None,
) -> Edges:
    """
    Return the edges from every node to the next.

    Parameters
    ----------
    truth : ndarray, shape (N, 3)
    sigma : tuple
        Of the noise [m, m, rad].
    rng : Generator
    pessimism : float
        The information claims sigmas that are this much larger than the noise.
    weight : ndarray, shape (3, 3), optional
        The information itself, in place of that of independent errors with these sigmas.

    """
    n = len(truth) - 1
    mean = measured(se2.between(truth[:-1], truth[1:]), sigma, rng)
    claimed = information(sigma) / pessimism**2 if weight is None else weight
    return Edges(np.arange(n), np.arange(1, n + 1), mean,
                 np.tile(claimed, (n, 1, 1)), np.full(n, EdgeKind.ODOMETRY))


def arranged(
    name: str, truth: FloatArray, edges: Edges, observed: ObservedNodes | None = None,
    delay: int = 0,
) -> World:
    """
    Put constraints into the order of their arrival: with the later of the nodes that they tie.

    Parameters
    ----------
    name : str
    truth : ndarray, shape (N, 3)
    edges : Edges
        Odometry before the others.
    observed : ObservedNodes, optional
    delay : int
        Observed nodes arrive this many steps late; what would come after the end is left out.

    """
    steps = np.arange(len(truth))
    later = np.maximum(edges.i, edges.j)
    order = np.argsort(later, kind='stable')
    observed = ObservedNodes() if observed is None else observed
    observed = observed.rows(observed.node + delay < len(truth))
    observed = observed.rows(np.argsort(observed.node, kind='stable'))
    return World(
        name, truth[0].copy(), edges.rows(order),
        np.searchsorted(later[order], steps, side='right'), observed,
        np.searchsorted(observed.node + delay, steps, side='right'), truth)


def chain(n: int, variant: str = 'prompt', seed: int = SEED) -> World:
    """
    Return a drive without loop closures: odometry and a global pose on every tenth node.

    Parameters
    ----------
    n : int
        Number of nodes.
    variant : {'prompt', 'late', 'position', 'dropped'}
        As above; each global pose `LATE` nodes late; positions without heading; none at all on
        stretches of 200 to 600 nodes, every 1000 nodes or so.
    seed : int

    """
    rng = np.random.default_rng(seed)
    turn = 0.02 * _smooth(rng.normal(size=n - 1), 0.95)
    steps = np.column_stack((1.0 + 0.1 * rng.uniform(-1.0, 1.0, n - 1), np.zeros(n - 1), turn))
    truth = integrate(np.zeros(3), steps)
    edges = odometry(truth, CHAIN_SIGMA, rng)
    nodes = np.arange(GLOBAL_EVERY, n, GLOBAL_EVERY)
    if variant == 'dropped':
        starts = np.arange(500, n, 1000) + rng.integers(-200, 200, len(np.arange(500, n, 1000)))
        stops = starts + rng.integers(200, 600, len(starts))
        gap = np.searchsorted(starts, nodes, side='right') - 1
        nodes = nodes[(gap < 0) | (nodes >= stops[np.maximum(gap, 0)])]
    observed = seen(truth, nodes, GLOBAL_SIGMA, rng, heading=variant != 'position')
    return arranged(f'chain {n}' + ('' if variant == 'prompt' else f' {variant}'), truth, edges,
                    observed, LATE if variant == 'late' else 0)


def seen(
    truth: FloatArray, nodes: IntArray, sigma: tuple[float, float, float],
    rng: np.random.Generator, *, heading: bool,
) -> ObservedNodes:
    """Return global poses of nodes, or only their positions."""
    mean = measured(truth[nodes], sigma, rng)
    weight = information(sigma)
    kind = ObservedKind.GLOBAL_POSE
    if not heading:
        mean[:, 2], weight[2, 2], kind = 0.0, 0.0, ObservedKind.POSITION
    return ObservedNodes(nodes, None, mean, np.tile(weight, (len(nodes), 1, 1)),
                         np.full(len(nodes), kind))


def laps(n: int = 1500, per_lap: int = 408, seed: int = SEED) -> World:
    """Return laps of one ring, with closures to the lap before on every fifth node."""
    rng = np.random.default_rng(seed)
    step, turn = 1.0, 2.0 * np.pi / per_lap
    truth = integrate(np.zeros(3), np.tile((step, 0.0, turn), (n - 1, 1)))
    ends = np.arange(per_lap, n, 5)
    closing = closures(truth, ends - per_lap, ends, (0.1, 0.1, 0.05), rng)
    edges = Edges.joined((odometry(truth, (0.05, 0.05, 0.02), rng), closing))
    return arranged('laps', truth, edges)


def closures(
    truth: FloatArray, i: IntArray, j: IntArray, sigma: tuple[float, float, float],
    rng: np.random.Generator, *, pessimism: float = 1.0, weight: FloatArray | None = None,
) -> Edges:
    """Return loop closures from nodes i to nodes j; the parameters are those of `odometry`."""
    mean = measured(se2.between(truth[i], truth[j]), sigma, rng)
    claimed = information(sigma) / pessimism**2 if weight is None else weight
    return Edges(i, j, mean, np.tile(claimed, (len(i), 1, 1)),
                 np.full(len(i), EdgeKind.LOOP_CLOSURE))


def _smooth(noise: FloatArray, memory: float) -> FloatArray:
    """Return a first-order autoregressive process of unit variance driven by the noise."""
    return np.asarray(lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], noise))
