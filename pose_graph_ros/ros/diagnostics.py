# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Values and summary of the node's status in /diagnostics; imports only messages of ROS."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future
import math
import os
from pathlib import Path
import time
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus

from pose_graph_ros.adapters.sources import Kind
from pose_graph_ros.core.alignment.monitor import AlignmentState
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.disagreement import Disagreement
from pose_graph_ros.core.judgement.texts import short, total_values
from pose_graph_ros.core.odometry.turns import CONTRADICTORY, MOST_BIAS
from pose_graph_ros.core.sources.constraint_names import ConstraintEnergy
from pose_graph_ros.core.sources.settings import SOURCES
from pose_graph_ros.ros.worker import Worker

if TYPE_CHECKING:
    from pose_graph_ros.ros.session import Session


def values(session: 'Session') -> dict[str, object]:
    """Return all values of the diagnostics by key."""
    return {**_state(session), **_inputs(session), **_fits(session),
            **total_values(session.worker.status.verdicts)}


def _state(session: 'Session') -> dict[str, object]:
    """Return the counts by source and reason, and the state of graph and solver."""
    worker, received, rejected = session.worker, session.input.received, session.input.rejected
    status, estimate = worker.status, worker.estimate
    found: dict[str, object] = {
        'received': sum(received.values()),
        'processed': status.processed + sum(rejected.values()),
        'pending': status.pending, 'quarantined': status.quarantined,
        'updates': status.updates, 'prepared': int(worker.prepared),
        'active': int(session.active), 'paused': int(session.input.paused),
        'resets': session.n_resets,
        'solve_mean_ms': f'{1e3 * status.solve_mean:.3f}',
        'solve_max_ms': f'{1e3 * status.solve_max:.3f}',
        'memory_mb': f'{memory() / 1e6:.0f}'}
    if session.reset_reason != '':
        found['reset_reason'] = session.reset_reason
    found |= {f'received.{source}': count for source, count in sorted(received.items())}
    found |= {f'{source}.{answer}': count
              for (source, answer), count in sorted((status.counts + rejected).items())}
    found |= {f'{source}.bias': f'{bias:.6f}' for source, bias in status.biases.items()}
    found |= {f'{source}.odometry_difference': ': '.join(filter(None, (
        f'{short(each.sigmas)} sigmas', each.reason)))
        for source, each in status.differences.items()}
    found |= {f'quarantined.{rank}': name for rank, name in enumerate(status.set_aside, 1)}
    if estimate is not None:
        found.update({
            'odometry': estimate.primary, 'alignment': estimate.alignment.value,
            'alignment_yaw_deg': f'{math.degrees(estimate.T_map_odom[2]):.3f}',
            'alignment_sigma_deg': f'{math.degrees(estimate.alignment_sigma):.3f}',
            'hidden_nodes': estimate.n_hidden, 'frozen_nodes': estimate.n_frozen,
            'thinned_nodes': estimate.n_thinned, 'priors': estimate.n_priors,
            'edges': estimate.n_edges, 'observed_nodes': estimate.n_observed,
            'biases': estimate.n_biases, 'chi2': f'{estimate.chi2:.6g}'})
    for rank, largest in enumerate(session.searches.energies, 1):
        found[f'largest_energy.{rank}'] = f'{largest.name}: {short(largest.energy, 4)}' + (
            '' if largest.unweighted == largest.energy else
            f', without its loss {short(largest.unweighted, 4)}')
    return found


class Searches:
    """The constraints with the largest energies, and a source that contradicts the others."""

    def __init__(self) -> None:
        self.energies: Sequence[ConstraintEnergy] = ()
        self.contradiction: Disagreement | None = None
        self.due = 0.0  # time from which on the worker is asked again [s]
        self._n = 0     # number of measurements from which on a contradiction is searched again
        self._asked: Future[tuple[Sequence[ConstraintEnergy], Disagreement | None]] | None = None

    def update(self, worker: Worker) -> None:
        """Search every 5 s; while measurements fit badly, when there are twice as many."""
        now, reports = time.monotonic(), worker.status.sources.values()
        if self._asked is not None and self._asked.done():
            if not self._asked.cancelled() and self._asked.exception() is None:
                self.energies, self.contradiction = self._asked.result()
            self._asked = None
        if not any(report.fits_badly for report in reports):
            self.contradiction, self._n = None, 0
        if self._asked is not None or not worker.prepared or now < self.due:
            return
        self.due, n, known = now + 5.0, sum(report.n for report in reports), self.contradiction
        badly = any(report.fits_badly for report in reports)
        is_new = badly and n >= self._n
        self._n = 2 * n if is_new else self._n
        self._asked = worker.call(lambda backend: (
            backend.largest_energies(3), backend.disagreement() if is_new else known),
            'the largest energies')


