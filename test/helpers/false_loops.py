# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Drives in laps with right and wrong loop closures."""

from dataclasses import dataclass

import numpy as np

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate

# Sigmas of an odometry edge and of a closure [m, m, rad].
ODOMETRY, CLOSURE = (0.06, 0.04, 0.02), (0.1, 0.1, 0.03)


@dataclass(frozen=True)
class Drive:
    """A graph with its first node fixed, at poses by odometry."""

    graph: Graph
    closures: IntArray
    """Rows of the closures."""
    right: BoolArray
    """Of the closures."""
    truth: FloatArray

    def error(self, poses: FloatArray) -> float:
        """Return the rms error of positions, shape (N, 3), first node at the truth [m]."""
        off = poses[:, :2] - self.truth[:, :2]
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def laps(  # noqa: PLR0917
    seed: int, n_laps: int = 3, n: int = 30, every: int = 3, n_wrong: int = 0,
    groups: tuple[int, ...] = (),
) -> Drive:
    """
    Return a drive of laps of a circle, with closures to the lap before.

    Parameters
    ----------
    seed : int
    n_laps, n : int, laps and nodes of each
    every : int, nodes from closure to closure
    n_wrong : int, closures between random nodes with random poses
    groups : tuple of int, sizes of groups of wrong closures that agree with each other

    """
    rng = np.random.default_rng(seed)
    step = np.array([1.0, 0.0, 2.0 * np.pi / n])
    truth = [np.zeros(3)]
    for k in range(n_laps * n):
        turned = step + np.array([0.3 * np.sin(0.7 * k), 0.0, 0.1 * np.sin(0.37 * k)])
        truth.append(se2.compose(truth[-1], turned))
    true = np.array(truth)
    moved = se2.between(true[:-1], true[1:]) + rng.normal(0.0, ODOMETRY, (len(true) - 1, 3))
    poses = [true[0]]
    for each in moved:
        poses.append(se2.compose(poses[-1], each))
    i = np.arange(0, (n_laps - 1) * n, every)
    j = i + n
    mean = se2.between(true[i], true[j]) + rng.normal(0.0, CLOSURE, (len(i), 3))
    wrong_i, wrong_j, wrong = [], [], []
    for _ in range(n_wrong):
        a, b = sorted(rng.choice(len(true) - 5, 2, replace=False).tolist())
        wrong_i.append(a)
        wrong_j.append(b + 5)
        wrong.append(rng.uniform([-2.0, -2.0, -np.pi], [2.0, 2.0, np.pi]))
    for size in groups:
        a, b = sorted(rng.choice(len(true) - size - 10, 2, replace=False).tolist())
        b += 10
        off = rng.uniform([-3.0, -3.0, -np.pi], [3.0, 3.0, np.pi])
        for k in range(size):
            there = se2.between(se2.between(true[a], true[a + k]), off)
            wrong_i.append(a + k)
            wrong_j.append(b + k)
            wrong.append(se2.compose(there, se2.between(true[b], true[b + k]))
                         + rng.normal(0.0, CLOSURE))
    right = np.repeat((True, False), (len(i), len(wrong)))
    graph = Graph()
    graph.apply(GraphUpdate(
        hidden=se2.wrapped(np.array(poses)), fix=(0,),
        factors=Factors.joined((
            _edges(np.arange(len(moved)), np.arange(1, len(true)), moved, ODOMETRY,
                   FactorKind.ODOMETRY),
            _edges(np.append(i, wrong_i).astype(np.int64), np.append(j, wrong_j).astype(np.int64),
                   np.vstack((mean, np.reshape(wrong, (-1, 3)))), CLOSURE,
                   FactorKind.LOOP_CLOSURE)))))
    return Drive(graph, len(moved) + np.arange(len(right)), right, true)


def _edges(
    i: IntArray, j: IntArray, mean: FloatArray, sigmas: tuple[float, ...], kind: FactorKind,
) -> Factors:
    information = np.tile(np.diag(1.0 / np.square(sigmas)), (len(i), 1, 1))
    return Factors(i, j, se2.wrapped(mean), information, [kind] * len(i))
