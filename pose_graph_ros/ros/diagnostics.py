# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What /diagnostics reports: values by their keys, and what concerns the node now, with what to do.

The most urgent concern is the message of the diagnostics; some are in the log, too. What is around
the node and probably not as it was meant, such as topics that nobody publishes, or others as well,
and frames that are not those of the parameters, is in doubt: rclpy and the middleware say nothing
of it.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
import math
import os
from pathlib import Path
import time
from typing import NamedTuple, TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus

from pose_graph_ros.adapters import conversions, parameter_table
from pose_graph_ros.adapters.sources import GYRO, KNOWN_SOURCES, Source
from pose_graph_ros.core import alignment, disagreement
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.exceptions import INTERRUPTED
from pose_graph_ros.core.judgement.texts import short, shortened, total_values
from pose_graph_ros.core.odometry import motion
from pose_graph_ros.core.sources import gyro, settings
from pose_graph_ros.ros.input import EXPECTED
from pose_graph_ros.ros.topics import moved, other_publishers
from pose_graph_ros.ros.worker import Worker

if TYPE_CHECKING:
    from pose_graph_ros.ros.session import Session


def values(session: 'Session') -> dict[str, object]:
    """Return all values of the diagnostics by key."""
    worker, rejected = session.worker, session.input.rejected
    status, estimate = worker.status, worker.estimate
    updates, total, longest = worker.durations
    found: dict[str, object] = {
        'received': sum(each.count for each in session.input.arrivals.values()),
        'processed': status.processed + sum(rejected.values()), 'pending': status.pending,
        'quarantined': status.quarantined, 'updates': updates,
        'prepared': int(worker.prepared), 'active': int(session.active),
        'paused': int(session.input.paused), 'resets': session.n_resets,
        'solve_mean_ms': f'{1e3 * total / max(updates, 1):.3f}',
        'solve_max_ms': f'{1e3 * longest:.3f}', 'worker.timed_out': worker.watchdog.count,
        'memory_mb': f'{memory() / 1e6:.0f}'}
    if (journal := session.journal) is not None:
        found |= {'journal.lag_max_s': f'{journal.lag:.3f}',
                  'journal.size_mb': f'{journal.size / 1e6:.3f}',
                  'journal.is_whole': int(not journal.has_gap)}
    if session.reset_reason != '':
        found['reset_reason'] = session.reset_reason
    if session.replaced is not None:
        found['undo'] = session.replaced
    found |= {f'{source}.{answer}': count
              for (source, answer), count in sorted((status.counts + rejected + (
                  session.input.reader.frames.counts)).items())}
    found |= {f'{source}.bias': f'{bias:.6f}' for source, bias in status.biases.items()}
    found |= {f'{source}.calibrated_{name}': f'{value:.6f}'
              for source, each in status.calibrations.items()
              for name, value in each._asdict().items()}
    found |= {f'{source}.odometry_difference': ': '.join(filter(None, (
        f'{short(each.sigmas)} sigmas', each.reason)))
        for source, each in status.differences.items()}
    found |= {f'quarantined.{rank}': name for rank, name in enumerate(status.set_aside, 1)}
    if estimate is not None:
        found.update({'odometry': estimate.primary, 'alignment': estimate.alignment.value,
                      'alignment_yaw_deg': f'{math.degrees(estimate.T_map_odom[2]):.3f}',
                      'alignment_sigma_deg': f'{math.degrees(estimate.alignment_sigma):.3f}',
                      'hidden_nodes': estimate.n_hidden, 'frozen_nodes': estimate.n_frozen,
                      'thinned_nodes': estimate.n_thinned, 'priors': estimate.n_priors,
                      'edges': estimate.n_edges, 'observed_nodes': estimate.n_observed,
                      'biases': estimate.n_biases, 'chi2': f'{estimate.chi2:.6g}'})
        if (errors := estimate.odometry_errors) != motion.AS_CLAIMED:
            # never a whole number: those are counts
            found |= {f'{estimate.primary}.errors_{name}': f'{value:.6f}'
                      for name, value in errors._asdict().items()}
    for rank, largest in enumerate(session.searches.energies, 1):
        found[f'largest_energy.{rank}'] = f'{largest.name}: {short(largest.energy, 4)}' + (
            '' if largest.unweighted == largest.energy else
            f', without its loss {short(largest.unweighted, 4)}')
    return found | _of_sources(session) | total_values(status.verdicts)


