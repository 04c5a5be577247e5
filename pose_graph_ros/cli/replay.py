# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run bags or a g2o file through the engine of the node, without ROS."""

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
import math
import time
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from pose_graph_ros.adapters.bag_inputs import (
    choose_inputs,
    Inputs,
    read_inputs,
    reader_of,
)
from pose_graph_ros.adapters.bag_writer import BagWriter
from pose_graph_ros.adapters.bags import Bag, BagError, MessageError, open_bags, Span
from pose_graph_ros.adapters.fixes import Datum
from pose_graph_ros.adapters.message_reader import MessageReader
from pose_graph_ros.adapters.sources import (
    backend_config,
    CLOSURES,
    Kind,
    ODOMETRY_KINDS,
    source_list,
)
from pose_graph_ros.cli import options as shared
from pose_graph_ros.cli.corrected_bag import LATCHED, write_corrected
from pose_graph_ros.cli.evaluation import consistency, consistency_lines, Drive, evaluate
from pose_graph_ros.cli.exports import (
    covariances,
    LivePoses,
    require_datum,
    write_exports,
    write_lines,
)
from pose_graph_ros.cli.graph_input import GRAPH_SUFFIXES, read_measurements
from pose_graph_ros.cli.progress import WatchedBag
from pose_graph_ros.cli.results import collect_drive, with_refused, write_results
from pose_graph_ros.cli.run.document import document, write_document
from pose_graph_ros.cli.run.recorder import Recorder, Run, Update
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import Estimate, UpdateReport
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.io.g2o_writing import write_g2o
from pose_graph_ros.core.judgement.texts import (
    as_json,
    is_notable,
    Key,
    ORDER,
    sentence,
    short,
    states_by_stamps,
    totals_text,
)
from pose_graph_ros.core.judgement.verdicts import (
    Judged,
    SourceVerdicts,
    State,
    Verdict,
)
from pose_graph_ros.core.measurements import Answer, LoopClosure, Measurement, OdometrySample
from pose_graph_ros.core.odometry.odometry_errors import AS_CLAIMED

UPDATE_EVERY = 10  # new hidden nodes after which the graph is updated, to stay near the optimum
NAMED = 10  # number of constraints of a source that the text names


class Replayed(NamedTuple):
    """Result of running a bag through the engine."""

    backend: PoseGraphBackend
    report: UpdateReport  # report of the final optimisation
    refused: Counter[tuple[str, str]]  # messages without a valid measurement, by source and reason
    datum: Datum | None = None  # of the map; None for a g2o file
    recorder: Recorder | None = None  # what was recorded on the way
    values: Mapping[str, Any] = MappingProxyType({})  # all parameters of the node
    kinds: Mapping[str, Kind] = MappingProxyType({})  # of the sources that have a topic

    @property
    def origin(self) -> MapOrigin | None:
        """Origin of the map on the Earth; None if it is unknown."""
        plane = None if self.datum is None else self.datum.plane
        return None if plane is None else plane.origin

    def reasons(self) -> dict[Key, str]:
        """Return why loop closures were refused."""
        unknown = dict.fromkeys(
            self.backend.refused_closures, 'Refused: it could not be attached to the path.')
        return unknown | ({} if self.recorder is None else self.recorder.refused)

    def states(self, verdicts: Sequence[Verdict]) -> dict[Key, State]:
        """Return what is believed, by source and stamps; refused loop closures are not."""
        refused = dict.fromkeys(self.backend.refused_closures, State.DOUBTED)
        return states_by_stamps(verdicts) | refused


def run(
    bag: Bag, inputs: Inputs, values: Mapping[str, Any], live: LivePoses | None = None,
) -> Replayed:
    """
    Return a new engine after adding all messages of a bag and a full optimisation.

    Parameters
    ----------
    values : mapping, all parameters of the node
    live : LivePoses, optional, as in `run_measurements`

    """
    reader = reader_of(bag, values)
    refused: Counter[tuple[str, str]] = Counter()
    recorder = Recorder()
    backend, report = run_measurements(
        measurements_of(bag, inputs, reader, refused), values, recorder, live)
    return Replayed(
        backend, report, refused, reader.datum, recorder, values, inputs.kinds)


