# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
GTSAM on our worlds: iSAM2 step by step, and its batch optimisers.

Kept in GTSAM's favour: of a step only `ISAM2.update` is timed, neither the building of factors nor
`calculateEstimatePose2` of the node before, which runs the back-substitution that iSAM2 puts off.
Node 0 has a tight prior. Cholesky is tried first; where it gives up, the run is done with QR.

GTSAM's error is the logarithm in SE(2), not (3.48): its optima differ a little from ours, and its
estimates are judged by its own `error`. Its recursion needs a large stack from about 100 000
nodes on (`ulimit -s unlimited`); the benchmark stays below that.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from benchmark.runs import Plan, Run, run
from benchmark.worlds import World
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import Factors

PRIOR_SIGMA = 1e-5
"""Of the pose of node 0 [m, rad]: as good as fixed, and no harder for Cholesky than 1e-3."""
MAX_ITERATIONS = 100


@dataclass(frozen=True, slots=True)
class Setting:
    """iSAM2, or with a lag the `IncrementalFixedLagSmoother` on it, and how it relinearizes."""

    skip: int
    """Every so many updates ..."""
    threshold: float
    """... the variables that have moved by more than this [m, rad]."""
    lag: int = 0
    """[nodes]; 0: the whole graph."""

    @property
    def name(self) -> str:
        """As the tables have it."""
        return f'GTSAM skip {self.skip}'

    def smoother(self, factorization: str) -> gtsam.ISAM2 | gtsam.IncrementalFixedLagSmoother:
        """Return a smoother with a factorisation, `CHOLESKY` or `QR`."""
        params = gtsam.ISAM2Params()
        params.relinearizeSkip = self.skip
        params.setRelinearizeThreshold(self.threshold)
        params.setFactorization(factorization)
        if self.lag == 0:
            return gtsam.ISAM2(params)
        # as with its default parameters: slots of factors that have gone are used again
        params.findUnusedFactorSlots = True
        return gtsam.IncrementalFixedLagSmoother(float(self.lag), params)

    def __call__(self, world: World, plan: Plan) -> Run:
        """Run it over a world, with its fastest factorisation that works."""
        engine = _Peer(self, world, 'CHOLESKY')
        try:
            return run(self.name, engine, world, plan)
        except RuntimeError:
            where = f'Cholesky gives up after {engine.step} of {world.n_nodes} steps'
        done = run(self.name, _Peer(self, world, 'QR'), world, plan)
        done.note = f'QR ({where})' + (f'; {done.note}' if done.note else '')
        return done


FAST, CAREFUL = Setting(10, 0.1), Setting(1, 0.01)


class _Peer:
    """A smoother of GTSAM on a world."""

    def __init__(self, setting: Setting, world: World, factorization: str) -> None:
        self.isam, self.world, self.lag = setting.smoother(factorization), world, setting.lag
        self.models, self.step = Models(), 0

    def next(self, k: int) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        """Return what is called in a step."""
        self.step = k
        arrived = step_of(self.world, k, self.isam, self.models)
        if self.lag == 0:
            return self.isam.update, arrived
        return self._update, (k, *arrived, {k: float(k)})

    def _update(self, k: int, *arrived: Any) -> gtsam.Pose2:
        self.isam.update(*arrived)
        return self.isam.calculateEstimatePose2(k)

    def check(self, _k: int, result: Any) -> FloatArray | None:
        """Return the newest pose with a lag."""
        return None if self.lag == 0 else np.array((result.x(), result.y(), result.theta()))

    def poses(self) -> FloatArray:
        """Return the estimate."""
        return poses_of(self.isam.calculateEstimate())


class Models:
    """Noise models by information matrix: most worlds have few different ones."""

    def __init__(self) -> None:
        self._models: dict[bytes, gtsam.noiseModel.Gaussian] = {}

    def of(self, information: FloatArray) -> gtsam.noiseModel.Gaussian:
        """Return the model; GTSAM makes a diagonal one where it can."""
        key = information.tobytes()
        if key not in self._models:
            symmetric = 0.5 * (information + information.T)
            self._models[key] = gtsam.noiseModel.Gaussian.Information(symmetric)
        return self._models[key]


