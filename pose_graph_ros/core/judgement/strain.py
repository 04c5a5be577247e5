# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where odometry is bent most by closures that are believed: a hint at one of `jumps`."""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.batch.truncated import Choice, TruncatedProblem
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.judgement.closures import GATE
from pose_graph_ros.core.judgement.odometry_motions import Odometry
from pose_graph_ros.core.smoother import innovations

# Least reduction of the truncated cost by a jump [sigma^2]: which edge it is, of many thousands,
# and its size, of all that would fit into the map, have to be told.
PRICE = 35.0
# From how many places a jump is to be seen, and their distance: at most so many metres, and so
# much of the extent of the map.
PLACES, PLACE, PLACE_SHARE = 3, 20.0, 0.2
# Median of chi2 with three degrees of freedom, and least part of the variance of an edge that the
# rest of the graph must leave, so that it says anything on the edge.
USUAL, _FREE = 3.5, 1e-7


class Place(NamedTuple):
    """Where a jump may be."""

    gain: float
    first: int
    last: int
    """Places in the chain between which it is."""
    at: int
    """Where it is tried."""
    total: FloatArray
    """Pose of the last place in the first one, if it is there, shape (3,)."""
    members: IntArray
    """Closures over the jump that show it."""
    against: IntArray
    """Believed closures over the jump that do not agree with it."""


def strained(
    problem: TruncatedProblem, choice: Choice, odometry: Odometry,
) -> tuple[float, list[Place]]:
    """
    Return how large the energies of odometry are, and where it is bent most, if it is.

    Parameters
    ----------
    choice : Choice, what is believed

    """
    gains, without = gains_of(problem, choice, odometry)
    if len(gains) == 0:
        return 1.0, []
    scale = scale_of(gains, problem.lowered())
    place = _where(problem, choice, odometry, (gains, without), scale)
    return scale, [] if place is None else [place]


def scale_of(gains: FloatArray, least: float) -> float:
    """
    Return how large the energies of odometry are.

    Parameters
    ----------
    gains : ndarray, shape (N,), of `gains_of`; not above 0 where an edge says nothing
    least : float

    """
    known = gains[gains > 0.0]
    return max(float(np.median(known)) / USUAL, least) if len(known) > 0 else 1.0


def gains_of(
    problem: TruncatedProblem, choice: Choice, odometry: Odometry,
) -> tuple[FloatArray, FloatArray]:
    """
    Return by how much chi2 is lower without an edge of odometry, and its error then.

    With its error e, its information W and the covariance C of the estimate along it, chi2 would
    be lower by `e^T (W^-1 - C)^-1 e`, and the error be `(1 - C W)^-1 e`. Shapes (N,) and (N, 3).

    Parameters
    ----------
    problem, choice : as in `strained`
    odometry : Odometry, of N + 1 nodes

    """
    graph, n = problem.graph, len(odometry.rows)
    graph.set_poses(choice.poses)
    if n == 0 or not problem.solve(choice.believed.astype(np.float64), go_on=True):
        return np.empty(0), np.empty((0, 3))
    edges = graph.edges_at(odometry.rows)
    errors, covariances = innovations.at_estimate(graph.memory.head, edges)
    # in sigmas: with W = L L^T, L^T C L is between 0 and 1; W may be singular
    information, axes = np.linalg.eigh(edges.weighted_information)
    root = axes * np.sqrt(np.maximum(information, 0.0))[:, None]
    white = np.swapaxes(root, 1, 2)
    values, vectors = np.linalg.eigh(white @ covariances @ root)
    free = 1.0 - values
    along = np.einsum('mij,mi->mj', vectors, np.einsum('mij,mj->mi', white, errors))
    with np.errstate(divide='ignore', invalid='ignore'):
        without = np.where(free > _FREE, along / free, 0.0)
    return np.sum(along * without, axis=1), np.einsum(
        'mij,mj->mi', np.linalg.pinv(white) @ vectors, without)


def _where(
    problem: TruncatedProblem, choice: Choice, odometry: Odometry,
    strain: tuple[FloatArray, FloatArray], scale: float,
) -> Place | None:
    """Return where odometry is bent most, by what several places show; None if hardly."""
    gains, without = strain
    k = int(np.argmax(gains))
    if gains[k] <= PRICE * scale:
        return None
    near = gains > gains[k] - GATE * scale
    first, last = (k - int(np.argmin(np.append(near[k::-1], False))) + 1,
                   k + int(np.argmin(np.append(near[k:], False))))
    motion = se2.compose(odometry.motions[k], without[k])
    ends = problem.edges
    over = choice.believed & (odometry.places(ends.i) <= k) & (odometry.places(ends.j) > k)
    if n_places(choice.poses, ends.rows(over), odometry) < PLACES:
        return None
    total = se2.between(odometry.poses[first], odometry.poses[k])
    total = se2.compose(se2.compose(total, motion),
                        se2.between(odometry.poses[k + 1], odometry.poses[last]))
    return Place(float(gains[k]), first, last, k, total, np.flatnonzero(over),
                 np.empty(0, dtype=np.int64))


def n_places(poses: FloatArray, edges: Edges, odometry: Odometry) -> int:
    """
    Return the number of places that closures are apart from one another at both ends.

    Parameters
    ----------
    poses : ndarray, shape (N, 3)

    """
    path = poses[odometry.nodes, :2]
    size = min(PLACE, PLACE_SHARE * float(np.max(np.ptp(path, axis=0))))
    ends = poses[np.column_stack((edges.i, edges.j)), :2]
    kept = np.empty((0, 2, 2))
    for each in ends:
        if np.all(np.linalg.norm(kept - each, axis=2) >= size):
            kept = np.concatenate((kept, each[None]))
    return len(kept)
