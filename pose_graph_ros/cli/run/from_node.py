# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is known of a run of the node over DDS: from the graph that it saved, and what it published.

The saved graph is restored into an engine, whose estimate is that of the node. Times of updates
come from the recorded diagnostics: each message has the number of updates and their mean and
longest time since the start. The stamp of an update is that of the newest odometry that the node
had published before.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pose_graph_ros.adapters.bag_inputs import Inputs
from pose_graph_ros.adapters.bags import open_bag
from pose_graph_ros.adapters.conversions import stamp_ns
from pose_graph_ros.adapters.sources import backend_config, ODOMETRY_KINDS
from pose_graph_ros.cli.evaluation import Drive, evaluate
from pose_graph_ros.cli.run.recorder import Recorder, Run, Update
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.io.graph_files import read_graph
from pose_graph_ros.core.io.saved_graph import SavedGraph

GRAPH, RECORDED = 'graph.g2o', 'corrected'
"""Saved graph and rosbag2 of the node, in the folder of a run."""
DIAGNOSTICS, ODOMETRY = '/diagnostics', '/odometry/filtered'
# What the diagnostics have under the name of a source besides counts of messages.
NO_COUNTS = ('believed', 'believed_weakly', 'doubted', 'waiting', 'scale', 'forgotten', 'left',
             'left_unused', 'without_lever_arm', 'rate_hz', 'silence_s', 'bias')


def restored(folder: Path, values: Mapping[str, Any]) -> tuple[PoseGraphBackend, SavedGraph]:
    """
    Return an engine with the graph that the node has saved into a folder, and that graph.

    Parameters
    ----------
    values : mapping, all parameters of the node

    """
    saved = read_graph(folder / GRAPH)
    backend = PoseGraphBackend.restored(backend_config(values), saved)
    backend.update()
    return backend, saved


def node_run(
    title: str, drive: Drive, folder: Path, settings: tuple[Inputs, Mapping[str, Any]],
    engine: tuple[PoseGraphBackend, SavedGraph], *, converged: bool, seconds: float,
) -> Run:
    """
    Return a run of the node.

    Parameters
    ----------
    folder : Path, with the graph that the node has saved, and the rosbag2 that it has published
    settings : tuple, what fed the node, and all its parameters
    engine : tuple, see `restored`
    converged : bool, whether the final optimisation did
    seconds : float, how long it took [s]

    """
    (inputs, values), (backend, saved) = settings, engine
    estimate = backend.estimate()
    assert estimate is not None, 'a saved graph has a hidden node'
    # chi2 of the node has robust costs, that of an update does not
    estimate = replace(estimate, chi2=saved.chi2)
    recorder = Recorder()
    for source in inputs.of(*ODOMETRY_KINDS)[:1]:
        for stamp in drive.odometry.stamps_ns.tolist():
            recorder.add_measurement(source, stamp)
    for source, stamp, out in zip(drive.fix_sources, drive.fix_stamps_ns.tolist(),
                                  drive.fix_held_out.tolist(), strict=True):
        if not out:
            recorder.add_measurement(source, stamp)
    diagnostics = _updates(folder / RECORDED, recorder, estimate.stamp_ns)
    drive = replace(drive, corrected=estimate.path)
    verdicts = backend.verdicts()
    known = {(each.source, each.stamp_ns, each.reference_ns) for each in verdicts}
    keys = [(source, later, earlier) for source, (earlier, later) in zip(
        drive.loop_sources, drive.loop_stamps_ns.tolist(), strict=True)]
    return Run(
        title, 'the node over DDS', drive, backend, estimate, verdicts, recorder, values,
        inputs.kinds, _counts(diagnostics, inputs), evaluate(drive),
        None if converged else UpdateReport(Status.MAX_ITERATIONS, '', 0, 0, estimate.chi2),
        saved.datum, seconds, dict.fromkeys(
            (key for key in keys if key not in known),
            'Refused: the node has not added it; its reasons are among the counts.'))


def _updates(recorded: Path, recorder: Recorder, last_ns: int) -> Mapping[str, str]:
    """Record the updates before the last stamp; return the newest values of the diagnostics."""
    newest_ns, before, values = 0, (0, 0.0, 0.0), dict[str, str]()
    with open_bag(recorded) as bag:
        topics = [topic for topic in (DIAGNOSTICS, ODOMETRY) if topic in bag.topics]
        for message in bag.messages(topics):
            content = message.decode()
            if message.topic == ODOMETRY:
                newest_ns = stamp_ns(content)
                continue
            values = {item.key: item.value for item in content.status[0].values}
            count = int(values.get('updates', 0))
            total = count * float(values.get('solve_mean_ms', 0.0))
            longest = float(values.get('solve_max_ms', 0.0))
            # of the last one, the final optimisation has a part
            if before[0] < count and 0 < newest_ns < last_ns and 'chi2' in values:
                mean = (total - before[1]) / (count - before[0])
                recorder.log.add(Update(
                    newest_ns, int(values['hidden_nodes']),
                    longest if longest > before[2] else max(mean, 0.0), float(values['chi2']), -1))
                recorder.log.count += count - before[0] - 1
                before = count, total, longest
    return values


def _counts(values: Mapping[str, str], inputs: Inputs) -> dict[tuple[str, str], int]:
    """Return the counts of messages by source and answer that the diagnostics have."""
    counts: dict[tuple[str, str], int] = {}
    for key, value in values.items():
        source, _, answer = key.rpartition('.')
        if source in inputs.topics and answer not in NO_COUNTS and value.isdecimal():
            counts[source, answer] = int(value)
    return counts