class Searches:
    """The constraints with the largest energies, and a source that contradicts the others."""

    def __init__(self) -> None:
        self.energies: Sequence[disagreement.ConstraintEnergy] = ()
        self.contradiction: disagreement.Disagreement | None = None
        self.due = 0.0  # time from which on the worker is asked again [s]
        self._n = 0     # number of measurements from which on a contradiction is searched again

    def update(self, worker: Worker) -> None:
        """Search every 5 s; while measurements fit badly, when there are twice as many."""
        reports = worker.status.sources.values()
        badly, n = any(report.fits_badly for report in reports), sum(each.n for each in reports)
        if not badly:
            self.contradiction, self._n = None, 0
        if not worker.prepared or time.monotonic() < self.due:
            return
        if is_new := badly and n >= self._n:
            self._n = 2 * n

        def search(backend: PoseGraphBackend) -> None:
            try:
                self.energies = backend.largest_energies(3)
                if is_new:
                    self.contradiction = backend.disagreement()
            finally:
                self.due = time.monotonic() + 5.0
        self.due = math.inf  # one search at a time
        worker.call(search, 'the largest energies')


def memory() -> int:
    """Return the resident memory of the process [bytes]; 0 if the system does not provide it."""
    try:
        return int(Path('/proc/self/statm').read_text().split()[1]) * os.sysconf('SC_PAGE_SIZE')
    except OSError:
        return 0


def _of_sources(session: 'Session') -> dict[str, object]:
    """Return what is noticed of each source, lever arms, the datum, and how well each fits."""
    reader, now = session.input.reader, time.monotonic()
    found: dict[str, object] = {}
    for name, arrivals in session.input.arrivals.items():
        if arrivals.count > 0:
            found[f'received.{name}'] = arrivals.count
        silence = now - arrivals.at
        found[f'{name}.silence_s'] = f'{silence:.1f}' if silence < math.inf else 'never received'
        if arrivals.rate > 0.0:
            found[f'{name}.rate_hz'] = f'{arrivals.rate:.1f}'
        if arrivals.delay is not None:
            found[f'{name}.delay_s'] = f'{arrivals.delay:.3f}'
    for name, antenna in [*reader.surroundings.antennas.items()]:
        x, y = antenna.lever_arm
        found[f'{name}.lever_arm'] = f'[{x:.3f}, {y:.3f}] from {antenna.origin}'
        found[f'{name}.without_lever_arm'] = reader.surroundings.without_lever_arm[name]
    plane = reader.datum.plane
    found['datum'] = 'none' if plane is None else (
        f'[{plane.latitude:.9f}, {plane.longitude:.9f}, {plane.yaw:.6f}]')
    for name, report in session.worker.status.sources.items():
        # 1 if the sigmas are right, less if the estimate depends on this source alone
        found[f'{name}.squared_residual'] = f'{short(report.energy, 4)}'
        errors, in_use = report.errors, report.in_use
        if in_use is not None and report.found:
            found[f'{name}.errors_live'] = (
                f'{short(in_use.tau)} s, with {short(math.sqrt(in_use.correlated))} times the '
                f'sigma of the messages; found by {name}.correlation_time of -1, and treated so')
        elif errors.significant and report.energy >= settings.SOURCES.least_energy:
            found[f'{name}.errors_live'] = (
                f'{short(errors.tau)} s, with a sigma of {short(errors.sigma_correlated)} m'
                + (f'; treated as white: set {name}.correlation_time'
                   if report.wrongly_white else ''))
    return found


# --- what concerns the node

class Concern(NamedTuple):
    """What applies to the node now: a sentence with what to do, without its full stop."""

    level: bytes
    text: str
    logged: bool = False  # whether the log has it, too, when it begins and when it is over


ERROR, WARN, GOOD = DiagnosticStatus.ERROR, DiagnosticStatus.WARN, DiagnosticStatus.OK


