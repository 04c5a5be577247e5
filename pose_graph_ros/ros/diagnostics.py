# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The values of /diagnostics by their keys."""

from collections.abc import Sequence
import math
import os
from pathlib import Path
import time
from typing import TYPE_CHECKING

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.disagreement import Disagreement
from pose_graph_ros.core.judgement.texts import short, total_values
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
    worker, rejected = session.worker, session.input.rejected
    status, estimate = worker.status, worker.estimate
    found: dict[str, object] = {
        'received': sum(each.count for each in session.input.arrivals.values()),
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

    def update(self, worker: Worker) -> None:
        """Search every 5 s; while measurements fit badly, when there are twice as many."""
        reports = worker.status.sources.values()
        badly, n = any(report.fits_badly for report in reports), sum(each.n for each in reports)
        if not badly:
            self.contradiction, self._n = None, 0
        if not worker.prepared or time.monotonic() < self.due:
            return
        is_new = badly and n >= self._n
        if is_new:
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


def _inputs(session: 'Session') -> dict[str, object]:
    """Return what is noticed of each source, the lever arms of antennas, and the datum."""
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
