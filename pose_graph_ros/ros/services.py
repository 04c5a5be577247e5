# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The services of the node; each answers what was done, or why it was not."""

from collections.abc import Awaitable, Callable
from concurrent.futures import CancelledError, Future as DoneFuture, ThreadPoolExecutor
import logging
from pathlib import Path
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from pose_graph_ros.adapters.sources import backend_config
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.batch.optimizer import Status
from pose_graph_ros.core.exceptions import FileFormatError, PoseGraphError
from pose_graph_ros.core.io.graph_files import read_graph, write_graph
from pose_graph_ros.core.io.saved_graph import SavedGraph, site_refusal
from pose_graph_ros.ros.session import Session

logger = logging.getLogger(__name__)

# Answer if a new graph was started before the service was done.
REPLACED = 'the graph was replaced meanwhile'


class Services:
    """
    Offers the services of a configured node.

    Parameters
    ----------
    node : rclpy.node.Node
    session : Session

    """

    def __init__(self, node: Node, session: Session) -> None:
        self._node, self._session = node, session
        self._offered: list[Service] = []
        # files of a large graph take seconds: neither worker nor executor should wait for them
        self._files = ThreadPoolExecutor(1, 'graph files')
        for name, kind, answer in (
                ('optimize', Trigger, self._optimize), ('reset', Trigger, self._reset),
                ('pause', SetBool, self._pause), ('set_datum', Trigger, self._set_datum),
                ('save_graph', Trigger, self._save_graph),
                ('load_graph', Trigger, self._load_graph)):
            # each in its own group: a service that awaits blocks all others in its group
            self._offered.append(node.create_service(
                kind, f'~/{name}', answer, callback_group=MutuallyExclusiveCallbackGroup()))

    def close(self) -> None:
        """Destroy the services and the thread for files."""
        for service in self._offered:
            self._node.destroy_service(service)
        self._files.shutdown(cancel_futures=True)

    async def _done(self, future: 'DoneFuture[Any]') -> Any:
        """Await a result of another thread, while other callbacks are served."""
        done = Future(executor=self._node.executor)
        future.add_done_callback(lambda _: done.set_result(None))
        await done
        return future.result()

    async def _optimize(
        self, _: Trigger.Request, response: Trigger.Response,
    ) -> Trigger.Response:
        try:
            report = await self._done(self._session.optimize())
        except CancelledError:
            response.message = REPLACED
            return response
        except Exception as error:
            response.message = f'failed: {error}'
            return response
        if self._session.worker.estimate is None:
            response.message = 'there is no odometry yet'
            return response
        response.success = report.status is Status.CONVERGED
        response.message = (
            f'{report.status.value} after {report.iterations} iterations, chi2 {report.chi2:.6g}'
            + (f': {report.reason}' if report.reason != '' else ''))
        return response

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        estimate = self._session.worker.estimate
        self._session.reset()
        response.success = True
        plane = self._session.input.reader.datum.plane
        response.message = (
            f'{0 if estimate is None else estimate.n_hidden} hidden nodes are gone; '
            + ('the next good fix will be the datum' if plane is None else
               f'the datum is still [{plane.latitude:.9f}, {plane.longitude:.9f}]'))
        return response

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        session, response.success = self._session, True
        if session.input.paused == request.data:
            response.message = 'paused already' if request.data else 'was not paused'
            return response
        session.input.paused = request.data
        response.message = (
            'paused: measurements are counted but not used; poses still follow the odometry'
            if request.data else 'resumed')
        return response

    def _set_datum(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Let the next good fix be the datum, unless the graph refers to the present one."""
        session = self._session
        status, datum = session.worker.status, session.input.reader.datum
        used = sum(status.counts[name, 'accepted'] for name in session.input.reader.fixes)
        if datum.is_of_graph:
            response.message = 'refused: the graph that was loaded refers to the present datum'
        elif datum.plane is not None and used > 0:
            response.message = (f'refused: {used} fixes in the graph refer to the datum '
                                f'[{datum.plane.latitude:.9f}, {datum.plane.longitude:.9f}]')
        elif datum.plane is not None and (
                status.pending > 0 or status.processed < session.input.posted):
            response.message = ('refused: measurements that wait for odometry may refer to the '
                                'present datum')
        else:
            datum.renew()
            response.success, response.message = True, 'the next good fix will be the datum'
        return response

    async def _save_graph(
        self, _: Trigger.Request, response: Trigger.Response,
    ) -> Trigger.Response:
        """Write the graph to `graph_file`, all or nothing."""
        plane = self._session.input.reader.datum.plane

        def capture(backend: PoseGraphBackend) -> SavedGraph:
            backend.update()
            return backend.saved(None if plane is None else plane.origin)

        async def save(path: Path) -> str:
            saved = await self._done(self._session.worker.call(capture))
            files = await self._done(self._files.submit(write_graph, saved, path))
            left_out = '' if saved.n_left_out == 0 else (
                f'; {saved.n_left_out} waiting measurements are left out')
            return (f'{len(saved.nodes.rows)} hidden nodes in {files[0]}, with '
                    f'{files[1].name} and {files[2].name}{left_out}')
        return await self._file_answer(save, response)

    async def _load_graph(
        self, _: Trigger.Request, response: Trigger.Response,
    ) -> Trigger.Response:
        """Replace the graph by the one in `graph_file`, if it is of the present site."""
        session = self._session

        def restore(path: Path) -> tuple[SavedGraph, PoseGraphBackend]:
            saved, datum = read_graph(path), session.input.reader.datum
            origin = None if datum.plane is None else datum.plane.origin
            refusal = site_refusal(
                saved, *((origin, None) if datum.is_given else (None, origin)))
            if refusal is not None:
                raise FileFormatError(refusal)
            backend = PoseGraphBackend.restored(backend_config(session.values), saved)
            backend.update()
            return saved, backend

        async def load(path: Path) -> str:
            # wait until the worker has prepared the kernels, which reading needs
            await self._done(session.worker.call(lambda _: None))
            saved, backend = await self._done(self._files.submit(restore, path))
            session.load(saved, backend, str(path))
            return (f'{len(saved.nodes.rows)} hidden nodes from {path}, datum '
                    f'{"none" if saved.datum is None else saved.datum}')
        return await self._file_answer(load, response)

    async def _file_answer(
        self, act: Callable[[Path], Awaitable[str]], response: Trigger.Response,
    ) -> Trigger.Response:
        """Answer a request with the result of an action on the graph's file."""
        name = self._session.values['graph_file']
        if name == '':
            response.message = (
                'refused: set the parameter graph_file first, for example to ~/map.g2o')
            return response
        try:
            response.message = await act(Path(name).expanduser())
            response.success = True
        except CancelledError:
            response.message = REPLACED
        except PoseGraphError as error:
            response.message = f'refused: {error}'
        except Exception as error:
            logger.exception('the file of the graph failed')
            response.message = f'failed: {type(error).__name__}: {error}'
        return response
