# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Pairs of closures are compared as by composing all motions with all their noises."""

from hypothesis import given, settings, strategies as st
import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.judgement.closures import Closures, squared_distances
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.marginalization.marginalize import marginalize
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother

seeds = st.integers(0, 2**32 - 1)


def covariance(rng: np.random.Generator, sigma: tuple[float, float, float]) -> np.ndarray:
    root = rng.normal(size=(3, 3)) * np.array(sigma)[:, None]
    return root @ root.T + np.diag(sigma) ** 2


class Drive:
    """A drive with biases among its nodes, closures, and edges of a second odometry."""

    def __init__(self, seed: int, n: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.smoother = IncrementalSmoother()
        self.smoother.update(GraphUpdate(hidden=np.array([[5.0, -3.0, 1.0]]), fix=[0]))
        self.rows, self.means, self.noises = [0], [], []
        for _ in range(n - 1):
            if rng.random() < 0.3:
                self.add_others()
            mean = rng.normal((1.0, 0.0, 0.0), (0.3, 0.2, 0.5))
            self.means.append(mean)
            self.noises.append(covariance(rng, (0.05, 0.03, 0.02)))
            self.smoother.extend(mean, np.linalg.inv(self.noises[-1]))
            self.rows.append(self.smoother.graph.newest_pose)

    def add_others(self) -> None:
        bias = self.smoother.graph.n_nodes
        i, j = self.rows[self.rng.integers(len(self.rows))], self.rows[-1]
        kinds = [FactorKind.ODOMETRY, FactorKind.LOOP_CLOSURE] if i != j else []
        self.smoother.update(GraphUpdate(
            biases=np.zeros((1, 3)), fix=[bias], factors=Factors(
                [i] * len(kinds), [j] * len(kinds), np.ones((len(kinds), 3)),
                np.tile(np.eye(3), (len(kinds), 1, 1)), kinds, weight=np.zeros(len(kinds)))))

    def composed(self, i: int, j: int, noises: np.ndarray) -> np.ndarray:
        """Return the pose of node j in node i, by their numbers, with noise in each edge."""
        if j < i:
            return se2.inverse(self.composed(j, i, noises))
        pose = np.zeros(3)
        for mean, noise in zip(self.means[i:j], noises[i:j], strict=True):
            pose = se2.compose(se2.compose(pose, mean), noise)
        return pose

    def closures(self, m: int) -> Closures:
        """Return closures that all begin in one half of the drive and end in the other."""
        n = len(self.rows)
        i, j = self.rng.integers(0, n // 2, m), self.rng.integers(n // 2, n, m)
        mean = np.array([self.composed(a, b, np.zeros((n, 3))) for a, b in zip(i, j, strict=True)])
        mean += self.rng.normal(size=(m, 3)) * (0.5, 0.5, 0.2)
        return Closures(i, j, mean, np.array(
            [covariance(self.rng, (0.3, 0.2, 0.1)) for _ in range(m)]))

    def in_graph(self, closures: Closures) -> Closures:
        rows = np.array(self.rows)
        return closures._replace(i=rows[closures.i], j=rows[closures.j])

    def slow(self, closures: Closures, a: int, b: int) -> float:
        """Return the squared distance by differences of the composition in each noise."""
        i, j, mean, noise = closures
        n = len(self.means)

        def error(noises: np.ndarray) -> np.ndarray:
            through = se2.compose(mean[b], noises[n])
            predicted = se2.compose(
                self.composed(i[a], i[b], noises),
                se2.compose(through, self.composed(j[b], j[a], noises)))
            return se2.between(mean[a], predicted)

        step = 1e-5
        e = error(np.zeros((n + 1, 3)))
        total = noise[a].copy()
        for edge, Q in enumerate([*self.noises, noise[b]]):
            J = np.empty((3, 3))
            for axis in range(3):
                noises = np.zeros((n + 1, 3))
                noises[edge, axis] = step
                more, less = error(noises), error(-noises)
                J[:, axis] = (more - less) / (2.0 * step)
                J[2, axis] = se2.wrap(more[2] - less[2]) / (2.0 * step)
            total += J @ Q @ J.T
        return float(e @ np.linalg.solve(total, e))


@given(seeds, st.integers(3, 12))
@settings(max_examples=8)
def test_distances_are_those_by_composing_everything(seed: int, n: int) -> None:
    drive, chain = Drive(seed, n), OdometryChain()
    chain.extend(drive.smoother.graph)
    closures = drive.closures(4)
    first, second = np.nonzero(~np.eye(4, dtype=bool))
    here = drive.in_graph(closures)
    actual = squared_distances(chain, here.rows(first), here.rows(second))
    expected = [drive.slow(closures, a, b) for a, b in zip(first, second, strict=True)]
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-8)


@given(seeds)
@settings(max_examples=10)
def test_a_chain_that_grows_is_that_of_the_whole_graph(seed: int) -> None:
    drive, whole, grown = Drive(seed, 10), OdometryChain(), OdometryChain()
    whole.extend(drive.smoother.graph)
    again = Drive(seed, 1)
    grown.extend(again.smoother.graph)
    for mean, noise in zip(drive.means, drive.noises, strict=True):
        again.add_others()
        again.smoother.extend(mean, np.linalg.inv(noise))
        again.rows.append(again.smoother.graph.newest_pose)
        grown.extend(again.smoother.graph)
    pairs = np.arange(10).repeat(10), np.tile(np.arange(10), 10)
    for actual, expected in zip(
            grown.between(*(np.array(again.rows)[each] for each in pairs)),
            whole.between(*(np.array(drive.rows)[each] for each in pairs)), strict=True):
        np.testing.assert_allclose(actual, expected, atol=1e-15)


@given(seeds)
@settings(max_examples=10)
def test_a_chain_has_the_relative_covariances_of_a_graph_without_loops(seed: int) -> None:
    drive, chain = Drive(seed, 12), OdometryChain()
    chain.extend(drive.smoother.graph)
    rows = np.array(drive.rows)
    i, j = drive.rng.permutation(12), drive.rng.permutation(12)
    keep = i != j
    i, j = i[keep], j[keep]
    motion, noise = chain.between(rows[i], rows[j])
    expected = [drive.composed(a, b, np.zeros((11, 3))) for a, b in zip(i, j, strict=True)]
    np.testing.assert_allclose(se2.between(np.array(expected), motion), 0.0, atol=1e-12)
    edges = Factors(rows[i], rows[j], motion, np.tile(np.eye(3), (len(i), 1, 1)),
                  np.full(len(i), FactorKind.LOOP_CLOSURE))
    found = drive.smoother.innovations(edges)
    np.testing.assert_allclose(found.errors, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.covariances, noise, rtol=1e-7, atol=1e-12)
    lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.array(drive.means)[:, :2].T))))
    np.testing.assert_allclose(chain.travel(rows), lengths)


