# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The services of the node: each answers what was done, or why not."""

from concurrent.futures import CancelledError, Future as DoneFuture
import logging
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from pose_graph_ros.core.batch import Status
from pose_graph_ros.ros.session import Session

logger = logging.getLogger(__name__)


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
        for name, kind, answer in (
                ('optimize', Trigger, self._optimize), ('reset', Trigger, self._reset),
                ('pause', SetBool, self._pause), ('set_datum', Trigger, self._set_datum)):
            # each in a group of its own: one that awaits holds up all others in its group
            self._offered.append(node.create_service(
                kind, f'~/{name}', answer, callback_group=MutuallyExclusiveCallbackGroup()))

    def close(self) -> None:
        """Offer them no more."""
        for service in self._offered:
            self._node.destroy_service(service)

    async def _done(self, future: 'DoneFuture[Any]') -> Any:
        """Await what the worker does, while other callbacks go on."""
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
            response.message = 'the graph was given up meanwhile'
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
        self._session.begin_anew('a call of ~/reset')
        response.success = True
        plane = self._session.intake.reader.datum.plane
        response.message = (
            f'{0 if estimate is None else estimate.n_hidden} hidden nodes are gone; '
            + ('the next good fix will be the datum' if plane is None else
               f'the datum stays [{plane.latitude:.9f}, {plane.longitude:.9f}]'))
        return response

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        session, response.success = self._session, True
        if session.intake.paused == request.data:
            response.message = 'paused already' if request.data else 'was not paused'
            return response
        session.intake.paused = request.data
        response.message = (
            'paused: what comes is counted and not used; the outputs go on with odometry'
            if request.data else 'going on')
        return response

    def _set_datum(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Make the next good fix the datum, unless the graph refers to the present one."""
        session = self._session
        status, datum = session.worker.status, session.intake.reader.datum
        used = sum(status.counts[name, 'accepted'] for name in session.intake.reader.fixes)
        if datum.plane is not None and used > 0:
            response.message = (f'refused: {used} fixes in the graph refer to the datum '
                                f'[{datum.plane.latitude:.9f}, {datum.plane.longitude:.9f}]')
        elif datum.plane is not None and (
                status.pending > 0 or status.processed < session.intake.posted):
            response.message = ('refused: measurements that wait for odometry may refer to the '
                                'present datum')
        else:
            datum.renew()
            response.success, response.message = True, 'the next good fix will be the datum'
        return response
