# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A dense Gaussian prior over poses as edges and observed nodes, conservatively.

A prior over k poses connects every pair of them. Here it becomes a tree: edges between the poses
and, if the prior tells of the map, observed nodes, which are edges to one more node, the map. Of
all trees the one with the smallest sum of `log det` of the covariances of its relative poses is
the nearest in the sense of Kullback and Leibler, as the coordinates of a tree have the determinant
1: the tree of C. Chow and C. Liu ("Approximating discrete probability distributions with
dependence trees", IEEE Trans. Inf. Theory 14, 1968). The information of its edges is then chosen
by `conservative.nearest_below`, so that nothing is told that the prior does not tell.

All is linear in map axes at the reference poses. With d = t_j - t_i, an edge measures

    h_j - T h_i,        T = ((1, 0, -d_y), (0, 1, d_x), (0, 0, 1))

for displacements h of the poses, and an observed node measures h_i. Directions that the prior
tells nothing of (rounding apart) get no information: a prior without absolute information becomes
edges alone. docs/solver.md has the derivation.

A bias becomes a prior on it and one pose: given the displacements h of the pose, those b of the
bias have the best linear prediction C h. So `b - C h` is measured, with the covariance that it has
by the prior, by the pose with which that is smallest.
"""

from typing import NamedTuple

import numpy as np

from pose_graph_ros.core.geometry import covariance as cov, se2
from pose_graph_ros.core.geometry.se2 import FloatArray, IntArray
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.graph.priors import Prior
from pose_graph_ros.core.marginalization import conservative

# Eigenvalues of the scaled information below this part of the largest one are rounding. The second
# one is for priors whose covariances are singular in double precision with the first one.
_RANK, _SURER_RANK = 1e-10, 1e-7
# What is known no better than that is in these units: its own ones would make much of rounding.
_LEAST_KNOWN = np.array((1e4, 1e4, 10.0))
# A measurement sees an undetermined direction if it is above this part of its size.
_SEEN = 1e-6


class SparsePrior(NamedTuple):
    """A prior as factors."""

    factors: Factors    # edges, then observed nodes
    divergence: float   # of Kullback and Leibler, of the constraints from the prior [nats]
    priors: tuple[Prior, ...] = ()  # of each bias, on it and a pose


class _Candidates(NamedTuple):
    """Measurements between pairs of poses, and of poses in the map (node k)."""

    i: IntArray     # (C,); k stands for the map
    j: IntArray
    rows: FloatArray    # (C, 3, r) where the prior is I, and with covariance I
    roots: FloatArray   # (C, 3, 3) turn information for `rows` into that in map axes
    weights: FloatArray     # (C,) `log det` of the covariance


def sparsify(prior: Prior, *, n_extra: int = 0, enough: float = 1e-9,
             n_biases: int = 0) -> SparsePrior:
    """
    Return edges and observed nodes that approximate a prior and tell no more than it.

    They have their minimum where the prior has it, `information @ delta = vector` in map axes at
    the reference poses, or nearer where that is out of its reach (`_minimum`). Without an anchor
    the null space is that of motions of all poses as one body. At most `n_extra` edges beyond the
    tree are added, as many as there are nodes at a time, until the divergence is `enough` [nats].
    The last `n_biases` nodes are biases; then the prior is anchored. Raises LinAlgError if the
    prior is too stiff for double precision, or if what it does not tell of a bias is not that of a
    pose.
    """
    nodes, poses, k = prior.nodes, prior.reference, len(prior.nodes) - n_biases
    basis, free = _basis(prior, _RANK)
    try:
        found = _candidates(poses[:k], basis, free, prior.anchored)
    except np.linalg.LinAlgError:
        basis, free = _basis(prior, _SURER_RANK)
        found = _candidates(poses[:k], basis, free, prior.anchored)
    displaced = poses, _minimum(basis, prior.vector, k).reshape(-1, 3)
    # a bias of less than three coordinates is padded, which rounding is not to tell of
    basis[3 * k:][np.diagonal(prior.information)[3 * k:] == 0.0] = 0.0
    gains = list[FloatArray]()
    for row in range(k, k + n_biases):
        gain, measured = _of_bias(basis, free, k, row)
        gains.append(gain)
        found = _Candidates(*map(np.concatenate, zip(*[found, measured], strict=True)))
    chosen = _spanning_tree(found, k + n_biases + (1 if prior.anchored else 0))
    chosen = chosen[np.any(found.rows[chosen] != 0.0, axis=(1, 2))]
    if len(chosen) == 0:
        return SparsePrior(Factors(), 0.0)
    most = len(chosen) + n_extra
    while True:
        blocks = conservative.nearest_below(found.rows[chosen])
        distance = conservative.divergence(found.rows[chosen], blocks)
        if len(chosen) >= most or not distance > enough:
            break
        extra = _overestimated(found, chosen, blocks)[:min(k, most - len(chosen))]
        if len(extra) == 0:
            break
        chosen = np.append(chosen, extra)
    roots = found.roots[chosen]
    in_map = np.matmul(np.matmul(roots, blocks), np.swapaxes(roots, 1, 2))
    i, j = found.i[chosen], found.j[chosen]
    is_edge, is_seen = (i < k) & (j < k), i == k
    edges = edges_between(nodes, displaced, i[is_edge], j[is_edge], in_map[is_edge])
    rows = j[is_seen]
    mean = se2.wrapped(poses[rows] + displaced[1][rows])
    seen = Factors.on(
        nodes[rows], mean=mean, information=turned(in_map[is_seen], mean[:, 2]),
        kind=np.full(len(rows), FactorKind.NODE_PRIOR, dtype=np.uint8))
    priors = tuple(
        _on_bias(nodes, displaced, np.array((i[at], j[at] - 1)), gains[j[at] - k - 1], in_map[at])
        for at in np.flatnonzero(j > k))
    return SparsePrior(Factors.joined([edges, seen]), distance, priors)


def _basis(prior: Prior, rank: float) -> tuple[FloatArray, FloatArray]:
    """
    Return T, (3 k, r), with `T^T information T = I`, and a basis of the null space, (3 k, n).

    The null space of a prior that is not anchored is known, and is kept to rounding; of that basis
    it is left out, as no relative pose sees it.
    """
    poses, information = prior.reference, prior.information
    units = np.tile(_LEAST_KNOWN, len(poses))
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(information), units**-2.0))
    scaled = 0.5 * (information + information.T) * scale[:, None] * scale
    n_gauge = 0
    if not prior.anchored:
        motions = np.tile(np.eye(3), (len(poses), 1))   # of all poses as one body
        motions[0::3, 2] = -(poses[:, 1] - poses[0, 1])
        motions[1::3, 2] = poses[:, 0] - poses[0, 0]
        gauge = np.linalg.qr(motions / scale[:, None])[0]
        n_gauge = 3
        scaled = scaled - gauge @ (gauge.T @ scaled)
        scaled = scaled - (scaled @ gauge) @ gauge.T
        # above all others, so that they are the last ones
        scaled = scaled + 2.0 * np.trace(scaled) * gauge @ gauge.T
    values, vectors = np.linalg.eigh(scaled)
    values, vectors = values[:len(values) - n_gauge], vectors[:, :len(values) - n_gauge]
    kept = values > rank * values[-1] if len(values) > 0 else np.zeros(0, dtype=bool)
    return (scale[:, None] * vectors[:, kept] / np.sqrt(values[kept]),
            scale[:, None] * vectors[:, ~kept])


def _minimum(basis: FloatArray, vector: FloatArray, n_poses: int) -> FloatArray:
    """
    Return the displacements of the minimum of a prior, shape (3 k,).

    Where they turn a pose by more than the linear model bears, the headings are damped as in
    D. Marquardt ("An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11,
    1963), just so much that they do not. That concerns directions that are next to unknown first.
    """
    wanted = basis.T @ vector
    at = slice(2, 3 * n_poses, 3)
    delta, headings = basis @ wanted, basis[at]
    left, sigmas, _ = np.linalg.svd(headings.T, full_matrices=False)
    damping = 1.0 / max(float(np.max(sigmas, initial=0.0))**2, 1e-300)
    # a direction that is next to unknown may have it turns away, where the model is meaningless
    while np.max(np.abs(delta[at]), initial=0.0) > 0.5:
        # (I + damping H^T H)^-1, with the rows H of the headings
        gain = damping * sigmas**2 / (1.0 + damping * sigmas**2)
        delta = basis @ (wanted - left @ (gain * (left.T @ wanted)))
        damping *= 4.0
    return np.asarray(delta)


def _candidates(poses: FloatArray, basis: FloatArray, free: FloatArray,
                anchored: bool) -> _Candidates:
    """Return all measurements that a tree may consist of."""
    n = len(poses)
    of_poses = [each[:3 * n].reshape(n, 3, -1) for each in (basis, free)]
    i, j = np.triu_indices(n, 1)
    rows, seen = (_relative(poses, each, i, j) for each in of_poses)
    if anchored:
        rows, seen = map(np.concatenate, zip((rows, seen), of_poses, strict=True))
        i, j = np.append(i, np.full(n, n)), np.append(j, np.arange(n))
    # both in units of the measurement's own coordinates
    size = np.sqrt(np.sum(rows**2, axis=2) + np.sum(seen**2, axis=2))
    size[size == 0.0] = 1.0
    left, values, _ = np.linalg.svd(seen / size[:, :, None])
    n_seen = np.count_nonzero(values > _SEEN, axis=1)
    is_seen = np.arange(3) < n_seen[:, None]
    # each is restricted to what the prior determines of it; what it does not is padding
    known = np.where(is_seen[:, None], 0.0, left / size[:, :, None])
    reduced = np.swapaxes(known, 1, 2) @ rows
    factors = np.linalg.cholesky(
        reduced @ np.swapaxes(reduced, 1, 2) + np.eye(3) * is_seen[:, None])
    inverse = np.linalg.inv(factors)
    # undetermined directions count more than any covariance
    weights = 1e3 * n_seen + 2.0 * np.sum(np.log(size), axis=1) + 2.0 * np.sum(
        np.log(np.diagonal(factors, axis1=1, axis2=2)), axis=1)
    return _Candidates(i, j, inverse @ reduced, known @ np.swapaxes(inverse, 1, 2), weights)


def _relative(poses: FloatArray, at: FloatArray, i: IntArray, j: IntArray) -> FloatArray:
    """Return `h_j - T h_i` of pairs, shape (C, 3, r), from the displacements h, (k, 3, r)."""
    start, end = at[i], at[j]
    arm = poses[j, :2] - poses[i, :2]
    difference = end - start
    difference[:, 0] += arm[:, 1, None] * start[:, 2]
    difference[:, 1] -= arm[:, 0, None] * start[:, 2]
    return difference


def _spanning_tree(found: _Candidates, n: int) -> IntArray:
    """Return the rows of the tree over n nodes with the smallest sum of weights."""
    # 150 modules, with 15 MB
    from scipy.sparse import csr_array  # noqa: PLC0415  most graphs do not need it
    from scipy.sparse.csgraph import minimum_spanning_tree  # noqa: PLC0415  most graphs do not need it

    ends = found.i, found.j
    weights = found.weights - np.min(found.weights, initial=0.0) + 1.0  # 0 stands for no edge
    row = np.zeros((n, n), dtype=np.int64)
    row[ends] = np.arange(len(weights))
    tree = minimum_spanning_tree(csr_array((weights, ends), shape=(n, n)))
    return np.sort(row[tree.nonzero()])


def _overestimated(found: _Candidates, chosen: IntArray, blocks: FloatArray) -> IntArray:
    """Return the other candidates by how much the chosen ones overestimate their covariance."""
    information = np.einsum('mir,mij,mjs->rs', found.rows[chosen], blocks, found.rows[chosen])
    covariance = np.linalg.pinv(information, hermitian=True)
    others = np.setdiff1d(np.flatnonzero(np.any(found.rows != 0.0, axis=(1, 2))), chosen)
    rows = found.rows[others]
    # the true covariance is I; padding counts as known
    predicted = np.matmul(np.matmul(rows, covariance), np.swapaxes(rows, 1, 2))
    padding = ~np.any(rows != 0.0, axis=2)
    gain = np.linalg.slogdet(predicted + np.eye(3) * padding[:, :, None])[1]
    return others[np.argsort(-gain, kind='stable')]


def _of_bias(basis: FloatArray, free: FloatArray, n_poses: int,
             row: int) -> tuple[FloatArray, _Candidates]:
    """
    Return the gain of the measurement `b - gain h` of a bias with the least `log det`, and itself.

    Its gain is such that it sees nothing undetermined; `row` is that of the bias. Its ends are a
    pose and `row + 1`, as the map comes before the biases.
    """
    at = slice(3 * row, 3 * row + 3)
    used = np.any(basis[at] != 0.0, axis=1)
    own, undetermined = basis[at] * used[:, None], free[at] * used[:, None]
    best, least = None, np.inf
    for pose in range(n_poses):
        rows, of_pose = (each[3 * pose:3 * pose + 3] for each in (basis, free))
        left, values, right = np.linalg.svd(of_pose, full_matrices=True)
        n_seen = np.count_nonzero(values > _SEEN * np.max(np.abs(rows), initial=0.0))
        gain = undetermined @ right[:n_seen].T / values[:n_seen] @ left[:, :n_seen].T
        if np.max(np.abs(undetermined - gain @ of_pose), initial=0.0) > _SEEN * np.max(
                np.abs(own), initial=0.0):
            continue
        known = left[:, n_seen:].T @ rows
        rest = (own - gain @ rows) @ known.T
        gain = gain + np.linalg.solve(known @ known.T, rest.T).T @ left[:, n_seen:].T
        rows = (own - gain @ rows) * used[:, None]
        covariance = rows @ rows.T + np.diag(~used)
        weight = np.linalg.slogdet(covariance)[1]
        if weight < least:
            least, best = weight, (pose, gain, rows, covariance)
    if best is None:
        raise np.linalg.LinAlgError('a bias is not determined by any pose')
    pose, gain, rows, covariance = best
    inverse = np.linalg.inv(np.linalg.cholesky(covariance))
    return gain * used[:, None], _Candidates(
        np.array([pose]), np.array([row + 1]), (inverse @ rows)[None],
        (inverse.T * used[:, None])[None], np.zeros(1))


def _on_bias(nodes: IntArray, displaced: tuple[FloatArray, FloatArray], at: IntArray,
             gain: FloatArray, information: FloatArray) -> Prior:
    """Return the prior that a measurement of a bias is, given rows of the pose and the bias."""
    poses, delta = displaced
    jacobian = np.hstack((-gain, np.eye(3)))
    whole = jacobian.T @ information @ jacobian
    whole = 0.5 * (whole + whole.T)
    return Prior(nodes[at], poses[at].copy(), whole, whole @ delta[at].ravel(), 0.0, True)


def edges_between(nodes: IntArray, displaced: tuple[FloatArray, FloatArray], start: IntArray,
                  end: IntArray, in_map: FloatArray) -> Factors:
    """
    Return edges with information in map axes whose minimum is at displacements of poses.

    Start and end are rows of nodes, poses and displacements.
    """
    poses, delta = displaced
    moved = _relative(poses, delta[:, :, None], start, end)[:, :, 0]
    mean, turn = se2.between(poses[start], poses[end]), poses[start, 2]
    # (3.48) is linear in the measured pose, but for its axes
    mean[:, :2] += np.einsum('mji,mj->mi', se2.rotation(turn), moved[:, :2])
    mean[:, 2] = se2.wrap(mean[:, 2] + moved[:, 2])
    return Factors(nodes[start], nodes[end], mean, turned(in_map, turn + mean[:, 2]),
                   np.full(len(start), FactorKind.PRIOR, dtype=np.uint8))


def turned(information: FloatArray, theta: FloatArray) -> FloatArray:
    """Return symmetric information in axes turned by angles, shape (M, 3, 3)."""
    rotated = cov.turned(information, theta)
    return np.asarray(0.5 * (rotated + np.swapaxes(rotated, 1, 2)))
