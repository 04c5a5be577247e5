# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What the engine is made of, and what all parts of it together give: estimates and a saved graph.

A measurement is added to the graph once no older odometry can come any more. Until then one that
odometry has passed corrects the newest hidden node by a Kalman filter, for the estimate alone:
the graph, and so what is left in the end, does not depend on it.

The graph is saved with the odometry samples next to the hidden nodes and those of the last minute.
If odometry continues without interruption, later estimates are therefore the same as without
saving. Measurements that wait for odometry are not saved; they can be sent again.
"""

from copy import deepcopy
from itertools import combinations
import math
from typing import NamedTuple

import numpy as np

from pose_graph_ros.core import measurements as ms
from pose_graph_ros.core.alignment import Alignment, AlignmentState, guess
from pose_graph_ros.core.batch.truncated import LIMITS
from pose_graph_ros.core.config import Loss, Robust
from pose_graph_ros.core.estimate import Estimate
from pose_graph_ros.core.exceptions import FileFormatError, NothingToSaveError
from pose_graph_ros.core.geometry import covariance, se2
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.constraints import Factors, full
from pose_graph_ros.core.graph.graph import Graph
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.io.graph_files import SavedGraph
from pose_graph_ros.core.judgement.judge import Judge
from pose_graph_ros.core.judgement.texts import is_notable, sentence
from pose_graph_ros.core.judgement.verdicts import Judged
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes
from pose_graph_ros.core.odometry.motion import AS_CLAIMED
from pose_graph_ros.core.saved_columns import MISMATCHES
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.sources.factor_builder import FactorBuilder
from pose_graph_ros.core.sources.kinds import KINDS, observed
from pose_graph_ros.core.sources.pipeline import MeasurementPipeline
from pose_graph_ros.core.sources.queued import Queued

# Of each source, the number of believed closures whose verdicts are saved as sentences.
MOST_BELIEVED = 2000


class Parts(NamedTuple):
    """Parts of the engine."""

    graph: Graph
    nodes: HiddenNodes
    factors: FactorBuilder
    reweighting: Reweighting
    alignment: Alignment
    pipeline: MeasurementPipeline
    quarantine: list[Queued]
    """Constraints that were set aside after a failed update."""
    judge: Judge
    smoother: IncrementalSmoother


def capture(parts: Parts, cov: FloatArray, chi2: float, datum: MapOrigin | None, *,
            texts: bool) -> SavedGraph:
    """
    Return the state of an engine as a value; NothingToSaveError if there is no hidden node.

    Measurements that wait for odometry are left out and do not count as seen. The covariance is
    that of the newest hidden node, in map axes. The texts are those of verdicts, for people.
    """
    if len(parts.nodes) == 0:
        raise NothingToSaveError('there is no hidden node yet, and so no graph to save')
    pipeline = parts.pipeline
    left_out = pipeline.pending
    return SavedGraph(
        rows=parts.graph.rows(), nodes=parts.nodes.saved(), sources=parts.factors.saved(),
        seen=pipeline.seen.saved(left_out), losses=deepcopy(parts.reweighting),
        alignment=parts.alignment.saved(), waiting=tuple(pipeline.queue),
        set_aside=tuple(parts.quarantine), judgement=parts.judge.saved(),
        verdicts={} if not texts else {
            each.id: sentence(each) for each in parts.judge.verdicts(MOST_BELIEVED)
            if each.kind is Judged.LOOP_CLOSURE or is_notable(each)},
        newest_covariance=cov.copy(), chi2=chi2, n_left_out=len(left_out),
        datum=datum, beacons=dict(pipeline.beacons.ids),
        gyros={name: gyro.saved() for name, gyro in pipeline.gyros.streams.items()})


def restore(parts: Parts, saved: SavedGraph) -> None:
    """
    Fill the parts of a new engine from a saved graph.

    Poses and weights equal the saved ones bit for bit. Whether odometry continues where it was
    saved is decided at its first sample; see `odometry.stream`. Raises FileFormatError where the
    parts of the saved graph contradict each other.
    """
    try:
        parts.graph.fill(saved.rows)
        parts.nodes.restore(saved.nodes)
        parts.pipeline.seen.restore(saved.seen)
        parts.factors.restore(saved.sources)
        for name, gyro in saved.gyros.items():
            parts.pipeline.gyros.stream(name).restore(gyro)
        parts.pipeline.beacons.ids |= saved.beacons
        parts.reweighting.restore(saved.losses)
        parts.alignment.load(saved.alignment)
        parts.judge.restore(saved.judgement, int(parts.nodes.stamps_ns[-1]))
        parts.pipeline.queue += saved.waiting
        parts.quarantine.extend(saved.set_aside)
        parts.reweighting.cost(parts.graph)
        estimate(parts, saved.newest_covariance, saved.chi2, with_path=True)
    except MISMATCHES as error:
        raise FileFormatError(f'the parts of the saved graph do not fit: {error}') from error


class Turns:
    """
    Tells when to do what takes time in proportion to the graph: each time, if that is small.

    In one of 100 000 nodes every hundredth time, so that the mean cost does not grow.
    """

    def __init__(self) -> None:
        self._n: float = math.inf

    def __call__(self, n_nodes: int) -> bool:
        """Tell whether it is time, in a graph of so many nodes."""
        self._n += 1000
        is_due = self._n >= n_nodes
        self._n = 0 if is_due else self._n
        return is_due


def estimate(parts: Parts, cov: FloatArray, chi2: float, *, with_path: bool) -> Estimate:
    """Return the present estimate, given the covariance of the newest hidden node."""
    graph, nodes, factors = parts.graph, parts.nodes, parts.factors
    state, sigma = parts.alignment.state, parts.alignment.sigma
    pose = graph.poses_of(nodes.ids[-1])
    if state is AlignmentState.ALIGNED:
        pose, cov = corrected(parts, pose, cov)
    errors = factors.calibration(nodes.primary, graph)
    motion, motion_noise, odometry = nodes.newest(errors)
    motion, motion_noise = _turned(parts, motion, motion_noise)
    newest = se2.compose(pose, motion)
    cov = covariance.propagated(pose, cov, motion, motion_noise)
    if state is AlignmentState.ALIGNED:
        # by what may have happened, but is not believed
        (x, y, _), spread = parts.judge.fixes.bank.spread
        moved = np.array(((1.0, 0.0, y - newest[1]), (0.0, 1.0, newest[0] - x), (0.0, 0.0, 1.0)))
        cov = cov + moved @ spread @ moved.T
    shift = np.zeros(3)
    if state is AlignmentState.UNALIGNED:
        # if the aligning update failed, its measurements are in the quarantine
        waiting = [each.factor for each in (*parts.pipeline.queue, *parts.quarantine)
                   if each.is_placed]
        if len(waiting) > 0:
            shift, cov = guess(
                graph.poses, newest, Factors.joined(waiting).renumbered(graph.node_rows))
            newest = newest + shift
        else:
            # the nodes of all of them have left the graph
            state = AlignmentState.LOCAL
    stamp_ns = max(nodes.newest_ns, int(nodes.stamps_ns[-1]))
    return Estimate(
        stamp_ns=stamp_ns, T_odom_base=odometry, T_map_base=newest,
        T_map_odom=se2.compose(newest, se2.inverse(odometry)), covariance=cov,
        alignment=state, chi2=chi2, alignment_sigma=(
            math.sqrt(cov[2, 2]) if state is AlignmentState.ALIGNED else sigma),
        n_hidden=len(nodes), n_frozen=nodes.n_frozen, n_thinned=nodes.n_thinned,
        n_priors=graph.n_priors, n_edges=graph.n_edges,
        n_observed=sum(len(each) + each.n_otherwise for each in factors.sources.values()),
        n_biases=graph.n_biases,
        primary=nodes.primary, odometry=factors.config.odometry_source(nodes.primary),
        odometry_errors=nodes.errors if errors == AS_CLAIMED else nodes.errors._replace(
            rate=errors.rate, scale=errors.scale),
        trajectory=None if not with_path else Trajectory(
            nodes.stamps_ns, nodes.poses(graph) + shift).continued(stamp_ns, newest))


def path_covariances(parts: Parts, of: Estimate) -> FloatArray:
    """
    Return the covariances at the poses of the path of the present estimate, in map axes.

    They are NaN where they are unknown: at nodes that have left the graph by its window, and at
    all but the newest pose while the angle between odometry and map is unknown.
    """
    nodes, covariances = parts.nodes, parts.smoother.covariances()
    rows = parts.graph.node_rows(nodes.ids)
    found = np.full((len(of.path), 3, 3), np.nan)
    inside = np.flatnonzero(rows >= 0)
    found[inside] = covariances[rows[inside]]
    for number, anchor, mean, noise in nodes.places().values:
        found[number] = covariance.propagated(
            of.path.poses[anchor], found[anchor], mean, full(noise[None])[0])
    if of.alignment is AlignmentState.UNALIGNED:
        found[:] = np.nan
    found[-1] = of.covariance
    return found


def _turned(parts: Parts, motion: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the motion since the newest node, and its noise, with what a gyroscope says."""
    gyros, nodes = parts.pipeline.gyros, parts.nodes
    rotation = None if len(gyros.streams) == 0 else gyros.newest(
        int(nodes.stamps_ns[-1]), nodes.newest_ns, parts.factors.gyro_rates(parts.graph))
    if rotation is None or noise[2, 2] == 0.0:
        return motion, noise
    angle, variance = rotation
    total = noise[2, 2] + variance
    gain = noise[:, 2] / total
    step = float(se2.wrap(angle - motion[2])) * gain
    # the noise is in the frame at the end of the motion
    turn = se2.rotation(motion[2])
    return (np.append(motion[:2] + turn @ step[:2], motion[2] + step[2]),
            noise - total * np.outer(gain, gain))