def measurements_of(
    bag: Bag, inputs: Inputs, reader: MessageReader, refused: Counter[tuple[str, str]],
) -> Iterator[tuple[str, OdometrySample | Measurement]]:
    """
    Yield the valid measurements of a bag that are not held out, and their sources.

    Parameters
    ----------
    refused : Counter, receives the number of others by source and reason

    """
    for source, message, held_out in read_inputs(bag, inputs):
        if held_out:
            continue
        try:
            measurement = reader.read(source, message.decode())
        except MessageError:
            refused[source, 'malformed'] += 1
            continue
        if isinstance(measurement, Answer):
            refused[source, measurement.reason] += 1
        else:
            yield source, measurement


def run_measurements(
    measurements: Iterable[tuple[str, OdometrySample | Measurement]], values: Mapping[str, Any],
    recorder: Recorder | None = None, live: LivePoses | None = None,
) -> tuple[PoseGraphBackend, UpdateReport]:
    """
    Return a new engine after adding measurements, and the report of the full optimisation.

    Parameters
    ----------
    measurements : iterable, sources and measurements, in the order of their arrival
    values : mapping, all parameters of the node
    recorder : Recorder, optional, what is told of the run as it goes on
    live : LivePoses, optional, receives the poses as of each moment; updates are as it wants them

    """
    backend = PoseGraphBackend(backend_config(values))
    recorder = Recorder() if recorder is None else recorder
    next_update = UPDATE_EVERY
    for source, measurement in measurements:
        recorder.add_measurement(source, measurement.stamp_ns)
        if isinstance(measurement, OdometrySample):
            backend.add_odometry(measurement, source)
        else:
            recorder.add_answer(source, measurement, backend.add_measurement(measurement, source))
        if backend.graph.n_nodes >= next_update if live is None else live.is_due(
                measurement, backend.graph.n_nodes):
            begin = time.thread_time()  # of this process, however busy the machine is
            report = backend.update()
            recorder.log.add(Update(
                int(backend.node_stamps_ns[-1]), len(backend.node_stamps_ns),
                1e3 * (time.thread_time() - begin), report.chi2, report.iterations))
            next_update = backend.graph.n_nodes + UPDATE_EVERY
            if live is not None:
                live.updated(backend)
        if live is not None:
            live.add(measurement, source)
    return backend, backend.optimize()


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if any(path.suffix in GRAPH_SUFFIXES for path in options.bags):
        return _execute_g2o(options)
    values = shared.parameter_values(options)
    wanted = shared.wanted_topics(options)
    with ExitStack() as stack:
        bag = stack.enter_context(open_bags(options.bags))
        inputs = choose_inputs(
            bag, source_list(values), wanted, options.hold_out, span_of(bag, options),
            truth=options.truth)
        require_datum(options.export, known=len(values['datum']) > 0 or len(
            inputs.of(Kind.FIX)) > 0)
        writer = None if options.new_bag is None else stack.enter_context(
            BagWriter(options.new_bag, latched=LATCHED))
        if not options.json:
            print('\n'.join(f'{source}: {topic}' for source, topic in inputs.topics.items()))
        start = time.monotonic()
        live = LivePoses(values['frequency']) if options.live else None
        result = run(WatchedBag(bag, 'optimising'), inputs, values, live)
        seconds = time.monotonic() - start
        estimate = result.backend.estimate()
        if estimate is None:
            topics = ' or '.join(inputs.topics[name] for name in inputs.of(*ODOMETRY_KINDS))
            names = set(inputs.of(*ODOMETRY_KINDS))
            why = ', '.join(f'{answer} {count}' for (source, answer), count in sorted(
                (result.backend.counts + result.refused).items()) if source in names)
            raise BagError(f'{bag.path}: no usable odometry on {topics}: {why or "no messages"}')
        verdicts = result.backend.verdicts()
        drive = with_refused(collect_drive(
            WatchedBag(bag, 'comparing'), inputs, values, estimate.path, options.truth,
            origin=result.origin, states=result.states(verdicts)),
            result.backend)
        facts: dict[str, Any] = {'bags': [str(path) for path in options.bags]}
        if writer is not None:
            copied = write_corrected(
                writer, WatchedBag(bag, 'writing the bag'), inputs, values, estimate=estimate,
                covariances=covariances(result.backend, estimate))
            facts['new_bag'] = copied._asdict()
    return _report(options, drive, result, verdicts, facts | {'seconds': seconds}, live=live)


