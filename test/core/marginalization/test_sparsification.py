# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A sparsified prior tells no more than the dense one, and is as near to it as a tree can be."""

from collections.abc import Sequence
import itertools

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest
from random_graphs import dense_system, random_information, random_poses

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.graph.priors import Prior as DensePrior
from pose_graph_ros.core.marginalization.sparsification import SparsePrior, sparsify

ROUNDING = 1e-8
# What was observed of poses that are no longer in the graph: diagonals of the information.
ANCHORS: dict[str, list[list[float]]] = {
    'relative': [], 'pose': [[1.0, 2.0, 9.0]], 'position': [[1.0, 1.0, 0.0]],
    'positions': [[1.0, 1.0, 0.0], [3.0, 2.0, 0.0]], 'heading': [[0.0, 0.0, 5.0]]}
seeds, sizes = st.integers(0, 2**32 - 1), st.integers(2, 9)
anchors = st.sampled_from(sorted(ANCHORS))

Tree = Sequence[tuple[int, int]]


class Prior:
    """Information and vector of the first k nodes of a graph, and their poses."""

    def __init__(self, graph: Graph, k: int, *, anchored: bool) -> None:
        H, b = dense_system(graph)
        X = np.linalg.solve(H[3 * k:, 3 * k:], H[3 * k:, :3 * k]).T
        self.information = H[:3 * k, :3 * k] - X @ H[3 * k:, :3 * k]
        self.vector = -(b[:3 * k] - X @ b[3 * k:])
        self.poses, self.k, self.anchored = graph.poses[:k].copy(), k, anchored
        self.sigmas = 1.0 / np.sqrt(np.diagonal(self.information))

    def scaled(self, matrix: FloatArray) -> FloatArray:
        """Return a matrix of information without units."""
        return matrix * self.sigmas * self.sigmas[:, None]

    def sparsified(self, n_extra: int = 0, enough: float = 1e-9) -> SparsePrior:
        return sparsify(DensePrior(
            np.arange(self.k), self.poses, self.information, self.vector, 0.0, self.anchored),
            n_extra=n_extra, enough=enough)

    def system_of(self, sparse: SparsePrior) -> tuple[FloatArray, FloatArray]:
        """Return information and vector of the constraints that stand for the prior."""
        graph = Graph()
        graph.apply(GraphUpdate(hidden=self.poses, factors=sparse.factors))
        H, b = dense_system(graph)
        return H, -b

    @property
    def regular(self) -> slice:
        """Rows whose information is regular: without an anchor the first node may be fixed."""
        return slice(0 if self.anchored else 3, 3 * self.k)

    def divergence(self, approximation: FloatArray) -> float:
        exact = self.information[self.regular, self.regular]
        ratio = np.linalg.solve(exact, approximation[self.regular, self.regular])
        return float(0.5 * (np.trace(ratio) - np.linalg.slogdet(ratio)[1] - len(exact)))

    def tree(self, sparse: SparsePrior) -> Tree:
        """Return the pairs of nodes of a tree; k stands for the map."""
        edges = zip(sparse.factors.edges.i.tolist(), sparse.factors.edges.j.tolist(), strict=True)
        return [*edges, *((node, self.k) for node in sparse.factors.observed.i.tolist())]

    def measured(self, tree: Tree) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return Jacobians of the pairs of a tree and their covariances by the prior."""
        covariance = np.zeros_like(self.information)
        part = self.regular
        covariance[part, part] = np.linalg.inv(self.information[part, part])
        jacobians = []
        for i, j in tree:
            J = np.zeros((3, 3 * self.k))
            J[:, 3 * i:3 * i + 3] = np.eye(3)
            if j < self.k:
                d = self.poses[j, :2] - self.poses[i, :2]
                J[:, 3 * i:3 * i + 3] = [
                    [-1.0, 0.0, d[1]], [0.0, -1.0, -d[0]], [0.0, 0.0, -1.0]]
                J[:, 3 * j:3 * j + 3] = np.eye(3)
            jacobians.append(J)
        return jacobians, [J @ covariance @ J.T for J in jacobians]

    def scaled_as_a_whole(self, tree: Tree) -> float:
        """Return the divergence of a tree from covariances, scaled until it is conservative."""
        total = sum(J.T @ np.linalg.solve(C, J)
                    for J, C in zip(*self.measured(tree), strict=True))
        part = self.regular
        ratio = np.linalg.solve(self.information[part, part], total[part, part])
        return self.divergence(total / max(np.max(np.linalg.eigvals(ratio).real), 1.0))

    def volume(self, tree: Tree) -> float:
        """Return the sum of `log det` of the covariances of a tree."""
        return float(sum(np.linalg.slogdet(C)[1] for C in self.measured(tree)[1]))


def noisy_edges(rng: np.random.Generator, poses: FloatArray, ends: Tree) -> Factors:
    i, j = np.array(ends).T
    mean = se2.between(poses[i], poses[j]) + 0.02 * rng.standard_normal((len(i), 3))
    return Factors(i, j, mean, random_information(rng, len(i)), np.ones(len(i), dtype=np.uint8))


def prior_of(seed: int, k: int, anchor: str, n_gone: int = 4) -> Prior:
    """Return the prior that the last nodes of a graph with loops leave behind."""
    rng = np.random.default_rng(seed)
    n = k + n_gone
    poses = random_poses(rng, n)
    ends = [(int(rng.integers(0, node)), node) for node in range(1, n)]
    ends += [tuple(rng.choice(n, 2, replace=False).tolist()) for _ in range(n)]
    diagonals = np.array(ANCHORS[anchor]).reshape(-1, 3)
    node = np.arange(n - len(diagonals), n)
    observed = Factors.on(
        node, mean=poses[node] + 0.1, information=diagonals[:, None] * np.eye(3),
        kind=[FactorKind.GLOBAL_POSE] * len(node))
    graph = Graph()
    graph.apply(GraphUpdate(
        hidden=poses, factors=Factors.joined([noisy_edges(rng, poses, ends), observed])))
    return Prior(graph, k, anchored=len(node) > 0)


def all_trees(n: int) -> list[Tree]:
    found = []
    for edges in itertools.combinations(itertools.combinations(range(n), 2), n - 1):
        reached = {0}
        for _ in edges:
            reached |= {node for edge in edges if reached & set(edge) for node in edge}
        if len(reached) == n:
            found.append(edges)
    return found


def rank(matrix: FloatArray) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=1e-9, hermitian=True))


@given(seeds, sizes, anchors, st.sampled_from((0, 1, 3, 20)))
@settings(max_examples=20)
def test_no_covariance_is_smaller_than_the_exact_one(
    seed: int, k: int, anchor: str, n_extra: int,
) -> None:
    prior = prior_of(seed, k, anchor)
    approximation, _ = prior.system_of(prior.sparsified(n_extra))
    difference = prior.scaled(prior.information - approximation)
    assert np.linalg.eigvalsh(difference)[0] > -ROUNDING


@given(seeds, sizes, anchors, st.integers(0, 2))
@settings(max_examples=20)
def test_the_minimum_is_that_of_the_prior(
    seed: int, k: int, anchor: str, n_extra: int,
) -> None:
    prior = prior_of(seed, k, anchor)
    approximation, vector = prior.system_of(prior.sparsified(n_extra))
    minimum = np.linalg.pinv(prior.information, rcond=1e-10, hermitian=True) @ prior.vector
    np.testing.assert_allclose((vector - approximation @ minimum) * prior.sigmas, 0.0, atol=1e-6)


@given(seeds, sizes, anchors)
@settings(max_examples=20)
def test_the_null_space_is_kept(seed: int, k: int, anchor: str) -> None:
    prior = prior_of(seed, k, anchor)
    sparse = prior.sparsified()
    approximation, _ = prior.system_of(sparse)
    assert rank(prior.scaled(approximation)) == rank(prior.scaled(prior.information))
    assert len(prior.tree(sparse)) == k - 1 + (1 if prior.anchored else 0)
    if not prior.anchored:
        assert len(sparse.factors.observed) == 0
        motions = np.tile(np.eye(3), (k, 1))
        motions[0::3, 2], motions[1::3, 2] = -prior.poses[:, 1], prior.poses[:, 0]
        np.testing.assert_allclose(
            (approximation @ motions) * prior.sigmas[:, None], 0.0, atol=1e-6)


@given(seeds, st.integers(2, 4), st.sampled_from(('relative', 'pose', 'positions')))
@settings(max_examples=20)
def test_no_tree_scaled_as_a_whole_is_nearer(seed: int, k: int, anchor: str) -> None:
    prior = prior_of(seed, k, anchor)
    sparse = prior.sparsified()
    tree = prior.tree(sparse)
    approximation, _ = prior.system_of(sparse)
    assert sparse.divergence == pytest.approx(prior.divergence(approximation), abs=1e-6)
    assert sparse.divergence <= prior.scaled_as_a_whole(tree) + 1e-6
    # without the scaling the divergence is the sum of these logarithms, but for a constant
    others = all_trees(k + 1 if prior.anchored else k)
    assert prior.volume(tree) <= min(map(prior.volume, others)) + 1e-9


@given(seeds, st.integers(2, 6), st.booleans())
@settings(max_examples=20)
def test_a_prior_that_is_a_tree_is_exact(seed: int, k: int, anchored: bool) -> None:
    # of a chain every second node is kept
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, 2 * k - 1)
    ends = [end for m in range(k - 1) for end in ((m, k + m), (k + m, m + 1))]
    observed = Factors.on(
        [0], mean=poses[:1] + 0.1, information=np.eye(3)[None],
        kind=[FactorKind.GLOBAL_POSE]) if anchored else Factors()
    graph = Graph()
    graph.apply(GraphUpdate(
        hidden=poses, factors=Factors.joined([noisy_edges(rng, poses, ends), observed])))
    prior = Prior(graph, k, anchored=anchored)
    sparse = prior.sparsified()
    approximation, vector = prior.system_of(sparse)
    np.testing.assert_allclose(
        prior.scaled(approximation), prior.scaled(prior.information), atol=ROUNDING)
    np.testing.assert_allclose(
        (vector - prior.vector) * prior.sigmas, 0.0, atol=1e-6)
    assert sparse.divergence == pytest.approx(0.0, abs=ROUNDING)
    assert len(sparse.factors.edges) == k - 1


@given(seeds, st.integers(3, 6), anchors)
@settings(max_examples=20)
def test_more_edges_are_nearer(seed: int, k: int, anchor: str) -> None:
    prior = prior_of(seed, k, anchor)
    tree, more, most = (prior.sparsified(n) for n in (0, 1, k * k))
    # a tree that is exact needs no more
    assert len(prior.tree(more)) == len(prior.tree(tree)) + (tree.divergence > 1e-9)
    # the barrier ends a little inside
    assert most.divergence <= more.divergence + 1e-2
    assert more.divergence <= tree.divergence + 1e-2


@given(seeds, st.integers(2, 7), st.lists(st.integers(1, 3), min_size=1, max_size=2),
       st.sampled_from((0, 20)), st.booleans())
@settings(max_examples=20)
def test_biases_have_priors_with_one_pose_each(
    seed: int, k: int, dimensions: list[int], n_extra: int, loose: bool,
) -> None:
    rng = np.random.default_rng(seed)
    n = k + len(dimensions)
    used = np.concatenate((np.ones(3 * k, dtype=np.bool_),
                           *(np.arange(3) < size for size in dimensions)))
    roots = rng.standard_normal((2 * n, 3 * n, 3))
    if loose:   # only the sums of positions and biases are known
        shift = np.vstack((np.tile(np.eye(3, 2), (k, 1)),
                           np.tile(-np.eye(3, 2), (n - k, 1)))) * used[:, None]
        roots -= np.einsum('ij,mjk->mik', shift @ np.linalg.pinv(shift), roots)
    information = np.einsum('mik,mjk->ij', roots, roots) * used * used[:, None]
    vector = information @ rng.standard_normal(3 * n)
    poses = np.vstack((random_poses(rng, k), np.zeros((len(dimensions), 3))))
    sparse = sparsify(DensePrior(np.arange(n), poses, information, vector, 0.0, True),
                      n_extra=n_extra, n_biases=len(dimensions))
    assert [prior.nodes[1] for prior in sparse.priors] == list(range(k, n))
    assert all(prior.nodes[0] < k for prior in sparse.priors)
    graph = Graph()
    graph.apply(GraphUpdate(hidden=poses[:k], factors=sparse.factors))
    H, b = dense_system(graph)
    approximation, right = np.zeros_like(information), np.zeros(3 * n)
    approximation[:3 * k, :3 * k], right[:3 * k] = H, -b
    for prior in sparse.priors:
        at = (3 * prior.nodes[:, None] + np.arange(3)).ravel()
        approximation[np.ix_(at, at)] += prior.information
        right[at] += prior.vector
    part = np.ix_(used, used)
    scale = 1.0 / np.sqrt(np.diagonal(information[part]))
    difference = (information - approximation)[part] * scale * scale[:, None]
    assert np.linalg.eigvalsh(difference)[0] > -ROUNDING
    assert rank((approximation[part]) * scale * scale[:, None]) == (
        np.count_nonzero(used) - (2 if loose else 0))
    assert np.all(approximation[~used] == 0.0)
    minimum = np.linalg.pinv(information, rcond=1e-10, hermitian=True) @ vector
    if np.max(np.abs(minimum[2:3 * k:3])) < 0.5:
        np.testing.assert_allclose(
            (right - approximation @ minimum)[used] * scale, 0.0, atol=1e-6)


def test_a_single_pose_becomes_an_observed_node() -> None:
    prior = prior_of(1, 1, 'pose')
    sparse = prior.sparsified()
    assert (len(sparse.factors.edges), len(sparse.factors.observed)) == (0, 1)
    approximation, vector = prior.system_of(sparse)
    np.testing.assert_allclose(approximation, prior.information, rtol=ROUNDING)
    np.testing.assert_allclose(vector, prior.vector, rtol=1e-6)


def test_poses_that_nothing_connects_stay_apart() -> None:
    rng = np.random.default_rng(5)
    poses = random_poses(rng, 4)
    graph = Graph()
    graph.apply(GraphUpdate(hidden=poses, factors=noisy_edges(rng, poses, [(0, 1), (2, 3)])))
    prior = Prior(graph, 4, anchored=False)
    sparse = prior.sparsified()
    assert sorted(prior.tree(sparse)) == [(0, 1), (2, 3)]
    np.testing.assert_allclose(prior.system_of(sparse)[0], prior.information, atol=1e-6)


@pytest.mark.parametrize('known', [1e-35, 1e-13, 1e-6])
def test_headings_that_are_next_to_unknown_do_not_turn(known: float) -> None:
    prior = prior_of(7, 3, 'positions')
    information, vector = prior.information.copy(), prior.vector.copy()
    whole = prior.sparsified(3)
    # one more pose of which the position is measured, and the heading next to not at all
    k = prior.k
    prior.k, prior.poses = k + 1, np.vstack((prior.poses, (1.0, 2.0, 0.3)))
    prior.information, prior.vector = np.zeros((3 * k + 3, 3 * k + 3)), np.zeros(3 * k + 3)
    prior.information[:3 * k, :3 * k], prior.vector[:3 * k] = information, vector
    prior.information[3 * k:, 3 * k:] = np.diag((1.0, 1.0, known))
    prior.vector[3 * k:] = 0.4, -0.3, 1e3 * known
    sparse = prior.sparsified(3)
    moved = sparse.factors.observed.mean[sparse.factors.observed.i == k] - prior.poses[-1]
    np.testing.assert_allclose(moved[:, :2], [(0.4, -0.3)], atol=1e-6)
    assert np.all(np.abs(se2.wrap(moved[:, 2])) <= 0.5 + ROUNDING)
    others = sparse.factors.edges.rows(np.flatnonzero(sparse.factors.edges.j < k))
    np.testing.assert_allclose(others.mean, whole.factors.edges.mean, atol=1e-6)