def concerns(session: 'Session') -> Iterator[Concern]:
    """Yield all that applies to the node, the most urgent first."""
    worker, received = session.worker, session.input
    estimate, report = worker.estimate, worker.status.report
    if not worker.thread.is_alive():
        yield Concern(ERROR, 'the worker thread has ended: restart the node')
    if report is not None and report.status is Status.FAILED and report.reason != INTERRUPTED:
        yield Concern(ERROR, 'the solver failed with ' + (
            ', '.join(worker.status.set_aside) or 'the newest measurements') + ': set aside until '
            '~/optimize; the estimate is without them. See the log for the reason')
    if session.journal is not None and session.journal.failure != '':
        yield Concern(ERROR, f'the journal cannot be written, and what comes would be lost with '
                      f'this process: {session.journal.failure}')
    if (what := worker.watchdog.interrupted) != '':
        yield Concern(WARN, f'{what} took longer than solve_timeout and was interrupted; the '
                      'poses follow odometry. Call ~/optimize with a larger solve_timeout')
    if not session.active:
        yield Concern(GOOD, 'inactive: activate the node (ros2 lifecycle set)')
    if received.paused:
        yield Concern(WARN, 'paused: call ~/pause with false to resume')
    if not worker.prepared:
        yield Concern(WARN, ('compiling kernels, as at every first start' if session.compiling else
                             'loading compiled kernels')
                      + f': {received.posted} measurements wait until then')
    yield from _missing_input(session)
    if session.out.transforms is not None and session.out.transforms.other != '':
        yield Concern(WARN, session.out.transforms.other, logged=True)
    if len(received.silent) > 0:
        yield Concern(WARN, f'nothing comes from {" and ".join(received.silent)}, while other '
                      'sources go on: check the drivers', logged=True)
    if session.active:
        yield from (Concern(WARN, text, logged=True) for text in doubts(session))
    yield from (Concern(WARN, text, logged=True) for text in (
        each.wrong for each in received.arrivals.values()) if text != '')
    if estimate is not None and estimate.alignment is alignment.AlignmentState.UNALIGNED:
        yield Concern(WARN, 'unaligned: the angle between odometry and map is not known yet. '
                      'Drive some metres while fixes come in')
    yield from _doubted(session)
    if estimate is not None and estimate.alignment is alignment.AlignmentState.LOCAL:
        yield Concern(GOOD, 'running without measurements in the map: its frame is that of the '
                      'first odometry')
    yield Concern(GOOD, 'running')


def _missing_input(session: 'Session') -> Iterator[Concern]:
    """Yield what is to be said if odometry, or all messages of a source, do not get in."""
    estimate, received = session.worker.estimate, session.input
    odometry = {name: session.node.resolve_topic_name(source.topic)
                for name, source in received.reader.sources.items() if source.kind.is_odometry}
    refused = received.refused
    if estimate is None or (session.is_loaded and not any(
            session.worker.status.counts[name, 'accepted'] > 0 for name in odometry)):
        why = '; '.join(refused[name] for name in odometry if name in refused) or (
            f'check {" or ".join(odometry.values())}')
        state = 'no odometry yet' if estimate is None else (
            f'a graph of {estimate.n_hidden} hidden nodes is loaded and waits for odometry')
        yield Concern(WARN, f'{state}: {why}')
    if received.quiet > 0.0:
        yield Concern(WARN, 'nothing has been received for '
                      f'{received.quiet:.0f} s: the drivers have stopped, or a bag has ended'
                      + ('; the graph has been optimised' if session.worker.is_optimal else ''),
                      logged=True)
    if len(refused) > 0:
        yield Concern(WARN, '; '.join(refused.values()))


def _doubted(session: 'Session') -> Iterator[Concern]:
    """Yield who disagrees with others, and what is wrong with settings of a node that works."""
    status, estimate = session.worker.status, session.worker.estimate
    if (found := session.searches.contradiction) is not None:
        yield Concern(WARN, found.text, logged=True)
    for name, source in session.input.reader.sources.items():
        if source.kind is not GYRO or estimate is None:
            continue
        counts, bias = status.counts, status.biases.get(name, 0.0)
        difference = status.differences.get(name)
        if counts[name, 'rotations'] == 0 and counts[name, 'accepted'] >= 20 <= estimate.n_hidden:
            yield Concern(WARN, f'no message of {name} could be used: either their stamps are not '
                          f'in the time of odometry, or they are farther apart than '
                          f'{name}.maximum_gap', logged=True)
        if difference is not None and difference.sigmas > gyro.CONTRADICTORY and difference.reason:
            yield Concern(WARN, f'of {name} and odometry one is wrong: {difference.reason}',
                          logged=True)
        elif abs(bias) > gyro.MOST_BIAS * session.values[f'{name}.sigma_bias']:
            yield Concern(WARN, f'the bias of {name} is {short(bias)} rad/s, more than five times '
                          'its sigma_bias: check its mounting and its unit, rad/s', logged=True)
    for name in (name for name, each in status.verdicts.items() if each.doubting):
        yield Concern(WARN, f'the newest measurements of {name} are doubted and not used, as they '
                      'contradict the others: see ~/verdicts', logged=True)
    for name, fit in status.sources.items():
        if fit.wrongly_white:
            yield Concern(WARN, f'the errors of {name} are correlated in time but treated as '
                          f'white, so the covariances are too small: set {name}.correlation_time '
                          f'to about {short(fit.errors.tau)} s')
    errors = sum(n for (_, reason), n in status.counts.items() if reason == 'internal_error')
    if errors > 0:
        yield Concern(WARN, f'running, but {errors} internal errors are in the log: please report '
                      'them')