def memory() -> int:
    """Return the resident memory of the process [bytes]; 0 if the system does not provide it."""
    try:
        return int(Path('/proc/self/statm').read_text().split()[1]) * os.sysconf('SC_PAGE_SIZE')
    except OSError:
        return 0


def _inputs(session: 'Session') -> dict[str, object]:
    """Return rate and silence of each source, the lever arms of antennas, and the datum."""
    reader, liveness = session.input.reader, session.input.liveness
    now = time.monotonic()
    found: dict[str, object] = {}
    for name in reader.sources:
        silence, rate = liveness.silence(name, now), liveness.rate(name)
        found[f'{name}.silence_s'] = 'never received' if silence is None else f'{silence:.1f}'
        if rate > 0.0:
            found[f'{name}.rate_hz'] = f'{rate:.1f}'
    found |= {f'{name}.delay_s': f'{delay:.3f}'
              for name, delay in session.input.delays.seconds.items()}
    for name, fixes in reader.fixes.items():
        if fixes.antenna is not None:
            x, y = fixes.antenna.lever_arm
            found[f'{name}.lever_arm'] = f'[{x:.3f}, {y:.3f}] from {fixes.antenna.origin}'
            found[f'{name}.without_lever_arm'] = fixes.without_lever_arm
    plane = reader.datum.plane
    found['datum'] = 'none' if plane is None else (
        f'[{plane.latitude:.9f}, {plane.longitude:.9f}, {plane.yaw:.6f}]')
    return found


def _fits(session: 'Session') -> dict[str, object]:
    """Return how well the measurements of each source fit the estimate."""
    found: dict[str, object] = {}
    for name, report in session.worker.status.sources.items():
        # 1 if the sigmas are right, less if the estimate depends on this source alone
        found[f'{name}.squared_residual'] = f'{short(report.energy, 4)}'
        errors, in_use = report.errors, report.in_use
        if in_use is not None and report.found:
            found[f'{name}.errors_live'] = (
                f'{short(in_use.tau)} s, with {short(math.sqrt(in_use.correlated))} times the '
                f'sigma of the messages; found by {name}.correlation_time of -1, and treated so')
        elif errors.significant and report.energy >= SOURCES.least_energy:
            found[f'{name}.errors_live'] = (
                f'{short(errors.tau)} s, with a sigma of {short(errors.sigma_correlated)} m'
                + (f'; treated as white: set {name}.correlation_time'
                   if report.wrongly_white else ''))
    return found


def health(session: 'Session') -> tuple[bytes, str]:
    """Return the level of the diagnostics and a sentence with the state and what to do."""
    return next(_concerns(session))


def _concerns(session: 'Session') -> Iterator[tuple[bytes, str]]:
    """Yield level and sentence of all that applies to the node, the most urgent first."""
    error, warn, good = DiagnosticStatus.ERROR, DiagnosticStatus.WARN, DiagnosticStatus.OK
    worker = session.worker
    estimate, report = worker.estimate, worker.status.report
    if not worker.alive:
        yield error, 'The worker thread has ended: restart the node.'
    if report is not None and report.status is Status.FAILED:
        names = ', '.join(worker.status.set_aside) or 'the newest measurements'
        yield error, (f'The solver failed with {names}: set aside until ~/optimize; the estimate '
                      'is without them. See the log for the reason.')
    if not session.active:
        yield good, 'Inactive: activate the node (ros2 lifecycle set).'
    if session.input.paused:
        yield warn, 'Paused: call ~/pause with false to resume.'
    if not worker.prepared:
        waiting = f'{session.input.posted} measurements wait until then.'
        yield warn, (f'Compiling kernels, as at every first start: {waiting}'
                     if session.compiling else f'Loading compiled kernels: {waiting}')
    yield from _missing_input(session)
    if estimate is None:
        return
    transforms, silent = session.out.transforms, session.input.silent
    if transforms is not None and transforms.other != '':
        yield warn, _said(transforms.other)
    if len(silent) > 0:
        yield warn, (f'{" and ".join(silent)} {"is" if len(silent) == 1 else "are"} silent '
                     'while other sources are not: check the drivers.')
    yield from ((warn, _said(text)) for text in (
        *session.doubts, *session.input.delays.wrong.values()))
    if estimate.alignment is AlignmentState.UNALIGNED:
        yield warn, ('Unaligned: the angle between odometry and map is not known yet. Drive some '
                     'metres while fixes come in.')
    yield from ((warn, text) for _, text in disagreements(session))
    yield from _doubts(session)
    if estimate.alignment is AlignmentState.LOCAL:
        yield good, ('Running without measurements in the map: its frame is that of the first '
                     'odometry.')
    yield good, 'Running.'


