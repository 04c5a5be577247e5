# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The same graphs with wrong loop closures for us and for GTSAM: errors and times."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
import time

import numpy as np

from benchmark.metrics import Metric
from benchmark.robust_closures import feed, hidden_graph, Recording, rms, TRUE
from benchmark.section import say, Section, Table
from benchmark.worlds import integrate
from pose_graph_ros.cli.believe import believe
from pose_graph_ros.core.batch import optimizer
from pose_graph_ros.core.config import Robust, SolverConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import BoolArray, FloatArray, IntArray
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph.constraints import Edges
from pose_graph_ros.core.graph.graph import Graph, GraphUpdate
from pose_graph_ros.core.io.g2o import read_g2o
from pose_graph_ros.core.io.g2o_writing import write_g2o
from pose_graph_ros.core.judgement.closures import floored, FLOORS

PEER = 'benchmark.robust_peer'
METHODS = 'GNC-TLS', 'GNC-GM', 'LM, Cauchy', 'LM, DCS'
FLOORED = ('GNC-TLS',)
"""Methods that also get the closures with floors."""
COMMAND = 'import sys; from pose_graph_ros.cli.main import main; sys.exit(main())'
"""What `pose-graph` runs."""
REPEATS = 3
AS_GOOD, FASTER = 1.01, 5.0
"""What is asked: rms over that of GTSAM's GNC, with one hundredth for rounding, and times."""
CONFIG = SolverConfig(max_iterations=200)
"""As `pose-graph solve` has it."""


@dataclass(frozen=True, slots=True)
class Solved:
    """What a tool makes of a graph."""

    poses: FloatArray | None
    """Shape (N, 3); None if it was cut."""
    kept: BoolArray
    """Of the closures; empty if the method does not tell."""
    seconds: float
    """Of the solver."""
    command: float = np.nan
    """Of the whole command, from its start to its end [s]."""


def section(recordings: Sequence[Recording], *, limit: float) -> Section:
    """
    Compare on the graphs of some recordings.

    Parameters
    ----------
    recordings : sequence of Recording
    limit : float, after which a command is cut [s]

    """
    found = Section(
        'Beside GTSAM', 'Each tool gets one file with the same nodes, odometry and '
        'closures, starts from odometry, and knows that odometry is right. GTSAM: graduated '
        'non-convexity (GncLMOptimizer, 99 %) for truncated least squares and Geman-McClure, and '
        'Levenberg-Marquardt with a loss; *floors*: closures with at least 0.3 m and 0.05 rad, '
        'which ours has for its decision anyway. *Ours, batch*: `pose-graph solve --robust`. '
        '*Ours, online*: all calls of the back end over the whole drive. *Solver*: without '
        'reading files and starting a process (ours: kernels compiled, the median of '
        f'{REPEATS}); *command*: the process from its start to its end. A command is cut after '
        f'{limit:.0f} s. Asked of ours, batch: an rms of at most {AS_GOOD} times that of '
        f"the best of GTSAM's GNC, of those that were not cut (if all were, of its losses), and "
        f'{FASTER:.0f} times as fast as the fastest of them; one that is cut counts with the '
        f'limit.')
    table = Table('', ('graph', 'tool', 'rms [m]', 'kept', 'kept wrong', 'lost right',
                       'solver [s]', 'command [s]'))
    methods = METHODS if find_spec('gtsam') is not None else ()
    if len(methods) == 0:
        found.notes.append('gtsam is not installed (`make bench` does that), skipped.')
    for recording in recordings:
        _compare(found, table, recording, limit, methods)
    found.tables.append(table)
    return found