def span_of(bag: Bag, options: argparse.Namespace) -> Span:
    """Return the time of recording that the options ask for; raises `BagError` if it is empty."""
    limits = [None if seconds is None else bag.start_ns + round(seconds * 1e9)
              for seconds in (options.begin, options.until)]
    span, length = Span(*limits), (bag.end_ns - bag.start_ns) * 1e-9
    if (options.begin or 0.0) >= min(length, np.inf if options.until is None else options.until):
        raise BagError(f'{bag.path}: nothing was recorded between --from and --until; the '
                       f'recording is {max(length, 0.0):.3f} s long')
    return span


def _execute_g2o(options: argparse.Namespace) -> int:
    """Replay a g2o file."""
    if len(options.bags) > 1 or options.new_bag or options.live or options.begin or options.until:
        raise BagError(f'{options.bags[0]}: expected one .g2o file alone, without --bag, --live, '
                       '--from and --until')
    require_datum(options.export, known=False)
    path, = options.bags
    values = shared.parameter_values(options, {'odom.noise': 'twist'})
    measurements = read_measurements(path, options.stamps, options.edge2)
    odometry_source = next(
        source.name for source in source_list(values) if source.kind.is_odometry)
    start = time.monotonic()
    recorder = Recorder()
    backend, report = run_measurements((
        (odometry_source if isinstance(each, OdometrySample) else CLOSURES, each)
        for each in measurements), values, recorder)
    result = Replayed(backend, report, Counter(), None, recorder, values, {
        odometry_source: Kind.ODOMETRY, CLOSURES: Kind.LOOP_CLOSURE})
    seconds = time.monotonic() - start
    estimate = backend.estimate()
    assert estimate is not None, 'a graph has vertices'
    verdicts = backend.verdicts()
    states = result.states(verdicts)
    samples = [each for each in measurements if isinstance(each, OdometrySample)]
    loops = [(each.reference_ns or 0, each.stamp_ns) for each in measurements
             if isinstance(each, LoopClosure)]
    drive = Drive(
        Trajectory(np.array([each.stamp_ns for each in samples]),
                   np.array([each.pose for each in samples])),
        np.empty(0, dtype=np.int64), np.empty((0, 2)), np.empty(0, dtype=bool), estimate.path,
        None, np.array(loops, dtype=np.int64).reshape(-1, 2),
        loop_states=[states.get((CLOSURES, stamp, reference), State.BELIEVED)
                     for reference, stamp in loops])
    return _report(options, drive, result, verdicts, {'seconds': seconds})


def _report(
    options: argparse.Namespace, drive: Drive, result: Replayed, verdicts: Sequence[Verdict],
    facts: Mapping[str, Any], *, live: LivePoses | None = None,
) -> int:
    """Write the results and print a summary; return the exit code."""
    backend, report = result.backend, result.report
    estimate, totals = backend.estimate(), backend.verdict_totals()
    assert estimate is not None
    counts = {f'{source}.{answer}': count for (source, answer), count
              in sorted((backend.counts + result.refused).items())}
    title = options.bags[0].stem
    nees = {} if drive.truth is None or report.status is Status.FAILED else consistency(
        drive, covariances(backend, estimate))
    table = write_results(drive, options.out, title, {
        **facts, **{f'nees_{name}': each and asdict(each) for name, each in nees.items()},
        'alignment': estimate.alignment.value,
        'hidden_nodes': estimate.n_hidden, 'frozen_nodes': estimate.n_frozen,
        'thinned_nodes': estimate.n_thinned, 'edges': estimate.n_edges,
        'observed_nodes': estimate.n_observed, 'biases': estimate.n_biases,
        'chi2': estimate.chi2, 'odometry_errors': estimate.odometry_errors._asdict(),
        'status': report.status.value, 'counts': counts,
        'judged': judgement(totals, verdicts)})
    write_g2o(backend.graph, options.out / 'graph.g2o')
    write_document(document(Run(
        title, f'replay of {", ".join(path.name for path in options.bags)}', drive, backend,
        estimate, verdicts, result.recorder or Recorder(), result.values, result.kinds,
        backend.counts + result.refused, evaluate(drive), report, result.origin,
        facts['seconds'], result.reasons())), options.out)
    exported = write_exports(options.export, options.out, title, backend=backend,
                             estimate=estimate, datum=result.datum)
    if live is not None:
        exported.append(options.out / 'live.csv')
        write_lines(exported[-1], live.lines())
    if options.json:
        print((options.out / 'summary.json').read_text(encoding='utf-8'), end='')
    else:
        for line in _lines(result, estimate, verdicts, facts):
            print(line)
        print('counts: ' + ', '.join(f'{name} {count}' for name, count in counts.items()))
        names = ['drive.png', 'summary.json', 'run.json', 'graph.g2o',
                 *(path.name for path in exported)]
        table = '\n'.join([table, *consistency_lines(nees)])
        print(f'\n{table}\n\nwritten: {options.out}/path.tum, {", ".join(names)}')
    return 0 if report.status is Status.CONVERGED else 1


