# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The services of the node; each answers what was done, or why it was not.

Those that wait, for the worker or for files, are served by a thread and a hidden node of their
own, so that neither odometry nor transforms wait for them.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future
import logging
from pathlib import Path
from threading import Thread
from typing import Any

from rclpy.node import Node
from rclpy.service import Service
from std_srvs.srv import SetBool, Trigger

from pose_graph_ros.adapters.sources import backend_config, IMU
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.exceptions import FileFormatError, PoseGraphError
from pose_graph_ros.core.io.graph_files import SavedGraph, site_refusal, write_graph
from pose_graph_ros.ros.session import Session
from pose_graph_ros.ros.spinning import Spinner
from pose_graph_ros.ros.stored_graphs import graph_path, restored
from pose_graph_ros.ros.worker import Worker

logger = logging.getLogger(__name__)

REPLACED = 'the graph was replaced meanwhile'
CLOSED = 'the node was cleaned up meanwhile'
HIDDEN_NODE = '_services'
Answer = tuple[bool, str]
"""Whether what was asked for was done, and a sentence on it."""


class ServiceThread:
    """
    A hidden node and its thread, for services that wait.

    There is one as long as there is a process: rclpy gives back little of what a node takes.
    """

    def __init__(self, node: Node) -> None:
        # it is within the node's own name, and none of the arguments that rename that are for it
        self.node = Node(HIDDEN_NODE, namespace=node.get_fully_qualified_name(),
                         context=node.context, use_global_arguments=False, enable_rosout=False,
                         start_parameter_services=False)
        self._spinner = Spinner(self.node)
        self._thread = Thread(target=self._serve, name='pose graph services', daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        self._spinner.spin()
        self._spinner.close()
        self.node.destroy_node()

    def destroy(self, services: Sequence[Service]) -> None:
        """Destroy services of the node, once what is done at present is done."""
        def act() -> None:
            for service in services:
                self.node.destroy_service(service)
        assert self.node.executor is not None, 'it spins'
        self.node.executor.create_task(act)

    def close(self, timeout: float) -> None:
        """Destroy the node once what is done at present is done; wait up to a time for it [s]."""
        self._spinner.stop()
        self._thread.join(timeout)


class Services:
    """Offers the services of a configured node."""

    def __init__(self, node: Node, session: Session, thread: ServiceThread) -> None:
        self._node, self._session, self._thread = node, session, thread
        self._closed = self._saving = False
        self._quick: list[Service] = [
            node.create_service(Trigger, '~/reset', self._answering(self._reset)),
            node.create_service(SetBool, '~/pause', self._answering(self._pause))]
        self._waiting: list[Service] = [
            thread.node.create_service(Trigger, name, self._answering(act)) for name, act in (
                ('optimize', self._optimize), ('set_datum', self._set_datum),
                ('undo_reset', self._undo_reset), ('save_graph', self._with_file(self._save)),
                ('load_graph', self._with_file(self._load)))]

    def close(self) -> None:
        """
        Destroy the services, those that wait after the request that they still have to answer.

        A file that is being written is completed in the thread, for which nobody waits here.
        """
        self._closed = True
        if self._saving:
            logger.warning('the graph is still being saved')
        for service in self._quick:
            self._node.destroy_service(service)
        self._thread.destroy(self._waiting)

    def _answering(self, act: Callable[[Any], Answer]) -> Callable[[Any, Any], Any]:
        """Return the callback of a service, which never raises."""
        def answer(request: Any, response: Any) -> Any:
            response.success, response.message = self._done(lambda: act(request))
            return response
        return answer

    def _done(self, act: Callable[[], Answer]) -> Answer:
        """Do what is asked for, and return the answer, whatever happens."""
        try:
            return (False, CLOSED) if self._closed else act()
        except CancelledError:
            return False, CLOSED if self._closed else REPLACED
        except Exception as error:
            logger.exception('a service failed')
            return False, f'failed: {type(error).__name__}: {error}'

    def _require_present(self, worker: Worker) -> None:
        """Raise `CancelledError` if a worker's graph is no longer that of the node."""
        if self._closed or self._session.worker is not worker:
            raise CancelledError

    def _optimize(self, _: Trigger.Request) -> Answer:
        worker = self._session.worker
        try:
            report = self._session.optimize().result()
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

    def _reset(self, _: Trigger.Request) -> Answer:
        estimate = self._session.worker.estimate
        self._session.reset()
        plane = self._session.input.reader.datum.plane
        return True, f'{0 if estimate is None else estimate.n_hidden} hidden nodes are gone; ' + (
            'the next good fix will be the datum' if plane is None else
            f'the datum is still [{plane.latitude:.9f}, {plane.longitude:.9f}]') + (
            '' if self._session.replaced is None else
            f'; what can be brought back: {self._session.replaced}')

    def _undo_reset(self, _: Trigger.Request) -> Answer:
        session, replaced = self._session, self._session.replaced
        if replaced is None:
            return False, 'refused: no graph was replaced, or it is back already'
        # in the middle of an update it has no graph that can go on
        if not replaced.worker.stop(30.0):
            return False, 'refused: the solver still works on that graph: call again'

        def bring_back() -> None:
            if self._closed or session.replaced is not replaced:
                raise CancelledError
            session.undo_reset(replaced)
        self._do_in_callbacks(bring_back)
        return True, f'{replaced.n_hidden} hidden nodes are back' + (
            '' if session.replaced is None else f'; the graph in exchange: {session.replaced}')

    def _do_in_callbacks(self, act: Callable[[], None]) -> None:
        """Do something in the thread of the node's callbacks, and wait for it."""
        done: Future[None] = Future()

        def settle() -> None:
            try:
                act()
            except BaseException as error:
                done.set_exception(error)
            else:
                done.set_result(None)
        assert self._node.executor is not None, 'a node that is served is spun'
        self._node.executor.create_task(settle)
        done.result()

    def _pause(self, request: SetBool.Request) -> Answer:
        before, self._session.input.paused = self._session.input.paused, request.data
        if before == request.data:
            return True, 'paused already' if request.data else 'was not paused'
        return True, ('paused: measurements are counted but not used; poses still '
                      'follow the odometry' if request.data else 'resumed')

    def _set_datum(self, _: Trigger.Request) -> Answer:
        """Let the next good fix be the datum, unless the graph refers to the present one."""
        datum = self._session.input.reader.datum
        if datum.is_given:
            return False, 'refused: it is given, by the parameter or the service datum'
        if (refusal := self._datum_refusal()) != '':
            return False, refusal
        datum.renew()
        return True, 'the next good fix will be the datum'

    def _datum_refusal(self, *, is_turned: bool = False) -> str:
        """
        Return why the datum cannot be another one, whose map may be turned; empty if it can.
        """
        session, worker = self._session, self._session.worker
        for _ in range(10):  # more may be posted meanwhile
            if worker.status.processed < session.input.posted:
                worker.call(lambda _: None).result()
        self._require_present(worker)
        status, datum = worker.status, session.input.reader.datum
        used = sum(status.counts[name, 'accepted'] for name, source
                   in session.input.reader.sources.items() if source.kind.on_earth)
        headings = sum(status.counts[name, 'accepted'] for name, source
                       in session.input.reader.sources.items() if source.kind is IMU)
        if datum.is_of_graph:
            return 'refused: the graph that was loaded refers to the present datum'
        if (plane := datum.plane) is not None and used > 0:
            return (f'refused: {used} fixes in the graph refer to the datum '
                    f'[{plane.latitude:.9f}, {plane.longitude:.9f}]')
        if is_turned and headings > 0:
            return f'refused: {headings} headings in the graph refer to the present x axis'
        if plane is not None and (status.pending > 0 or status.processed < session.input.posted):
            return 'refused: measurements that wait for odometry may refer to the present datum'
        return ''

    def _with_file(self, act: Callable[[Path], str]) -> Callable[[Trigger.Request], Answer]:
        """Return an action on the file of the graph."""
        hint = (f'; to name another file: ros2 param set {self._node.get_fully_qualified_name()} '
                'graph_file FILE')

        def answer(_: Trigger.Request) -> Answer:
            try:
                return True, act(graph_path(self._session.values)) + hint
            except PoseGraphError as error:
                return False, f'refused: {error}{hint}'
        return answer

    def _save(self, path: Path) -> str:
        """Write the graph, all or nothing."""
        plane = self._session.input.reader.datum.plane

        def capture(backend: PoseGraphBackend) -> SavedGraph:
            backend.update()
            return backend.saved(None if plane is None else plane.origin)

        saved = self._session.worker.call(capture, 'a copy of the graph').result()
        self._saving = True
        try:
            files = write_graph(saved, path)
        finally:
            self._saving = False
        return (f'{len(saved.nodes.ids)} hidden nodes in {files[0]}, with {files[1].name} and '
                f'{files[2].name}') + ('' if saved.n_left_out == 0 else (
                    f'; not in it: {saved.n_left_out} that wait for odometry'))

    def _load(self, path: Path) -> str:
        """Replace the graph by the one in a file, if it is of the present site."""
        session, worker = self._session, self._session.worker
        # wait until the worker has prepared the kernels, which reading needs
        worker.call(lambda _: None).result()
        saved, backend = restored(
            path, session.values['file_folder'], backend_config(session.values))

        def replace() -> None:
            # in the meantime a datum or parameters may have been set
            self._require_present(worker)
            datum = session.input.reader.datum
            origin = None if datum.plane is None else datum.plane.origin
            if (refusal := site_refusal(
                    saved, *((origin, None) if datum.is_given else (None, origin)))):
                raise FileFormatError(refusal)
            backend.configure(backend_config(session.values))
            session.load(saved, backend, str(path))
        self._do_in_callbacks(replace)
        return f'{len(saved.nodes.ids)} hidden nodes from {path}, datum {saved.datum or "none"}'