def test_a_long_drive_far_from_its_beginning_keeps_its_precision() -> None:
    # 200 km out; then a chain of 10 m has its covariance to a millimetre
    smoother, chain = IncrementalSmoother(), OdometryChain()
    smoother.update(GraphUpdate(hidden=np.zeros((1, 3)), fix=[0]))
    noise = np.diag([0.05, 0.02, 0.003]) ** 2
    for _ in range(2000):
        smoother.extend(np.array([100.0, 0.0, 0.0]), np.linalg.inv(noise))
    for _ in range(10):
        smoother.extend(np.array([1.0, 0.0, 0.0]), np.linalg.inv(noise))
    chain.extend(smoother.graph)
    _, actual = chain.between(np.array([2000]), np.array([2010]))
    expected = np.zeros((3, 3))
    for k in range(10):
        arm = se2.adjoint(np.array([-float(k), 0.0, 0.0]))
        expected += arm @ noise @ arm.T
    np.testing.assert_allclose(actual[0], expected, atol=1e-6)


def test_a_chain_goes_on_over_nodes_that_have_left() -> None:
    drive = Drive(3, 12)
    whole, chain, graph = OdometryChain(), OdometryChain(), drive.smoother.graph
    whole.extend(graph)
    drive.smoother.update(marginalize(graph, [drive.rows[k] for k in (0, 4, 5)]))
    chain.extend(graph)
    left = np.array([drive.rows[k] for k in (1, 2, 3, 6, 7, 8, 9, 10, 11)])
    np.testing.assert_array_equal(chain.nodes, left)
    # where odometry is known it is the same; over the gap the graph tells
    for begin, end in ((0, 2), (3, 8)):
        for actual, expected in zip(
                chain.between(left[[begin]], left[[end]]),
                whole.between(left[[begin]], left[[end]]), strict=True):
            np.testing.assert_allclose(actual, expected, atol=1e-12)
    motion, noise = chain.between(left[[2]], left[[3]])
    np.testing.assert_allclose(motion[0], se2.between(*graph.poses_of(left[[2, 3]])), atol=1e-12)
    assert np.all(np.linalg.eigvalsh(noise[0]) > 0.0)