def step_of(
    world: World, k: int, isam: gtsam.ISAM2 | gtsam.FixedLagSmoother, models: Models,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """
    Return what arrives in a step: factors, and the new node's initial guess.

    Parameters
    ----------
    world : World
    k : int
    isam : ISAM2 or FixedLagSmoother, which knows the nodes before
    models : Models

    """
    before = (int(world.edge_stops[k - 1]), int(world.observed_stops[k - 1])) if k else (0, 0)
    edges = world.edges.rows(slice(before[0], int(world.edge_stops[k])))
    observed = world.observed.rows(slice(before[1], int(world.observed_stops[k])))
    factors = graph_of(edges, observed, models)
    values = gtsam.Values()
    if k == 0:
        factors.push_back(_gauge(world))
        values.insert(0, _pose(world.first))
    else:
        i, j, mean = int(edges.i[0]), int(edges.j[0]), edges.mean[0]
        if i > j:
            i, mean = j, se2.inverse(mean)
        values.insert(k, isam.calculateEstimatePose2(i).compose(_pose(mean)))
    return factors, values


def graph_of(
    edges: Factors, observed: Factors, models: Models,
) -> gtsam.NonlinearFactorGraph:
    """Return the factors of constraints; those of observed nodes must have no offset."""
    graph = gtsam.NonlinearFactorGraph()
    for i, j, mean, information in zip(
            edges.i.tolist(), edges.j.tolist(), edges.mean, edges.information, strict=True):
        graph.push_back(gtsam.BetweenFactorPose2(i, j, _pose(mean), models.of(information)))
    for node, mean, information in zip(
            observed.i.tolist(), observed.mean, observed.information, strict=True):
        if information[2, 2] == 0.0:
            # the heading of the mean is zero: errors are in map axes, as GTSAM's are
            graph.push_back(gtsam.PoseTranslationPrior2D(
                node, mean[:2], models.of(np.ascontiguousarray(information[:2, :2]))))
        else:
            graph.push_back(gtsam.PriorFactorPose2(node, _pose(mean), models.of(information)))
    return graph


def whole_graph(world: World, step: int | None = None) -> gtsam.NonlinearFactorGraph:
    """Return all factors that have arrived after a step (the last by default)."""
    graph = graph_of(*world.part(world.n_nodes - 1 if step is None else step), Models())
    graph.push_back(_gauge(world))
    return graph


def values_of(poses: FloatArray) -> gtsam.Values:
    """Return poses, shape (N, 3), as GTSAM holds them."""
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(k, _pose(pose))
    return values


def poses_of(values: gtsam.Values) -> FloatArray:
    """Return the poses, shape (N, 3), in the order of their keys."""
    return np.asarray(gtsam.utilities.extractPose2(values))


def optimize(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, method: str = 'lm', *,
    tolerance: float = 1e-5,
) -> gtsam.Values:
    """
    Optimise a whole graph.

    Parameters
    ----------
    graph : NonlinearFactorGraph
    start : Values
    method : {'lm', 'gn'}
        Levenberg-Marquardt or Gauss-Newton.
    tolerance : float
        On the relative and the absolute decrease of the error; the default is GTSAM's.

    """
    name = {'lm': 'LevenbergMarquardt', 'gn': 'GaussNewton'}[method]
    params = getattr(gtsam, f'{name}Params')()
    params.setMaxIterations(MAX_ITERATIONS)
    params.setRelativeErrorTol(tolerance)
    params.setAbsoluteErrorTol(tolerance)
    return getattr(gtsam, f'{name}Optimizer')(graph, start, params).optimize()


def optimum(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    """Return the minimum that lies downhill, as exactly as GTSAM finds it."""
    best = start
    for method in ('gn', 'lm'):
        try:
            found = optimize(graph, best, method, tolerance=1e-12)
        except RuntimeError:
            continue
        if graph.error(found) <= graph.error(best):
            best = found
            if method == 'gn':
                break
    return best


def _gauge(world: World) -> gtsam.PriorFactorPose2:
    return gtsam.PriorFactorPose2(
        0, _pose(world.first), gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA))


def _pose(pose: FloatArray) -> gtsam.Pose2:
    return gtsam.Pose2(float(pose[0]), float(pose[1]), float(pose[2]))
