# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Estimate the noise of odometry and of what measures in the map; write a parameter file."""

import argparse
from collections.abc import Mapping
from dataclasses import asdict
import json
import os
import sys
import time
from typing import Any

from pose_graph_ros.adapters.bags import BagError, open_bag
from pose_graph_ros.cli import shared
from pose_graph_ros.cli.drive import read_truth
from pose_graph_ros.cli.tuned_parameters import interval, yaml_text
from pose_graph_ros.cli.tuning import Outcome, Tuning, Verdict


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    start = time.monotonic()
    values = shared.parameter_values(options)
    if options.out.is_dir():
        raise BagError(f'{options.out}: is a folder; expected a file to write')
    if not options.out.resolve().parent.is_dir():
        raise BagError(f'{options.out}: there is no folder {options.out.resolve().parent}')
    where = options.out if options.out.exists() else options.out.resolve().parent
    if not os.access(where, os.W_OK):
        raise BagError(f'{options.out}: cannot be written: no permission')
    with open_bag(*options.bags) as bag:
        inputs = shared.inputs_of(bag, options, values)
        truth = None if options.truth is None else read_truth(bag, options.truth)
        tuning = Tuning(shared.watched_bag(bag, 'reading'), inputs, values, _show)
    try:
        outcome = tuning.tune(options.folds, truth, options.stretch)
    finally:
        _show('')
    names = ' '.join(each.name for each in options.bags)
    headline = [f'Noise by `pose-graph tune {names}`', *_notes(outcome, tuning)]
    is_better = outcome.verdict is Verdict.BETTER
    if is_better:
        options.out.write_text(yaml_text(outcome.tuned, headline), encoding='utf-8')
    if options.json:
        print(json.dumps(_facts(options, outcome, tuning, time.monotonic() - start), indent=2))
    else:
        print('\n'.join(f'{source}: {topic}' for source, topic in inputs.topics.items()))
        print('\n'.join(_lines(outcome, tuning)))
        print(f'\nwritten: {options.out}' if is_better else '\nnothing is written')
    return 0 if is_better else 1


def _show(text: str) -> None:
    """Say on a terminal what is being done, in place of what was said before."""
    if sys.stderr.isatty():
        print(f'\r\x1b[K{text}', end='', file=sys.stderr, flush=True)


def _notes(outcome: Outcome, tuning: Tuning) -> list[str]:
    """Return what is to be known of the estimate."""
    notes = [f'{outcome.measured}; {outcome.folds} parts of the drive held out in turn, in '
             f'stretches of {outcome.stretch:.3g} s']
    if tuning.is_cut:
        notes.append('the bag is long: only its first part was read')
    if outcome.n_doubted > 0:
        notes.append(f'{outcome.n_doubted} measurements contradict the others and were left out')
    return [*notes, outcome.verdict.value]


def _lines(outcome: Outcome, tuning: Tuning) -> list[str]:
    """Return the tables as text."""
    rows = [('', 'before', 'after', '95 %', ''), *(
        (each.name, _value(each.before), _value(each.after) if each.changes else '',
         interval(each), each.note.strip('; ')) for each in outcome.tuned)]
    widths = [max(len(row[k]) for row in rows) for k in range(4)]
    lines = ['', *('  '.join([f'{row[0]:<{widths[0]}}', *(
        f'{cell:>{width}}' for cell, width in zip(row[1:4], widths[1:], strict=True)),
        row[4]]).rstrip() for row in rows)]
    lines += ['', f'{"held out":<22}{"rms":>9}{"median":>9}{"NEES":>9}{"NLPD":>9}'
                  f'{"correlation":>13}{"count":>8}']
    for name, of in (('before', outcome.before), ('after', outcome.after)):
        lines.append(
            f'{name:<22}{of.rms:>7.3f} m{of.median:>7.3f} m{of.nees:>9.3g}{of.nlpd:>9.3f}'
            f'{of.correlation_time:>11.3g} s{of.n:>8}')
    for name, error in zip(('before, to truth', 'after, to truth'), outcome.to_truth,
                           strict=False):
        lines.append(f'{name:<22}{error:>7.3f} m')
    return [*lines, '', *_notes(outcome, tuning)]


def _value(value: Any) -> str:
    """Return a value for the table."""
    if isinstance(value, list | tuple):
        return '[' + ', '.join(map(_value, value)) + ']' if len(value) > 0 else 'unset'
    return f'{value:.4g}' if isinstance(value, int | float) else str(value)


def _facts(
    options: argparse.Namespace, outcome: Outcome, tuning: Tuning, seconds: float,
) -> dict[str, Any]:
    """Return the results as plain values for JSON."""
    return {
        'bags': [str(each) for each in options.bags],
        'file': str(options.out) if outcome.verdict is Verdict.BETTER else None,
        'verdict': outcome.verdict.name.lower(), 'reason': outcome.verdict.value,
        'parameters': [_plain(asdict(each)) | {'changed': each.changes}
                       for each in outcome.tuned],
        'before': _plain(outcome.before._asdict()), 'after': _plain(outcome.after._asdict()),
        'to_truth': _plain(dict(zip(
            ('before', 'after'), outcome.to_truth, strict=False))) or None,
        'folds': outcome.folds, 'stretch_s': outcome.stretch, 'doubted': outcome.n_doubted,
        'is_cut': tuning.is_cut, 'seconds': seconds}


def _plain(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return facts with null for what is not a finite number, which JSON does not know."""
    return {name: None if isinstance(value, float) and not abs(value) < float('inf') else value
            for name, value in facts.items()}
