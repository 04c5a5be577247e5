# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A script around GTSAM that does what `pose-graph solve FILE -o OUT` does.

It is run as a program of its own, so it imports nothing of this project. All in it that takes long
is GTSAM's C++; files with the information in TORO's order are read by its `load2D` as well.
"""

import sys

import gtsam

PRIOR_SIGMA = 1e-5  # of the pose of the first node, as good as fixed [m, rad]
# as tight as ours in effect: chi2 to 1e-9
TOLERANCE = 1e-9
MAX_ITERATIONS = 200


def main() -> None:
    """Solve a graph: arguments FILE, OUT, g2o or toro, start, and optimiser."""
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
    params = (gtsam.GaussNewtonParams() if method == 'gn'
              else gtsam.LevenbergMarquardtParams())
    params.setRelativeErrorTol(TOLERANCE)
    params.setAbsoluteErrorTol(TOLERANCE)
    params.setMaxIterations(MAX_ITERATIONS)
    optimizer = (gtsam.GaussNewtonOptimizer if method == 'gn'
                 else gtsam.LevenbergMarquardtOptimizer)(graph, initial, params)
    result = optimizer.optimize()
    gtsam.writeG2o(graph, result, out)
    print(repr(2.0 * graph.error(result)), optimizer.iterations())


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