def corrected(parts: Parts, pose: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the newest node of an aligned graph and its covariance, by what odometry passed."""
    if parts.graph.has_touched:
        return pose, noise     # an update has failed
    passed = _passed(parts)
    if len(passed) == 0:
        return pose, noise
    ids = [int(parts.nodes.ids[-1]), *sorted({int(edge.j[0]) for edge, _ in passed} - {-1})]
    state, joint = parts.graph.poses_of(ids), _joint(parts.smoother, ids)
    for edge, is_gated in passed:
        error, jacobian, noise = _linearized(edge, state, ids)
        spread = jacobian @ joint @ jacobian.T + noise
        gain = np.linalg.solve(spread, jacobian @ joint).T
        if is_gated and error @ np.linalg.solve(spread, error) > LIMITS[len(error)]:
            continue
        state = state + (gain @ error).reshape(-1, 3)
        joint = joint - gain @ jacobian @ joint
    return se2.wrapped(state[0]), 0.5 * (joint[:3, :3] + joint[:3, :3].T)


def _passed(parts: Parts) -> list[tuple[Factors, bool]]:
    """
    Return what waits for odometry to be settled only, in the order of stamps, and if it is gated.
    """
    pipeline, factors, nodes = parts.pipeline, parts.factors, parts.nodes
    # most of them waited at the last estimate, too, behind the same node
    known, pipeline.ahead = pipeline.ahead, {}
    behind = int(nodes.ids[-1]), sum(each.n_sorted for each in nodes.streams.values())
    for _, source, given in pipeline.waiting_until(nodes.newest_ns):
        # the first one of a source may set the origin of the map, but not before it is attached
        if not factors.has(source):
            continue
        key = source, type(given), given.stamp_ns, behind, factors.treatment(source)
        if (ahead := known.get(key) or _ahead(parts, source, given)) is not None:
            pipeline.ahead[key] = ahead
    return [*pipeline.ahead.values()]


def _ahead(parts: Parts, source: str, given: ms.PoseMeasurement) -> tuple[Factors, bool] | None:
    """Return what waits as a constraint on the newest node; None if it cannot be one yet."""
    attachment = parts.nodes.attach_ahead(given.stamp_ns)
    measurement = None if attachment is None else KINDS[type(given)].in_map(given)
    if attachment is None or measurement is None:
        return None
    settings = parts.factors.config.measurement_source(source, type(measurement))
    return (parts.factors.preview(observed(source, measurement, attachment)),
            settings.robust is Robust.JUDGED or settings.applied_loss is not Loss.NONE)


def _joint(smoother: IncrementalSmoother, ids: list[int]) -> FloatArray:
    """Return the joint covariance of a few nodes, shape (3 N, 3 N)."""
    joint = np.empty((len(ids), 3, len(ids), 3))
    joint[0, :, 0] = smoother.covariance(ids[0])
    for pair in combinations(range(len(ids)), 2):
        joint[np.ix_(pair, range(3), pair, range(3))] = smoother.joint_covariance(
            *(ids[k] for k in pair)).reshape(2, 3, 2, 3)
    return joint.reshape(3 * len(ids), -1)


def _linearized(edge: Factors, state: FloatArray,
                ids: list[int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what was measured less what is expected, its Jacobian, and its covariance."""
    information = edge.weighted_information[0]
    used = np.flatnonzero(np.diagonal(information) > 0.0)
    x, y, factor, factor_heading = edge.constants[0].tolist()
    arm = se2.rotation(state[0, 2]) @ (x, y)
    jacobian = np.zeros((3, 3 * len(ids)))
    jacobian[:, :3] = np.eye(3)
    jacobian[:2, 2] = -arm[1], arm[0]
    error = edge.mean[0] - state[0] - (*arm, 0.0)
    if edge.j[0] >= 0:
        at = ids.index(int(edge.j[0]))
        factors = np.array((factor, factor, factor_heading))
        jacobian[:, 3 * at:3 * at + 3] = -np.diag(factors)
        error = error + factors * state[at]
    error[2] = se2.wrap(error[2])
    return error[used], jacobian[used], np.linalg.inv(information[np.ix_(used, used)])
