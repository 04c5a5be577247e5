# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Robust losses over the whole drive: of GTSAM where it is installed, else of our batch optimiser.

GTSAM gets a node at each fix and in each second, odometry with the noise of our default model, and
fixes as they claim, and starts from its least squares of all of them. GNC knows that odometry is
right.
"""

from importlib.util import find_spec

import numpy as np

from benchmark.belief.engine import at_end, config, fix_stamps
from benchmark.drives import Drive, SECOND
from pose_graph_ros.core.config import Loss, MeasurementSource, Robust
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.trajectory import fit_motion, Trajectory
from pose_graph_ros.core.graph.constraints import FactorKind, Factors
from pose_graph_ros.core.measurements import Position
from pose_graph_ros.offline.simulation.sensors import model_variances

LOSSES = {'Huber': 1.345, 'Cauchy': 2.385}
"""GTSAM's names, and the thresholds for 95 % of the accuracy of least squares [sigma]."""
GNC = 'GNC-TLS'
FLOOR = 0.002
"""Added to the sigmas of a step of odometry, which may stand still [m, rad]."""
PROBABILITY = 0.99
"""With which a right fix is within the threshold of GNC."""
OURS = {'Huber': Loss.HUBER, 'Cauchy': Loss.CAUCHY, GNC: Loss.TRUNCATED}
HAS_GTSAM = find_spec('gtsam') is not None
SAID = 'GTSAM' if HAS_GTSAM else 'the losses of our batch optimiser'

if HAS_GTSAM:
    import gtsam

    from benchmark import gtsam_peer

    class _WithLoss(gtsam_peer.Models):
        """Noise models with a loss."""

        def __init__(self, name: str) -> None:
            super().__init__()
            self._loss = getattr(gtsam.noiseModel.mEstimator, name).Create(LOSSES[name])

        def of(self, information: se2.FloatArray) -> gtsam.noiseModel.Robust:
            """Return the model of an information."""
            return gtsam.noiseModel.Robust.Create(self._loss, super().of(information))


def paths(drive: Drive) -> dict[str, Trajectory]:
    """Return the path by each method."""
    if HAS_GTSAM:
        return _by_gtsam(drive)
    return {name: at_end(drive, config(MeasurementSource(robust=Robust.LOSS, loss=loss)))
            for name, loss in OURS.items()}


def _graph(drive: Drive) -> tuple[Trajectory, Factors, Factors]:
    """Return the path by odometry, its edges, and the fixes, on nodes in order."""
    stamps = fix_stamps(drive)
    stamps = np.union1d(stamps, np.arange(stamps[0], stamps[-1], SECOND))
    stamps = stamps[drive.odometry.covers(stamps)]
    odometry = Trajectory(stamps, drive.odometry.at(stamps))
    steps = se2.between(odometry.poses[:-1], odometry.poses[1:])
    weight = 1.0 / (model_variances(steps) + FLOOR**2)
    ahead = np.arange(len(steps))
    edges = Factors(ahead, ahead + 1, steps, weight[:, :, None] * np.eye(3),
                    np.full(len(steps), FactorKind.ODOMETRY))
    fixes = [event for _, event in drive.events() if isinstance(event, Position)
             and odometry.covers(event.stamp_ns)]
    information = np.zeros((len(fixes), 3, 3))
    information[:, :2, :2] = np.linalg.inv([fix.covariance for fix in fixes])
    observed = Factors.on(
        np.searchsorted(stamps, [fix.stamp_ns for fix in fixes]), None,
        np.array([(*fix.position, 0.0) for fix in fixes]), information,
        np.full(len(fixes), FactorKind.POSITION))
    return odometry, edges, observed


def _by_gtsam(drive: Drive) -> dict[str, Trajectory]:
    odometry, edges, observed = _graph(drive)
    chain = gtsam_peer.graph_of(edges, Factors(), gtsam_peer.Models())
    motion = fit_motion(odometry.poses[observed.i, :2], observed.mean[:, :2])
    start = gtsam_peer.values_of(se2.compose(motion, odometry.poses))

    def with_fixes(models: gtsam_peer.Models) -> gtsam.NonlinearFactorGraph:
        graph = chain.clone()
        graph.push_back(gtsam_peer.graph_of(Factors(), observed, models))
        return graph

    plain = with_fixes(gtsam_peer.Models())
    start = gtsam_peer.optimize(plain, start)
    found = {name: gtsam_peer.optimize(with_fixes(_WithLoss(name)), start) for name in LOSSES}
    params = gtsam.GncLMParams()
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(list(range(chain.size())))
    gnc = gtsam.GncLMOptimizer(plain, start, params)
    gnc.setInlierCostThresholdsAtProbability(PROBABILITY)
    found[GNC] = gnc.optimize()
    return {name: Trajectory(odometry.stamps_ns, gtsam_peer.poses_of(values))
            for name, values in found.items()}