# --- what around the node is probably not as it was meant

def doubts(session: 'Session') -> Iterator[str]:
    """Yield what is to be said now; of the topics, once there was time to start all drivers."""
    topics: defaultdict[str, list[Source]] = defaultdict(list)
    for source in session.input.reader.sources.values():
        topics[session.node.resolve_topic_name(source.topic)].append(source)
    node = session.node
    for topic, users in topics.items():
        # but for sources that use other parts of the same messages
        parts = {source.kind.part for source in users}
        if len(users) > 1 and (len(parts) < len(users) or '' in parts):
            names = ' and '.join(source.name for source in users)
            yield (f'{names} listen to the same topic, {topic}, so that its messages count '
                   f'{len(users)} times: set {users[-1].name}.topic')
        if time.monotonic() - session.activated_at > EXPECTED.quiet:
            for source in users:
                yield from _unpublished(session, topic, source)
    for source in session.input.reader.sources.values():
        yield from _frames(session, source)
    for name, (default, *_) in parameter_table.OUTPUTS.items():
        topic = session.values[f'outputs.{name}']
        if default.startswith('/') or node.count_publishers(topic) < 2:
            continue    # /diagnostics is for all
        if len(others := other_publishers(node, topic)) > 0:
            yield (f'{node.resolve_topic_name(topic)} is published by {" and ".join(others)} as '
                   f'well: give one of them another topic, of this node {moved(node, name)}')


def _unpublished(session: 'Session', topic: str, source: Source) -> Iterator[str]:
    """Of the default inputs but odometry, robots may have some alone."""
    node, name, wanted = session.node, source.name, source.kind.message_type
    usual = node.resolve_topic_name(KNOWN_SOURCES[name][1]) if name in KNOWN_SOURCES else ''
    expected = source.kind.is_odometry or topic != usual or (
        name not in parameter_table.DEFAULT_SOURCES and not source.kind.is_rare)
    if session.input.arrivals[name].count > 0 or not expected:
        return
    types = sorted({info.topic_type for info in node.get_publishers_info_by_topic(source.topic)})
    if wanted in types:
        return
    found = 'nobody publishes it' if types == [] else f'its messages are {", ".join(types)}'
    own = {publisher.topic_name for publisher in node.publishers}
    others = sorted(each for each, kinds in node.get_topic_names_and_types()
                    if wanted in kinds and each not in own and node.count_publishers(each) > 0)
    yield f'{name} listens to {topic} for {wanted}, but {found}' + (
        f'; there is {", ".join(others[:3])}' if len(others) > 0 else '')


def _frames(session: 'Session', source: Source) -> Iterator[str]:
    name, out, estimate = source.name, session.out, session.worker.estimate
    if (frames := session.input.arrivals[name].frames) is None:
        return
    parent, child = map(conversions.frame, frames)
    if source.kind.names_frames:
        for what, found, parameter, expected, consequence in (
                ('frame_id', parent if estimate is not None and estimate.primary == name else
                 out.odom_frame, 'odom_frame', out.odom_frame, 'no transform to it is published'),
                ('child_frame_id', child, 'base_link_frame', out.base_frame,
                 'its motion is taken for that of the robot')):
            if found == '':
                yield f'{name} has no {what}: it is taken for {expected}, the {parameter}'
            elif found != expected:
                yield (f'{name} has the {what} {shortened(found)!r}, but the parameter '
                       f'{parameter} is {expected!r}: set it, else {consequence}')
    elif parent == '' and source.kind.without_frame != '' and (
            source.mounting == 'tf' and not any(source.lever_arm)):  # no parameter stands for it
        yield f'{name} has no frame_id: ' + source.kind.without_frame.format(
            base=out.base_frame, map=out.map_frame, name=name)
