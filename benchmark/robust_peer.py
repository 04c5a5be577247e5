# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
GTSAM on a graph with wrong loop closures, as a command of its own.

    .venv/bin/python -m benchmark.robust_peer GNC-TLS graph.g2o result.npz

Each starts from odometry, and knows that edges between consecutive nodes are right. The result has
the poses, the time of the optimiser alone [s], and which closures, in the order of the file, have
a weight of at least a half; none where the method does not tell. Nothing of this project is
loaded.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
import sys
import time
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Result = tuple[Array, float, Array]

PRIOR_SIGMA = 1e-5
MAX_ITERATIONS = 100
PROBABILITY = 0.99
"""With which a right closure is within the threshold of graduated non-convexity."""
CAUCHY, DCS = 1.0, 1.0
"""Thresholds of losses [sigma]."""
UNKNOWN = np.empty(0, dtype=bool)


def read(path: Path) -> tuple[Array, Array, Array, Array]:
    """Return poses, ends, means and information matrices of a g2o file with `EDGE_SE2`."""
    rows = [line.split() for line in path.read_text(encoding='ascii').splitlines()]
    poses = np.array([row[2:5] for row in rows if row[0] == 'VERTEX_SE2'], dtype=float)
    edges = np.array([row[1:] for row in rows if row[0] == 'EDGE_SE2'], dtype=float)
    upper = np.array(((0, 1, 2), (1, 3, 4), (2, 4, 5)))
    return poses, edges[:, :2].astype(int), edges[:, 2:5], edges[:, 5:][:, upper]


def from_odometry(ends: Array, means: Array, n: int) -> Array:
    """
    Return the poses by odometry alone, shape (n, 3).

    Parameters
    ----------
    ends : ndarray of int, shape (M, 2)
    means : ndarray, shape (M, 3)
    n : int

    """
    steps = {int(i): mean for (i, j), mean in zip(ends, means, strict=True) if j == i + 1}
    poses = np.zeros((n, 3))
    for k in range(n - 1):
        x, y, theta = poses[k]
        dx, dy, turn = steps[k]
        c, s = np.cos(theta), np.sin(theta)
        poses[k + 1] = x + c * dx - s * dy, y + s * dx + c * dy, theta + turn
    return poses


def gtsam_gnc(path: Path, loss: str) -> Result:
    """
    Run GncLMOptimizer.

    Parameters
    ----------
    path : Path
    loss : str, `TLS` or `GM`

    """
    graph, start, closures = _gtsam_graph(path, None)
    params = gtsam.GncLMParams()
    params.setLossType(getattr(gtsam.GncLossType, loss))
    params.setKnownInliers(np.flatnonzero(~closures).tolist())
    optimizer = gtsam.GncLMOptimizer(graph, start, params)
    optimizer.setInlierCostThresholdsAtProbability(PROBABILITY)
    begin = time.perf_counter()
    try:
        values = optimizer.optimize()
    except RuntimeError:    # its Cholesky has given up
        values = start
    seconds = time.perf_counter() - begin
    weights = np.asarray(optimizer.getWeights())[closures]
    return _gtsam_poses(values), seconds, weights >= 0.5


def gtsam_loss(path: Path, loss: str, threshold: float) -> Result:
    """
    Run LevenbergMarquardtOptimizer with a robust loss on each closure.

    Parameters
    ----------
    path : Path
    loss : str, of `gtsam.noiseModel.mEstimator`
    threshold : float [sigma]

    """
    estimator = getattr(gtsam.noiseModel.mEstimator, loss).Create(threshold)
    graph, start, _ = _gtsam_graph(path, estimator)
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(MAX_ITERATIONS)
    begin = time.perf_counter()
    try:
        values = gtsam.LevenbergMarquardtOptimizer(graph, start, params).optimize()
    except RuntimeError:
        values = start
    return _gtsam_poses(values), time.perf_counter() - begin, UNKNOWN


def _gtsam_graph(path: Path, estimator: Any) -> tuple[Any, Any, Array]:
    """Return a graph, its start, and which of its factors are closures; the last is a prior."""
    poses, ends, means, information = read(path)
    closures = np.append(np.abs(np.diff(ends, axis=1)[:, 0]) != 1, False)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, (i, j) in enumerate(ends.tolist()):
        model = gtsam.noiseModel.Gaussian.Information(information[k])
        if closures[k] and estimator is not None:
            model = gtsam.noiseModel.Robust.Create(estimator, model)
        graph.push_back(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*means[k].tolist()), model))
    graph.push_back(gtsam.PriorFactorPose2(
        0, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA)))
    for k, pose in enumerate(from_odometry(ends, means, len(poses))):
        values.insert(k, gtsam.Pose2(*pose.tolist()))
    return graph, values, closures


def _gtsam_poses(values: Any) -> Array:
    return np.asarray(gtsam.utilities.extractPose2(values))


METHODS: dict[str, Callable[[Path], Result]] = {
    'GNC-TLS': partial(gtsam_gnc, loss='TLS'),
    'GNC-GM': partial(gtsam_gnc, loss='GM'),
    'LM, Cauchy': partial(gtsam_loss, loss='Cauchy', threshold=CAUCHY),
    'LM, DCS': partial(gtsam_loss, loss='DCS', threshold=DCS),
}


def main(arguments: list[str]) -> int:
    """Run a method on a file."""
    method, graph, result = arguments
    poses, seconds, kept = METHODS[method](Path(graph))
    np.savez(result, poses=poses, seconds=seconds, kept=kept)
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
