# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The services of the node; each answers what was done, or why it was not."""

from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine, Generator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from functools import partial
import logging
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.service import Service
from std_srvs.srv import SetBool, Trigger

from pose_graph_ros.adapters.sources import backend_config
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.exceptions import FileFormatError, PoseGraphError
from pose_graph_ros.core.io.graph_files import write_graph
from pose_graph_ros.core.io.saved_graph import SavedGraph, site_refusal
from pose_graph_ros.ros.graph_file import graph_path, restored
from pose_graph_ros.ros.session import Session
from pose_graph_ros.ros.worker import Worker

logger = logging.getLogger(__name__)

REPLACED = 'the graph was replaced meanwhile'
CLOSED = 'the node was cleaned up meanwhile'
FILE_THREADS = 'graph files'  # what the names of the threads that read and write them begin with
Answer = tuple[bool, str]
"""Whether what was asked for was done, and a sentence on it."""
Action = Coroutine['Future[Any]', None, Answer]
"""What is done for a request; it awaits futures of other threads, by `_Done`."""


class _Done:
    """Awaits a result of another thread, while other callbacks are served."""

    def __init__(self, future: 'Future[Any]') -> None:
        self._future = future

    def __await__(self) -> Generator['Future[Any]', None, Any]:
        yield self._future
        return self._future.result()


