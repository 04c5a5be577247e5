# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Updates of the back end, each of which is applied completely or rolled back.

Only those constraints that make an update fail are set aside. The search halves a queue that
fails: if its first half can be added, a bad one is in the second. Each bad one of n constraints
takes about log2 n attempts, and all halves that pass are added on the way.
"""

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeVar

from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.disagreement import queued
from pose_graph_ros.core.estimate import UpdateReport
from pose_graph_ros.core.exceptions import INTERRUPTED, LinearSolveError
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.parts import Parts
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother, UpdateResult
from pose_graph_ros.core.sources.queued import Queued

Solved = TypeVar('Solved', UpdateResult, UpdateReport)


def checked(result: Solved) -> Solved:
    """Return the result of the solver; raise LinearSolveError if it has failed."""
    if result.status is Status.FAILED:
        raise LinearSolveError(result.reason)
    return result


class Transaction(ExitStack[bool]):
    """
    Context manager that undoes what is done in it, the last first, if an exception ends it.

    Who changes anything in it says how that is undone, with `callback`; what can wait until it has
    succeeded is done after it. It suppresses an `Exception`, and stores its message in `failure`.
    The smoother rolls back its own changes, bit for bit.
    """

    def __init__(self) -> None:
        super().__init__()
        self.failure = ''  # why all was undone; empty if it was not

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> bool:
        if error is None:
            self.pop_all()
            return False
        self.failure = str(error)
        if not isinstance(error, LinearSolveError):
            self.failure = f'{type(error).__name__}: {error}'
        super().__exit__(kind, error, traceback)
        return isinstance(error, Exception)


def succeeds(smoother: IncrementalSmoother, update: GraphUpdate) -> bool:
    """Tell whether an update of the graph, which is taken whole or not at all, succeeds."""
    with Transaction() as transaction:
        checked(smoother.update(update))
    return transaction.failure == ''


# Maximum number of attempts in one search, which bounds the time of an update.
MOST_ATTEMPTS = 32


# adds what is in the queue of the pipeline; returns the report, and the constraints left over
Update = Callable[[], tuple[UpdateReport, list[Queued]]]


def update_isolated(add_queue: Update, parts: Parts) -> tuple[UpdateReport, list[Queued]]:
    """
    Return the report of an update, and the constraints that were not tried in it.

    If it sets constraints aside, it has the status FAILED, and the reason names them. None of them
    is to blame for an interruption.
    """
    (report, failed), pipeline = add_queue(), parts.pipeline
    if report.status is not Status.FAILED or report.reason == INTERRUPTED:
        return report, failed
    pipeline.counts['solver', 'failed'] += 1
    if len(failed) == 0 or (len(failed) > 1 and not succeeds(parts.smoother, GraphUpdate())):
        parts.quarantine.extend(failed)
        return report, []
    added = [report]

    def attempt(part: list[Queued]) -> str:
        waiting = pipeline.queue
        pipeline.queue = part + waiting
        again, _ = add_queue()
        if again.status is Status.FAILED:
            pipeline.queue = waiting
            return again.reason
        added.append(again)
        return ''

    bad, untried = isolate(failed, report.reason, attempt)
    for one, _ in bad:
        parts.quarantine.extend(one)
    reasons = [f'{queued(one, parts)[0]}: {reason}' for one, reason in bad[:5]] or [report.reason]
    if len(bad) > 5:
        reasons.append(f'and {len(bad) - 5} more')
    return added[-1]._replace(status=Status.FAILED, reason='; '.join(reasons), new_constraints=sum(
        each.new_constraints for each in added)), untried


def update_with_all(update: Update, parts: Parts) -> UpdateReport:
    """
    Return one report of updates with all constraints in the queue, then with those set aside.
    """
    (report, untried), pipeline, quarantine = update(), parts.pipeline, parts.quarantine
    while len(untried) > 0 and report.reason != INTERRUPTED:    # each update sets one aside
        pipeline.queue = untried + pipeline.queue
        again, untried = update()
        report = report.before(again)
    pipeline.queue = untried + pipeline.queue
    if len(quarantine) > 0 and report.reason != INTERRUPTED:
        pipeline.queue += quarantine
        quarantine.clear()
        again, untried = update()
        # they are the first ones the next time
        quarantine[:] = untried + quarantine
        report = report.before(again)
    return report


def isolate(
    failed: list[Queued], reason: str, attempt: Callable[[list[Queued]], str],
) -> tuple[list[tuple[list[Queued], str]], list[Queued]]:
    """
    Return the bad constraints of a queue that cannot be added whole, after adding the rest.

    With each comes why. Second come those for which there were no attempts left.

    `attempt` adds all constraints of a queue, or none; it returns why it cannot, or ''.
    """
    bad, untried, suspects, attempts = [], list[Queued](), failed, 0
    why: str | None = reason    # '' if one of them has to be bad, None if nothing is known of them
    while True:
        if why and why != INTERRUPTED and len(suspects) == 1:
            bad.append((suspects, why))
            suspects, untried, why = untried, [], None
        if len(suspects) == 0 or attempts == MOST_ATTEMPTS or why == INTERRUPTED:
            return bad, suspects + untried
        # one alone is suspected because all others were added
        whole = why is None or len(suspects) == 1
        n = len(suspects) if whole else len(suspects) // 2
        attempts, found = attempts + 1, attempt(suspects[:n])
        if found != '':
            suspects, untried, why = suspects[:n], suspects[n:] + untried, found
        elif whole:
            suspects, untried, why = untried, [], None
        else:
            suspects, why = suspects[n:], ''