def _compare(
    found: Section, table: Table, recording: Recording, limit: float,
    methods: Sequence[str],
) -> None:
    """Run all tools on one graph."""
    run = feed(recording, recording.config(Robust.JUDGED))
    stamps, chain, loops, believed = hidden_graph(run)
    true = se2.between(recording.truth.at(stamps[loops.i]), recording.truth.at(stamps[loops.j]))
    right = np.hypot(*(loops.mean - true)[:, :2].T) <= TRUE
    errors: dict[str, float] = {}
    results: dict[str, Solved] = {}

    def add(tool: str, solved: Solved) -> None:
        results[tool] = solved
        cut, kept = solved.poses is None, solved.kept
        errors[tool] = np.inf if solved.poses is None else rms(
            Trajectory(stamps, solved.poses), recording.truth)
        counts = ('', '', '') if len(kept) == 0 else (
            str(np.sum(kept)), str(np.sum(kept & ~right)), str(np.sum(right & ~kept)))
        command = '' if np.isnan(solved.command) else f'{solved.command:.2f}'
        table.add(recording.name, tool, 'cut' if cut else f'{errors[tool]:.2f}', *counts,
                  'cut' if cut else f'{solved.seconds:.2f}', command)
        say('  ' + ' | '.join(table.rows[-1]))

    with TemporaryDirectory() as name:
        plain, raised = Path(name) / 'plain.g2o', Path(name) / 'raised.g2o'
        _write(plain, stamps, chain, loops)
        _write(raised, stamps, chain, floored(loops))
        add('ours, online', Solved(run.backend.graph.poses.copy(), believed, run.seconds))
        add('ours, batch', _ours(plain))
        for method in methods:
            add(f'GTSAM {method}', _peer(method, plain, limit))
            if method in FLOORED:
                add(f'GTSAM {method}, floors', _peer(method, raised, limit))
    gnc = [tool for tool in results if 'GNC' in tool]
    ended = [tool for tool in gnc if results[tool].poses is not None] or [
        tool for tool in results if tool.startswith('GTSAM')]
    if len(gnc) > 0:
        best = min(errors[tool] for tool in ended)
        ours = results['ours, batch']
        for name in ('batch', 'online'):
            found.metrics.append(Metric(
                f"{recording.name}: rms, {name}, over GTSAM's", errors[f'ours, {name}'] / best,
                target=AS_GOOD))
        for what, theirs, mine in (
                ('solver', min(results[tool].seconds for tool in gnc), ours.seconds),
                ('command', min(results[tool].command for tool in gnc), ours.command)):
            found.metrics.append(Metric(f'{recording.name}: {what}, times as fast', theirs / mine,
                                        'x', target=FASTER, higher_is_better=True))


def _write(file: Path, stamps_ns: IntArray, chain: Edges, loops: Edges) -> None:
    graph = Graph()
    edges = Edges(*(np.concatenate(pair) for pair in (
        (chain.i, loops.i), (chain.j, loops.j), (chain.mean, loops.mean),
        (chain.information, loops.information), (chain.kind, loops.kind))))
    graph.apply(GraphUpdate(hidden=integrate(np.zeros(3), chain.mean), edges=edges))
    assert graph.n_nodes == len(stamps_ns)
    write_g2o(graph, file)


def _ours(file: Path) -> Solved:
    """Run `pose-graph solve --robust`, in this process and as a command."""
    times = []
    for _ in range(REPEATS):
        graph = read_g2o(file).graph
        graph.apply(GraphUpdate(fix=[0]))
        begin = time.perf_counter()
        beliefs = believe(graph, FLOORS)
        assert beliefs is not None
        graph.set_poses(beliefs.poses)
        graph.apply(GraphUpdate(
            remove_edges=beliefs.closures[~beliefs.believed].tolist(),
            weigh_edges=dict.fromkeys(
                beliefs.closures[beliefs.believed].tolist(), beliefs.scale**-2.0)))
        optimizer.optimize(graph, CONFIG)
        times.append(time.perf_counter() - begin)
    begin = time.perf_counter()
    subprocess.run([sys.executable, '-c', COMMAND, 'solve', '--robust',
                    str(file), '--out', str(file.with_name('ours.g2o'))],
                   check=True, stdout=subprocess.DEVNULL)
    return Solved(graph.poses.copy(), beliefs.believed, float(np.median(times)),
                  time.perf_counter() - begin)


def _peer(method: str, file: Path, limit: float) -> Solved:
    """Run a method of GTSAM as a command."""
    result = file.with_name('result.npz')
    begin = time.perf_counter()
    try:
        subprocess.run([sys.executable, '-m', PEER, method, str(file), str(result)],
                       check=True, timeout=limit, stdout=subprocess.DEVNULL,
                       stderr=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        return Solved(None, np.empty(0, dtype=bool), limit, limit)
    command = time.perf_counter() - begin
    with np.load(result) as found:
        return Solved(found['poses'], found['kept'], float(found['seconds']), command)