class Services:
    """Offers the services of a configured node."""

    def __init__(self, node: Node, session: Session) -> None:
        self._node, self._session = node, session
        self._offered: dict[str, Service] = {}
        self._answering: Counter[str] = Counter()  # number of requests by service
        self._closed = False
        # files of a large graph take seconds: neither worker nor executor should wait for them
        self._files = ThreadPoolExecutor(1, FILE_THREADS)
        for name, kind, act in (
                ('optimize', Trigger, self._optimize), ('reset', Trigger, self._reset),
                ('pause', SetBool, self._pause), ('set_datum', Trigger, self._set_datum),
                ('save_graph', Trigger, partial(self._with_file, self._save)),
                ('load_graph', Trigger, partial(self._with_file, self._load))):
            self._offered[name] = self._offer(name, kind, act)

    def close(self) -> None:
        """
        Destroy the services, each after the request that it still has to answer.

        A file that is being written is completed in its thread, for which nobody waits here.
        """
        self._closed = True
        if self._answering['save_graph'] > 0:
            self._node.get_logger().warning('the graph is still being saved')
        self._files.shutdown(wait=False, cancel_futures=True)
        for name in self._offered.keys() - +self._answering:
            self._node.destroy_service(self._offered.pop(name))

    def _offer(self, name: str, kind: Any, act: Callable[[Any], Action]) -> Service:
        """Create a service whose response is sent when the action is done."""
        def respond(request: Any, header: object) -> None:
            def answer(success: bool, message: str) -> None:
                self._answering[name] -= 1
                send(kind.Response(success=success, message=message), header)
                if self._closed and self._answering[name] == 0:
                    self._node.destroy_service(self._offered.pop(name))

            self._answering[name] += 1
            if self._closed:
                answer(False, CLOSED)
            else:
                self._continue(act(request), answer)

        service = self._node.create_service(kind, f'~/{name}', lambda request, _: request)
        # not all executors of rclpy await a callback: it is run where they send the response
        send, service.send_response = service.send_response, respond
        return service

    def _continue(self, action: Action, answer: Callable[[bool, str], None]) -> None:
        """Run an action until it awaits another thread; then, in the executor, go on."""
        try:
            awaited = action.send(None)
        except StopIteration as end:
            answer(*end.value)
        except CancelledError:
            answer(False, CLOSED if self._closed else REPLACED)
        except Exception as error:
            logger.exception('a service failed')
            answer(False, f'failed: {type(error).__name__}: {error}')
        else:
            executor = self._node.executor
            awaited.add_done_callback(
                lambda _: executor.create_task(self._continue, action, answer))

    async def _in_file_thread(self, job: Callable[..., Any], *arguments: Any) -> Any:
        """Await what a function returns that reads or writes files."""
        if self._closed:
            raise CancelledError
        return await _Done(self._files.submit(job, *arguments))

    def _require_present(self, worker: Worker) -> None:
        """Raise `CancelledError` if a worker's graph is no longer that of the node."""
        if self._closed or self._session.worker is not worker:
            raise CancelledError

    async def _optimize(self, _: Trigger.Request) -> Answer:
        worker = self._session.worker
        try:
            report = await _Done(self._session.optimize())
        except CancelledError:
            raise
        except Exception as error:
            return False, f'failed: {error}'
        self._require_present(worker)
        if worker.estimate is None:
            return False, 'there is no odometry yet'
        return report.status is Status.CONVERGED, (
            f'{report.status.value} after {report.iterations} iterations, chi2 {report.chi2:.6g}'
            + (f': {report.reason}' if report.reason != '' else ''))

    async def _reset(self, _: Trigger.Request) -> Answer:
        estimate = self._session.worker.estimate
        self._session.reset()
        plane = self._session.input.reader.datum.plane
        return True, (
            f'{0 if estimate is None else estimate.n_hidden} hidden nodes are gone; '
            + ('the next good fix will be the datum' if plane is None else
               f'the datum is still [{plane.latitude:.9f}, {plane.longitude:.9f}]'))

    async def _pause(self, request: SetBool.Request) -> Answer:
        received = self._session.input
        if received.paused == request.data:
            return True, 'paused already' if request.data else 'was not paused'
        received.paused = request.data
        return True, (
            'paused: measurements are counted but not used; poses still follow the odometry'
            if request.data else 'resumed')

    async def _set_datum(self, _: Trigger.Request) -> Answer:
        """Let the next good fix be the datum, unless the graph refers to the present one."""
        session, worker = self._session, self._session.worker
        for _ in range(10):  # more may be posted meanwhile
            if worker.status.processed < session.input.posted:
                await _Done(worker.call(lambda _: None))
        self._require_present(worker)
        status, datum = worker.status, session.input.reader.datum
        used = sum(status.counts[name, 'accepted'] for name in session.input.reader.fixes)
        if datum.is_of_graph:
            return False, 'refused: the graph that was loaded refers to the present datum'
        if datum.plane is not None and used > 0:
            return False, (f'refused: {used} fixes in the graph refer to the datum '
                           f'[{datum.plane.latitude:.9f}, {datum.plane.longitude:.9f}]')
        if datum.plane is not None and (
                status.pending > 0 or status.processed < session.input.posted):
            return False, ('refused: measurements that wait for odometry may refer to the '
                           'present datum')
        datum.renew()
        return True, 'the next good fix will be the datum'

    async def _with_file(
        self, act: Callable[[Path], Awaitable[str]], _: Trigger.Request,
    ) -> Answer:
        """Return the answer of an action on the file of the graph."""
        hint = (f'; to name another file: ros2 param set {self._node.get_fully_qualified_name()} '
                'graph_file FILE')
        try:
            return True, await act(graph_path(self._session.values)) + hint
        except CancelledError:
            raise
        except PoseGraphError as error:
            return False, f'refused: {error}{hint}'
        except Exception as error:
            logger.exception('the file of the graph failed')
            return False, f'failed: {type(error).__name__}: {error}'

    async def _save(self, path: Path) -> str:
        """Write the graph, all or nothing."""
        plane = self._session.input.reader.datum.plane

        def capture(backend: PoseGraphBackend) -> SavedGraph:
            backend.update()
            return backend.saved(None if plane is None else plane.origin)

        saved = await _Done(self._session.worker.call(capture, 'a copy of the graph'))
        files = await self._in_file_thread(write_graph, saved, path)
        left_out = '' if saved.n_left_out == 0 else (
            f'; not in it: {saved.n_left_out} that wait for odometry or for the alignment')
        return (f'{len(saved.nodes.ids)} hidden nodes in {files[0]}, with '
                f'{files[1].name} and {files[2].name}{left_out}')

    async def _load(self, path: Path) -> str:
        """Replace the graph by the one in a file, if it is of the present site."""
        session, worker = self._session, self._session.worker
        # wait until the worker has prepared the kernels, which reading needs
        await _Done(worker.call(lambda _: None))
        saved, backend = await self._in_file_thread(
            restored, path, backend_config(session.values))
        # all that follows is about now: in the meantime a datum or parameters may have been set
        self._require_present(worker)
        datum = session.input.reader.datum
        origin = None if datum.plane is None else datum.plane.origin
        refusal = site_refusal(saved, *((origin, None) if datum.is_given else (None, origin)))
        if refusal is not None:
            raise FileFormatError(refusal)
        backend.configure(backend_config(session.values))
        session.load(saved, backend, str(path))
        return (f'{len(saved.nodes.ids)} hidden nodes from {path}, datum '
                f'{"none" if saved.datum is None else saved.datum}')