def _missing_input(session: 'Session') -> Iterator[tuple[bytes, str]]:
    """Yield what is to be said if odometry, or all messages of a source, do not get in."""
    warn, estimate = DiagnosticStatus.WARN, session.worker.estimate
    odometry, quiet, refused = session.odometry_topics, session.input.quiet, session.input.refused
    if estimate is None or (session.is_loaded and not any(
            session.worker.status.counts[name, 'accepted'] > 0 for name in odometry)):
        why = '; '.join(refused[name] for name in odometry if name in refused)
        if why == '':
            why = f'check {" or ".join(odometry.values())}'
        state = 'No odometry yet' if estimate is None else (
            f'A graph of {estimate.n_hidden} hidden nodes is loaded and waits for odometry')
        yield warn, f'{state}: {why}.'
    if quiet > 0.0:
        final = session.final
        ended = (final is not None and final.done() and not final.cancelled()
                 and final.exception() is None and final.result().status is Status.CONVERGED)
        yield warn, (f'Nothing has been received for {quiet:.0f} s: the drivers have stopped, or '
                     'a bag has ended'
                     + ('; the graph has been optimised.' if ended else '.'))
    if len(refused) > 0:
        yield warn, _said('; '.join(refused.values()))


def _said(text: str) -> str:
    """Return a text as a sentence."""
    return f'{text[0].upper()}{text[1:]}.'


def _doubts(session: 'Session') -> Iterator[tuple[bytes, str]]:
    """Yield what is to be said of a node that works, but with wrong settings or errors."""
    warn, status = DiagnosticStatus.WARN, session.worker.status
    doubted = [name for name, each in status.verdicts.items() if each.doubting]
    if len(doubted) > 0:
        yield warn, (f'The newest measurements of {" and ".join(doubted)} are doubted and not '
                     'used, as they contradict the others: see ~/verdicts.')
    for name, fit in status.sources.items():
        if fit.wrongly_white:
            yield warn, (f'The errors of {name} are correlated in time but treated as white, so '
                         f'the covariances are too small: set {name}.correlation_time to about '
                         f'{short(fit.errors.tau)} s.')
    errors = sum(count for (_, reason), count in status.counts.items()
                 if reason == 'internal_error')
    if errors > 0:
        yield warn, f'Running, but {errors} internal errors are in the log: please report them.'


def disagreements(session: 'Session') -> Iterator[tuple[str, str]]:
    """Yield who disagrees with others, by a key, and what is probably wrong with them."""
    status, estimate = session.worker.status, session.worker.estimate
    found = session.searches.contradiction
    if found is not None:
        yield f'{found.source}.contradiction', _said(found.text)
    for name, source in session.input.reader.sources.items():
        if source.kind is not Kind.GYRO or estimate is None:
            continue
        counts, bias = status.counts, status.biases.get(name, 0.0)
        used, most = counts[name, 'rotations'], MOST_BIAS * session.values[f'{name}.sigma_bias']
        if used == 0 and counts[name, 'accepted'] >= 20 <= estimate.n_hidden:
            yield f'{name}.rotations', (
                f'No message of {name} could be used: either their stamps are not in the time of '
                f'odometry, or they are farther apart than {name}.maximum_gap.')
        difference = status.differences.get(name)
        if difference is not None and difference.sigmas > CONTRADICTORY and difference.reason:
            yield f'{name}.odometry_difference', (
                f'Of {name} and odometry one is wrong: {difference.reason}.')
        elif abs(bias) > most:
            yield f'{name}.bias', (
                f'The bias of {name} is {short(bias)} rad/s, more than five times its sigma_bias: '
                'check its mounting and its unit, rad/s.')
