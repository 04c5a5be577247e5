# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A script around GTSAM that does what `pose-graph solve FILE -o OUT` does, `--robust` included.

    .venv/bin/python -m benchmark.peer graph.g2o result.g2o g2o lago gn

It is run as a program of its own, and loads nothing of this project. All in it that takes long is
GTSAM's C++; files with the information in TORO's order are read by its `load2D` as well. It prints
JSON: chi2, iterations, the time of the optimiser alone [s], and which closures, in the order of
the file, have a weight of at least a half, where the method tells. Edges between consecutive nodes
are no closures, and known to be right.
"""

import json
import sys
import time

import gtsam

PRIOR_SIGMA = 1e-5  # of the pose of the first node, as good as fixed [m, rad]
TOLERANCE, MAX_ITERATIONS = 1e-9, 200
LOSS_ITERATIONS, LOSS_SIGMAS = 100, 1.0
PROBABILITY = 0.99  # with which a right closure is within the threshold of GNC


def main() -> None:
    """Solve a graph: arguments FILE, OUT, g2o or toro, start, and method."""
    path, out, order, start, method = sys.argv[1:]
    noise = (gtsam.NoiseFormat.NoiseFormatTORO if order == 'toro'
             else gtsam.NoiseFormat.NoiseFormatG2O)
    graph, initial = gtsam.load2D(path, None, 0, False, True, noise)
    first = min(initial.keys())
    graph.add(gtsam.PriorFactorPose2(first, initial.atPose2(first),
                                     gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA)))
    if start == 'lago':
        initial = gtsam.lago.initialize(graph)
    elif start == 'chordal':
        initial = chordal(graph)
    closures = ([] if method in ('gn', 'lm') else
                [k for k in range(graph.size()) if is_closure(graph.at(k))])
    optimizer = optimizer_of(graph, initial, method, closures)
    begin = time.perf_counter()
    try:
        result = optimizer.optimize()
    except RuntimeError:    # its Cholesky has given up
        if method in ('gn', 'lm'):
            raise
        result = initial
    seconds = time.perf_counter() - begin
    gtsam.writeG2o(graph, result, out)
    kept = ([bool(optimizer.getWeights()[k] >= 0.5) for k in closures]
            if method.startswith('GNC') else [])
    iterations = 0 if method.startswith('GNC') else optimizer.iterations()
    print(json.dumps({'chi2': 2.0 * graph.error(result), 'iterations': iterations,
                      'seconds': seconds, 'kept': kept}))


def is_closure(factor: gtsam.NonlinearFactor) -> bool:
    """Tell whether a factor is one between nodes that are no neighbours."""
    keys = factor.keys()
    return len(keys) == 2 and abs(keys[1] - keys[0]) != 1


def optimizer_of(
    graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, method: str, closures: list[int],
) -> object:
    """Return an optimiser: gn, lm, GNC-TLS, GNC-GM, or lm with the loss Cauchy or DCS."""
    if method.startswith('GNC'):
        params = gtsam.GncLMParams()
        params.setLossType(getattr(gtsam.GncLossType, method[4:]))
        params.setKnownInliers(sorted(set(range(graph.size())) - set(closures)))
        optimizer = gtsam.GncLMOptimizer(graph, initial, params)
        optimizer.setInlierCostThresholdsAtProbability(PROBABILITY)
        return optimizer
    params = gtsam.GaussNewtonParams() if method == 'gn' else gtsam.LevenbergMarquardtParams()
    if method in ('gn', 'lm'):
        params.setRelativeErrorTol(TOLERANCE)
        params.setAbsoluteErrorTol(TOLERANCE)
        params.setMaxIterations(MAX_ITERATIONS)
    else:
        params.setMaxIterations(LOSS_ITERATIONS)
        loss = getattr(gtsam.noiseModel.mEstimator, method).Create(LOSS_SIGMAS)
        graph = graph.clone()
        for k in closures:
            factor = graph.at(k)
            model = gtsam.noiseModel.Robust.Create(loss, factor.noiseModel())
            graph.replace(k, gtsam.BetweenFactorPose2(*factor.keys(), factor.measured(), model))
    return (gtsam.GaussNewtonOptimizer if method == 'gn'
            else gtsam.LevenbergMarquardtOptimizer)(graph, initial, params)


def chordal(graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """Return GTSAM's chordal start, which it has in space only."""
    spatial = gtsam.NonlinearFactorGraph()
    for k in range(graph.size()):
        factor = graph.at(k)
        keys = factor.keys()
        model = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)
        if len(keys) == 2:
            pose = gtsam.Pose3(factor.measured())
            spatial.add(gtsam.BetweenFactorPose3(keys[0], keys[1], pose, model))
        else:
            spatial.add(gtsam.PriorFactorPose3(keys[0], gtsam.Pose3(factor.prior()), model))
    found = gtsam.InitializePose3.initialize(spatial)
    planar = gtsam.Values()
    keys = found.keys()
    for key in keys:
        pose = found.atPose3(key)
        planar.insert(key, gtsam.Pose2(pose.x(), pose.y(), pose.rotation().yaw()))
    return planar


if __name__ == '__main__':
    main()