def _lines(
    result: Replayed, estimate: Estimate, verdicts: Sequence[Verdict], facts: Mapping[str, Any],
) -> Iterator[str]:
    """Yield what is told of a run."""
    backend, report = result.backend, result.report
    yield (f'{estimate.n_hidden} hidden nodes, {estimate.n_edges} edges, {estimate.n_observed} '
           f'observed nodes in {facts["seconds"]:.2f} s; {report.status.value}, chi2 '
           f'{report.chi2:.6g}; {estimate.alignment.value}')
    errors = estimate.odometry_errors
    if errors != AS_CLAIMED:
        yield (f'{estimate.primary}: noise of the way {short(math.sqrt(errors.way), 3)} times, of '
               f'turns {short(math.sqrt(errors.turn), 3)} times what it claims; corrected by '
               f'{short(errors.rate, 3)} rad/s and {short(100.0 * errors.scale, 3)} % of the way')
    for source, fit in sorted(backend.reports().items()):
        text = f'{source}: squared residual {short(fit.energy, 3)} sigma^2'
        if fit.errors.significant:
            text += (f'; errors of {short(fit.errors.sigma_correlated, 3)} m with a time constant '
                     f'of {short(fit.errors.tau, 3)} s')
        if fit.in_use is not None:
            text += f'; treated as correlated over {short(fit.in_use.tau, 3)} s'
        if fit.wrongly_white:
            text += f', but are treated as white: see {source}.correlation_time'
        yield text
    yield from judgement_lines(backend.verdict_totals(), verdicts)
    if 'new_bag' in facts:
        yield ('new bag: {original} messages copied, {left_out} left out, {corrected} poses of '
               'odometry corrected'.format(**facts['new_bag']))


def judgement(
    totals: Mapping[str, SourceVerdicts], verdicts: Sequence[Verdict],
) -> dict[str, object]:
    """
    Return counts and scale of each source, and all closures and all that is not believed.

    Parameters
    ----------
    totals : mapping, what is believed of each source

    """
    return {
        'sources': {source: {
            'states': {state.value: each.counts.get(state, 0) for state in ORDER},
            'scale': each.scale, 'forgotten': each.n_forgotten}
            for source, each in totals.items()},
        'constraints': [as_json(each) for each in verdicts
                        if each.kind is Judged.LOOP_CLOSURE or is_notable(each)]}


def judgement_lines(
    totals: Mapping[str, SourceVerdicts], verdicts: Sequence[Verdict],
) -> Iterator[str]:
    """
    Yield a line for each source, and for the first of its constraints that are doubted.

    Parameters
    ----------
    totals : mapping, what is believed of each source

    """
    for source, each in totals.items():
        yield f'{source}: {totals_text(each)}'
        doubted = [verdict for verdict in verdicts
                   if verdict.source == source and verdict.state is State.DOUBTED]
        for verdict in doubted[:NAMED]:
            yield f'  {verdict.id}: {sentence(verdict)}'
        if len(doubted) > NAMED:
            yield f'  and {len(doubted) - NAMED} more, all of which are in summary.json'
