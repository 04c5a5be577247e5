# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the node says of itself in /diagnostics."""

from collections import Counter
from collections.abc import Mapping, Sequence
import math

from diagnostic_msgs.msg import DiagnosticStatus

from pose_graph_ros.core.batch import Status
from pose_graph_ros.core.estimate import AlignmentState, Estimate
from pose_graph_ros.core.joining import LEAST_ENERGY, SourceReport
from pose_graph_ros.ros.hearing import Hearing
from pose_graph_ros.ros.reader import MessageReader
from pose_graph_ros.ros.worker import Worker


def state(
    worker: Worker, received: Counter[str], refused: Counter[tuple[str, str]],
) -> dict[str, object]:
    """Return the counts by source and reason, and the state of graph and solver."""
    status, estimate = worker.status, worker.estimate
    values: dict[str, object] = {
        'received': sum(received.values()),
        'processed': status.processed + sum(refused.values()),
        'pending': status.pending, 'quarantined': status.quarantined,
        'updates': status.updates, 'prepared': int(worker.prepared),
        'solve_mean_ms': f'{1e3 * status.solve_mean:.3f}',
        'solve_max_ms': f'{1e3 * status.solve_max:.3f}'}
    for source, count in sorted(received.items()):
        values[f'received.{source}'] = count
    for (source, answer), count in sorted((status.counts + refused).items()):
        values[f'{source}.{answer}'] = count
    if estimate is not None:
        values.update({
            'odometry': estimate.lead,
            'alignment': estimate.alignment.value,
            'alignment_sigma_deg': f'{math.degrees(estimate.alignment_sigma):.3f}',
            'hidden_nodes': estimate.n_hidden, 'edges': estimate.n_edges,
            'observed_nodes': estimate.n_observed, 'biases': estimate.n_biases,
            'chi2': f'{estimate.chi2:.6g}'})
    return values


def inputs(reader: MessageReader, hearing: Hearing, now: float) -> dict[str, object]:
    """Return how long each source has been silent, where antennas are, and the datum."""
    values: dict[str, object] = {}
    for name in reader.sources:
        silence = hearing.silence(name, now)
        values[f'{name}.silence_s'] = 'never heard' if silence is None else f'{silence:.1f}'
    for name, fixes in reader.fixes.items():
        if fixes.antenna is not None:
            x, y = fixes.antenna.lever_arm
            values[f'{name}.lever_arm'] = f'[{x:.3f}, {y:.3f}] from {fixes.antenna.origin}'
            values[f'{name}.without_lever_arm'] = fixes.without_lever_arm
    plane = reader.datum.plane
    values['datum'] = 'none' if plane is None else (
        f'[{plane.latitude:.9f}, {plane.longitude:.9f}, {plane.yaw:.6f}]')
    return values


def fits(worker: Worker) -> dict[str, object]:
    """Return how well the measurements of each source fit the estimate."""
    values: dict[str, object] = {}
    for name, report in worker.status.sources.items():
        # 1 where the sigmas are right, less where a source is all that the estimate has
        values[f'{name}.squared_residual'] = f'{report.energy:.4g}'
        errors = report.errors
        if errors.significant and report.energy >= LEAST_ENERGY:
            values[f'{name}.errors_live'] = (
                f'{errors.tau:.2g} s, with a sigma of {errors.sigma_correlated:.2g} m'
                + (f'; they are treated as white: set {name}.correlation_time'
                   if report.wrongly_white else ''))
    return values


def health(
    worker: Worker, silent: Sequence[str], odometry: Sequence[str],
) -> tuple[bytes, str]:
    """
    Return the level of the diagnostics and a sentence that says what to do.

    Parameters
    ----------
    worker : Worker
    silent : sequence of str
        Sources that have ended while others go on.
    odometry : sequence of str
        Topics of odometry.

    """
    estimate, report = worker.estimate, worker.status.report
    if not worker.alive:
        return DiagnosticStatus.ERROR, 'The worker has ended: start the node again.'
    if report is not None and report.status is Status.FAILED:
        return (DiagnosticStatus.ERROR, 'The newest measurements made the solver fail and were '
                'set aside; the last good estimate stays. See the log for the reason.')
    if estimate is None:
        return DiagnosticStatus.WARN, (
            f'No odometry yet: check {" or ".join(odometry)}.' if worker.prepared else
            'Compiling, as at every first start: what comes in waits.')
    if len(silent) > 0:
        verb = 'is' if len(silent) == 1 else 'are'
        return (DiagnosticStatus.WARN,
                f'{" and ".join(silent)} {verb} silent, others go on: check the drivers.')
    return _fit(estimate, worker.status.sources)


def _fit(estimate: Estimate, sources: Mapping[str, SourceReport]) -> tuple[bytes, str]:
    if estimate.alignment is AlignmentState.UNALIGNED:
        return (DiagnosticStatus.WARN, 'Unaligned: the angle between odometry and map is not '
                'known yet. Drive some metres with a fix.')
    if estimate.alignment is AlignmentState.LOCAL:
        return (DiagnosticStatus.OK, 'Running; nothing was measured in the map, which begins '
                'where odometry does.')
    for name, report in sources.items():
        if report.wrongly_white:
            return (DiagnosticStatus.WARN, f'The errors of {name} live on but are treated as '
                    f'white, so the covariances are too small: set {name}.correlation_time to '
                    f'about {report.errors.tau:.2g} s.')
    return DiagnosticStatus.OK, 'Running.'
