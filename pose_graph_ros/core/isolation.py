# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
An update that sets aside only those constraints that make it fail, and adds all others.

The search halves a queue that fails: if its first half can be added, a bad one is in the second.
Each bad one of n constraints takes about log2 n attempts, and all halves that pass are added on
the way.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.sources.constraint_queue import Queue
from pose_graph_ros.core.sources.pipeline import MeasurementPipeline

# Maximum number of attempts in one search, which bounds the time of an update.
MOST_ATTEMPTS = 32
# Number of constraints that a report names.
MOST_NAMED = 5


Update = Callable[[], tuple[UpdateReport, Queue]]
"""Adds what is in the queue of the pipeline; returns the report, and the constraints left over."""


class Isolated(NamedTuple):
    """Result of a search."""

    bad: list[tuple[Queue, str]]
    """Single constraints that cannot be added, and why."""
    untried: Queue
    """Constraints that were not added, as there were no attempts left."""


def update(
    add_queue: Update, can_solve: Callable[[], bool], pipeline: MeasurementPipeline,
    quarantine: Queue, name: Callable[[Queue], str],
) -> tuple[UpdateReport, Queue]:
    """
    Return the report of an update, and the constraints that were not tried in it.

    If it sets constraints aside, it has the status FAILED, and the reason names them.

    Parameters
    ----------
    add_queue : Update, adds all constraints that it takes from the queue, or none
    can_solve : callable, tells whether an update without new constraints succeeds
    pipeline : MeasurementPipeline
    quarantine : Queue, receives the constraints that are set aside
    name : callable, returns the name of a constraint

    """
    report, failed = add_queue()
    if report.status is not Status.FAILED:
        return report, failed
    pipeline.counts['solver', 'failed'] += 1
    if len(failed) == 0 or (len(failed) > 1 and not can_solve()):
        quarantine.extend(failed)
        return report, Queue()
    added = [report]

    def attempt(part: Queue) -> str:
        waiting = pipeline.queue
        pipeline.queue = part.joined(waiting)
        again, _ = add_queue()
        if again.status is Status.FAILED:
            pipeline.queue = waiting
            return again.reason
        added.append(again)
        return ''

    bad, untried = isolate(failed, report.reason, attempt)
    for one, _ in bad:
        quarantine.extend(one)
    reasons = [f'{name(one)}: {reason}' for one, reason in bad[:MOST_NAMED]] or [report.reason]
    if len(bad) > MOST_NAMED:
        reasons.append(f'and {len(bad) - MOST_NAMED} more')
    return replace(
        added[-1], status=Status.FAILED, reason='; '.join(reasons),
        new_constraints=sum(each.new_constraints for each in added)), untried


def update_with_all(
    update: Update, pipeline: MeasurementPipeline, quarantine: Queue,
) -> UpdateReport:
    """
    Return one report of updates with all constraints in the queue, then with those set aside.

    Parameters
    ----------
    update : Update, puts constraints that it cannot add into the quarantine
    pipeline : MeasurementPipeline
    quarantine : Queue

    """
    report, untried = update()
    while len(untried) > 0:     # each update sets at least one aside
        pipeline.queue = untried.joined(pipeline.queue)
        again, untried = update()
        report = report.before(again)
    if len(quarantine) > 0:
        pipeline.queue.extend(quarantine)
        quarantine.replace_by(Queue())
        again, untried = update()
        # they are the first ones the next time
        quarantine.replace_by(untried.joined(quarantine))
        report = report.before(again)
    return report


def isolate(failed: Queue, reason: str, attempt: Callable[[Queue], str]) -> Isolated:
    """
    Return the bad constraints of a queue, after adding all others.

    Parameters
    ----------
    failed : Queue, at least one constraint; it cannot be added as a whole
    reason : str, why not
    attempt : callable
        Adds all constraints of a queue, or none; returns why it cannot, or an empty string.

    """
    bad: list[tuple[Queue, str]] = []
    suspects, untried, attempts = failed, Queue(), 0
    while True:
        while len(suspects) > 1:
            if attempts >= MOST_ATTEMPTS:
                return Isolated(bad, suspects.joined(untried))
            half, rest = suspects.halves()
            attempts, reason = attempts + 1, attempt(half)
            suspects, untried = (
                (rest, untried) if reason == '' else (half, rest.joined(untried)))
        if reason == '':    # suspected because all others were added
            attempts, reason = attempts + 1, attempt(suspects)
        if reason != '':
            bad.append((suspects, reason))
        if len(untried) == 0 or attempts >= MOST_ATTEMPTS:
            return Isolated(bad, untried)
        attempts, reason = attempts + 1, attempt(untried)
        if reason == '':
            return Isolated(bad, Queue())
        suspects, untried = untried, Queue()
