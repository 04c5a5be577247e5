# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The factors on the variances of several sources that all residuals together show, with intervals.

Residuals y of the estimate, with the Jacobian J, have the covariance `V = sum_k theta_k V_k` about
J times an unknown step. With `P = V^-1 - V^-1 J (J^T V^-1 J)^-1 J^T V^-1`, restricted maximum
likelihood takes the theta where, of all components, `y^T P V_k P y = tr(P V_k)`; the information
on them is `tr(P V_k P V_l) / 2` (D. A. Harville, "Maximum likelihood approaches to variance
component estimation and to related problems", JASA 1977). Fisher's scoring finds it, on logarithms
of sigmas; the traces are means over random signs z of `z^T L^T P L z`, with `V_k = L L^T` (M. F.
Hutchinson, 1989).

A source has two components, the way and the turn: an error of the heading with what it does to the
position, and what is left of the covariance without it. What odometry alone adds to a loop
closure, from its stamps to the nodes, varies with the components of odometry.

Where the covariances of a source are wrong, the estimate follows it too much or too little, and
the residuals of the others show it as well. So the factors of all sources are found in one
estimate, in which each may be above and below 1 (`analyse`). Sources whose correlated errors the
graph has as a bias keep their covariances, and what their residuals at the estimate show; where
such errors are taken for independent, nothing is known of the others either.
"""

from collections.abc import Mapping, Sequence
import math
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import splu

from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, Covariances, FloatArray, IntArray
from pose_graph_ros.core.graph.factors import errors
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.measurements import Answer
from pose_graph_ros.core.parts import Parts
from pose_graph_ros.core.sources.kinds import attach, closure_covariance
from pose_graph_ros.offline import source_residuals
from pose_graph_ros.offline.source_residuals import inverse, ScaleFit, SourceResiduals, UNKNOWN

# Random signs for each trace: its error is half of that of the squares that it is compared to.
PROBES = 4
# Spread of the logarithm of the factor on a sigma before it is seen: it keeps finite what the
# residuals do not show.
SPREAD = 1.5


class Constraints(NamedTuple):
    """All constraints of a graph that are used."""

    errors: FloatArray  # shape (M, 3)
    measured: BoolArray  # which coordinates are measured, shape (M, 3)
    information: FloatArray  # as claimed, shape (M, 3, 3)
    weight: FloatArray
    jacobian: csr_array  # by all free coordinates of hidden nodes, 3 M rows
    prior: csr_array  # information of dense priors
    rows: IntArray  # of each in the graph


class Found(NamedTuple):
    """The factor on the sigmas of each component."""

    ratios: FloatArray  # shape (K,)
    redundancies: FloatArray
    covariance: FloatArray  # of the logarithms of the ratios, shape (K, K)

    def of(self, which: Sequence[int]) -> dict[str, Any]:
        """Return factor with its interval, and independent residuals, of some together."""
        k = list(which)
        share = np.maximum(self.redundancies[k], 0.0) * self.ratios[k]**2
        total, count = float(np.sum(share)), float(np.sum(self.redundancies[k]))
        if not (total > 0.0 and count > 0.0):
            return {**UNKNOWN, 'independent': 0.0}
        variance = float(share @ self.covariance[np.ix_(k, k)] @ share) / total**2
        independent = 0.5 / variance
        if independent < source_residuals.LEAST_INDEPENDENT:
            return {**UNKNOWN, 'independent': independent}
        ratio, width = math.sqrt(total / count), math.exp(1.96 * math.sqrt(variance))
        return {'ratio': ratio, 'low': ratio / width, 'high': ratio * width,
                'independent': independent}


def split(covariances: Covariances) -> tuple[FloatArray, FloatArray]:
    """Return the parts of covariances without an error of the heading, and with its effects."""
    column, heading = covariances[:, :, 2], covariances[:, 2, 2]
    turn = column[:, :, None] * column[:, None, :] / np.where(
        heading > 0.0, heading, 1.0)[:, None, None]
    return covariances - turn, turn


def constraints(graph: Graph) -> Constraints:
    """Return the constraints of a graph with a weight above 0, linear at its estimate."""
    poses, used = graph.poses, np.flatnonzero(graph.weights > 0.0)
    factors = graph.factors_by_row.rows(used)
    error = errors(poses, factors)
    # derivatives by the nodes of the ends, and their columns
    values, columns = [], []
    for name in 'ijk':
        ends = getattr(factors, name)
        for k in range(3):
            step = np.zeros(3)
            step[k] = 1e-5   # m or rad
            moved = np.concatenate((poses, poses + step, poses - step))
            after, before = (errors(moved, factors.replaced(**{
                name: np.where(ends < 0, ends, ends + part * len(poses))})) for part in (1, 2))
            change = after - before
            change[:, 2] = se2.wrap(change[:, 2])
            values.append(change / 2e-5)
            columns.append(np.tile(3 * np.maximum(ends, 0)[:, None] + k, (1, 3)))
    n, size = 3 * len(error), 3 * len(poses)
    jacobian = csr_array((np.stack(values, axis=2).ravel(), np.stack(columns, axis=2).ravel(),
                          np.arange(0, 9 * n + 1, 9)), shape=(n, size))
    priors = csr_array((size, size))
    for prior in graph.priors:
        at = (3 * graph.node_rows(prior.nodes)[:, None] + np.arange(3)).ravel()
        row, column = np.meshgrid(at, at, indexing='ij')
        priors = priors + csr_array((prior.information.ravel(), (row.ravel(), column.ravel())),
                                    shape=(size, size))
    free = np.repeat(~graph.fixed, 3) & (abs(jacobian).sum(axis=0) > 0.0)
    return Constraints(error, np.diagonal(factors.information, axis1=1, axis2=2) > 0.0,
                       factors.information, factors.weight, jacobian[:, free],
                       priors[free][:, free], used)


def restricted_likelihood(data: Constraints, components: FloatArray,
                          fixed: FloatArray) -> Found | None:
    """
    Return the factors on the sigmas of components; None if they cannot be found.

    `components`, shape (K, M, 3, 3), are covariances as claimed, zero where a constraint has no
    such part; `fixed`, shape (M, 3, 3), those that keep their size.
    """
    values, vectors = np.linalg.eigh(components)
    # what rounding leaves of a zero is none
    values = np.where(values > 1e-9 * values[..., -1:], values, 0.0)
    # the symmetric root is the only one that does not depend on the processor's choice of
    # eigenvectors, and with it the random traces
    roots: Any = (vectors * np.sqrt(values)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    ranks = np.count_nonzero(values, axis=-1)
    signs: FloatArray = np.asarray(np.random.default_rng(0).integers(
        0, 2, size=(len(fixed), 3, PROBES)) * 2.0 - 1.0, dtype=np.float64)
    # at the optimum, the gradient of priors is the opposite of that of all others
    weights = data.weight[:, None, None] * data.information
    right = None if data.prior.nnz == 0 else -data.jacobian.T @ np.einsum(
        'mij,mj->mi', weights, data.errors).ravel()
    logs, moved = np.zeros((2, len(components)))
    try:
        for _ in range(30):
            scaled = np.exp(logs)[:, None, None, None] * roots
            total = fixed + np.einsum('kmij,kmlj->mil', scaled, scaled)
            traces, information, squares = _statistics(
                data, total, scaled, ranks, signs, right=right)
            information += np.eye(len(logs)) / SPREAD**2
            step = np.linalg.solve(information, squares - traces - logs / SPREAD**2)
            # where little is known, the information changes with each step, which goes too far
            moved = np.where(step * moved < 0.0, 0.5, 1.0) * np.clip(step, -1.0, 1.0)
            logs += moved
            # a tenth of its uncertainty
            if step @ information @ step < 0.1**2:
                return Found(np.exp(logs), traces,
                             np.asarray((1.0 + 1.0 / PROBES) * np.linalg.inv(information)))
    except (np.linalg.LinAlgError, RuntimeError):
        # covariances or the matrix of the normal equations are singular
        return None
    return None


def _statistics(data: Constraints, total: FloatArray, roots: FloatArray, ranks: IntArray,
                signs: FloatArray, *,
                right: FloatArray | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return tr(P V_k), the information on the logarithms of sigmas, and squared residuals."""
    n, weights, ends = len(roots), inverse(total, data.measured), np.arange(len(total) + 1)
    weighted = (bsr_array((weights, ends[:-1], ends)) @ data.jacobian).tocsr()
    hessian = data.jacobian.T @ weighted + data.prior
    solver = splu(hessian.tocsc(), permc_spec='MMD_AT_PLUS_A', diag_pivot_thresh=0.0,
                  options={'SymmetricMode': True})

    def project(values: FloatArray, right: FloatArray | None = None) -> FloatArray:
        """Return P v of C vectors, (M, 3, C), with what is added to the step's right-hand side."""
        step = weighted.T @ values.reshape(-1, values.shape[2])
        step = solver.solve(step if right is None else step + right[:, None])
        return np.asarray(weights @ values - (weighted @ step).reshape(values.shape))

    residuals = project(data.errors[:, :, None], right)[:, :, 0]
    traces, squares, products = np.zeros(n), np.zeros(n), np.zeros((n, n))
    there = [np.flatnonzero(np.any(each != 0.0, axis=(1, 2))) for each in roots]
    own = [each[rows] for each, rows in zip(roots, there, strict=True)]
    back = [np.swapaxes(each, 1, 2) for each in own]
    for k, rows in enumerate(there):
        drawn = np.zeros_like(signs)
        drawn[rows] = own[k] @ signs[rows]
        drawn = project(drawn)
        for m, others in enumerate(there):
            spread = back[m] @ drawn[others]
            products[m, k] = np.sum(spread**2) / PROBES
            if m == k:
                traces[k] = np.sum(spread * signs[rows]) / PROBES
        energies = np.sum(np.einsum('mij,mj->mi', back[k], residuals[rows])**2, axis=1)
        freedom = ranks[k, rows]
        squares[k] = np.sum(source_residuals.bounded(
            energies, traces[k] / np.sum(freedom) * freedom, freedom))
    return traces, products + products.T, squares


class Analysis(NamedTuple):
    """The residuals of a source, and how large its true sigmas are."""

    residuals: SourceResiduals  # at the estimate
    fit: ScaleFit  # how large they are, with the factors of all sources in one estimate
    whiteness: source_residuals.Whiteness | None
    # whether it has correlated errors that the graph takes for independent: the residuals do not
    # show how large these are, and what those of other sources show may be because of them
    correlated: bool


def analyse(parts: Parts) -> dict[str, Analysis]:
    """
    Return the residuals of each source, and the factors on sigmas that they show together.

    All edits of the engine have been solved for.
    """
    residuals, nodes = source_residuals.collect(parts), parts.nodes
    if nodes.primary in residuals:
        # its edges have the noise that was found, and a ratio is one to what is claimed
        of_odometry = residuals[nodes.primary]
        residuals[nodes.primary] = of_odometry._replace(
            scale=of_odometry.scale * nodes.errors.mean_sigma)
    fits = {source: source_residuals.fit(each, parts.factors.errors_in_use(source))
            for source, each in residuals.items()}
    white = {source: each for source, each in residuals.items()
             if each.kind != 'map' or np.all(parts.graph.factors_at(each.ids).j < 0)}
    series = {source: source_residuals.whiteness(each) for source, each in residuals.items()}
    correlated = {source for source, each in white.items() if each.kind == 'map' and (
        found := series[source]) is not None and found.tau > 0.0}
    if len(correlated) == 0:
        fits |= _together(parts, fits, white)
    return {source: Analysis(each, fits[source], series[source], source in correlated)
            for source, each in residuals.items()}


def _together(parts: Parts, at_estimate: Mapping[str, ScaleFit],
              sources: Mapping[str, SourceResiduals]) -> dict[str, ScaleFit]:
    """Return the fits of some sources with the factors of all of them in one estimate."""
    graph, nodes = parts.graph, parts.nodes
    data = constraints(graph)
    try:
        claimed = inverse(data.information, data.measured)
    except np.linalg.LinAlgError:   # what thinning leaves has no covariance
        return {source: at_estimate[source].unknown for source in sources}
    place = np.full(graph.n_factors, -1)
    place[data.rows] = np.arange(len(data.rows))
    own, shares = claimed.copy(), {source: np.zeros_like(claimed) for source in sources}
    # what odometry adds to loop closures
    ids, stamps_ns = parts.judge.closures()
    for k, mean, (stamp, other) in zip(place[graph.factor_rows(ids)].tolist(), graph.factors_at(
            ids).mean, stamps_ns.tolist(), strict=True):
        reference, attachment = attach(nodes, other), attach(nodes, stamp)
        if isinstance(reference, Answer) or isinstance(attachment, Answer):
            continue
        source = nodes.primary_at(stamp)
        pose = se2.compose(se2.compose(se2.inverse(reference.motion), mean), attachment.motion)
        motion = closure_covariance(np.zeros((3, 3)), pose, reference, attachment)
        # of a graph that was loaded, less is known of what odometry has added
        if k >= 0 and source in shares and np.linalg.eigvalsh(claimed[k] - motion)[0] > 0.0:
            shares[source][k], own[k] = motion, claimed[k] - motion
    fixed = claimed / data.weight[:, None, None]
    rows = {source: place[graph.factor_rows(each.ids)][each.used]
            for source, each in sources.items()}
    for source, at in rows.items():
        shares[source][at] += own[at]
        fixed[at] = 0.0
    components = {(source, kind): part for source, whole in shares.items()
                  for kind, part in enumerate(split(whole)) if np.any(part)}
    found = restricted_likelihood(data, np.array(list(components.values())), fixed)
    if found is None:
        return {source: at_estimate[source].unknown for source in sources}
    # the factors of all in place of those that each source alone shows
    fits = {}
    for source, at in rows.items():
        if len(at) == 0:
            continue
        in_use = nodes.errors.mean_sigma if source == nodes.primary else 1.0
        sigmas = np.sqrt(np.mean(np.diagonal(own[at], axis1=1, axis2=2), axis=0)) / in_use
        scaled = found._replace(ratios=in_use * found.ratios)
        numbers = {kind: k for k, (name, kind) in enumerate(components) if name == source}
        fits[source] = at_estimate[source]._replace(rows=tuple(row._replace(
            **scaled.of([k for kind, k in numbers.items() if kind == row.coordinate // 2]) | {
                'sigma': float(sigmas[row.coordinate]), 'independent': row.independent})
            for row in at_estimate[source].rows), **scaled.of([*numbers.values()]))
    return fits
