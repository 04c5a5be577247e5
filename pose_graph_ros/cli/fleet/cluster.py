# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Do tasks on a Dask cluster: one that is given, or workers on this machine."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
import itertools
import logging
from multiprocessing import resource_tracker
from pathlib import Path
import signal
from typing import Any

import dask
from dask.distributed import as_completed, Client, Future, LocalCluster
from distributed import KilledWorker

from pose_graph_ros.adapters.bags import one_line
from pose_graph_ros.cli.fleet import table
from pose_graph_ros.cli.fleet.task import do, Task
from pose_graph_ros.core.exceptions import PoseGraphError

MOST_WAITING = 10_000  # tasks that the scheduler knows of at a time
TRIES = 4  # of a task whose workers die, by Dask's allowed-failures: once, and three times again
LOCAL = '127.0.0.1'
TO_LOG = 'import os\nos.dup2(os.open({!r}, os.O_WRONLY | os.O_APPEND | os.O_CREAT), 2)\n'
"""What a worker runs first."""
PATIENCE = 20.0  # until a scheduler answers [s]


class ClusterError(PoseGraphError):
    """A cluster cannot be reached, or was lost."""


@contextmanager
def connected(scheduler: str | None, workers: int | None, log: Path) -> Iterator[Client]:
    """
    Yield a client of the scheduler at an address, or of new workers on this machine.

    These are processes with one thread each, by default as many as there are processors. What they
    say goes to the log.
    """
    # a worker gets one task at a time: if it dies, no other counts as one that kills workers
    settings = {'distributed.scheduler.worker-saturation': 1.0,
                'distributed.scheduler.allowed-failures': TRIES - 1,
                # on a busy machine a worker takes long to start again
                'distributed.deploy.lost-worker-timeout': '1h',
                # one whose memory a large bag has left fragmented would wait for ever
                'distributed.worker.memory.pause': False,
                # threads of a worker that look 150 times a second at what the task is doing
                'distributed.worker.profile.enabled': False,
                'distributed.admin.tick.interval': '500ms',
                # memory that is given back after each small array has to be fetched again
                'distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_': 2**27}
    # what dies is told below, by bag
    for handler in logging.getLogger('distributed').handlers:
        handler.setLevel(logging.CRITICAL)
    with dask.config.set(settings):
        if scheduler is not None:
            try:
                client = Client(scheduler, timeout=PATIENCE, set_as_default=False)
            except (OSError, ValueError) as error:
                raise ClusterError(
                    f'--scheduler {scheduler}: no answer: {one_line(error)}') from error
            with client:
                yield client
            return
        # Ctrl-C reaches all processes of a terminal; the mask, which workers inherit, keeps it
        # from them, so that this process ends them
        resource_tracker.ensure_running()   # which would unblock it, if a worker was the first
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, host=LOCAL,
                dashboard_address=f'{LOCAL}:0', silence_logs=logging.CRITICAL,
                preload=[TO_LOG.format(str(log.absolute()))])
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        with cluster, Client(cluster, set_as_default=False) as client:
            yield client


def results(client: Client, tasks: Collection[Task]) -> Iterator[tuple[Task, dict[str, Any]]]:
    """
    Yield tasks with what they return, in the order in which they are done.

    Of a task whose workers died again and again, it is a failed row. Raises `ClusterError` if the
    scheduler is lost.
    """
    # Dask keeps what is more than twice the threads until a worker is free; fewer it hands out at
    # once, where they count as suspects if a worker that has several of them dies
    threads, rest = sum(client.nthreads().values()), iter(tasks)
    at_once = MOST_WAITING if len(tasks) > 2 * threads else threads
    numbers = itertools.count()

    def submit(some: list[Task]) -> list[Future]:
        # in one group, so that Dask keeps them until a worker is free
        futures = client.map(do, some, key=[
            (f'replay-{each.run}', next(numbers), each.recording.name) for each in some])
        known.update((each.key, task) for each, task in zip(futures, some, strict=True))
        return futures

    known: dict[Any, Task] = {}
    waiting = as_completed(submit([*itertools.islice(rest, at_once)]), loop=client.loop)
    for future in waiting:
        task = known.pop(future.key)
        yield task, _row(future)
        future.release()
        if (more := next(rest, None)) is not None:
            waiting.update(submit([more]))


def _row(future: Future) -> dict[str, Any]:
    try:
        row: dict[str, Any] = future.result()
        return row
    except KilledWorker:
        return table.failed_row(f'its worker died {TRIES} times; if it had too little memory, '
                                'fewer workers have more each')
    except Exception as error:  # of a worker that cannot even read the task
        if isinstance(error, OSError) or future.status != 'error':
            raise ClusterError('the scheduler is lost') from error
        return table.failed_row(f'{type(error).__name__}: {one_line(error)}')
