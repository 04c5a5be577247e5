# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The services of robot_localization's nodes, for other nodes that call them.

Its topics are those that this node has anyway. Names are relative to the namespace, as there.
Most of these services cannot answer that something is not possible: then the log says why, and
coordinates are NaN, as a robot would drive to 0.
"""

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
import logging
import math
from typing import Any

from geometry_msgs.msg import Point
import numpy as np
from rclpy.node import Node
from rclpy.service import Service
from std_srvs.srv import Empty, SetBool, Trigger

from pose_graph_ros.adapters.conversions import yaw_of
from pose_graph_ros.adapters.parameter_table import ROBOT_LOCALIZATION
from pose_graph_ros.core.measurements import LARGEST_COORDINATE
from pose_graph_ros.ros import log
from pose_graph_ros.ros.services import Answer, Services, ServiceThread
from pose_graph_ros.ros.session import Session

logger = logging.getLogger(__name__)

Act = Callable[[Any, Any], Answer]
"""What is done by a request; it completes the response, and returns what the log says."""
NO_DATUM = 'there is no datum yet: NaN is answered until the first fix, or set the parameter datum'


class Compatible(Services):
    """Offers the services of the node, and those of robot_localization whose types are there."""

    def __init__(self, node: Node, session: Session, thread: ServiceThread) -> None:
        super().__init__(node, session, thread)
        self._offer(Empty, 'reset', lambda _, __: self._reset(Trigger.Request()))
        self._offer(Empty, 'enable', lambda _, __: self._pause(SetBool.Request(data=False)))
        try:
            types = import_module(f'{ROBOT_LOCALIZATION}.srv')
            self._geo_point = import_module('geographic_msgs.msg').GeoPoint
        except ImportError as error:
            logger.warning('compatible: toLL, fromLL, datum, set_pose and toggle are not offered, '
                           'without the types of %s: %s', ROBOT_LOCALIZATION, error)
            return
        self._offer(types.SetPose, 'set_pose', self._set_pose)
        self._offer(types.ToggleFilterProcessing, 'toggle', self._toggle)
        self._offer(types.SetDatum, 'datum', self._give_datum, waits=True)
        for name, convert, given, found in (('ToLL', self._on_earth, 'map_point', 'll_point'),
                                            ('FromLL', self._in_map, 'll_point', 'map_point')):
            # older versions of robot_localization do not have arrays
            for kind, plural in ((name, ''), (f'{name}Array', 's')):
                if hasattr(types, kind):
                    self._offer(getattr(types, kind), kind[0].lower() + kind[1:], partial(
                        _converted, convert, given + plural, found + plural), waits=plural != '')

    def _offer(self, kind: Any, name: str, act: Act, *, waits: bool = False) -> None:
        """Create a service, in the thread of those that wait if it does."""
        def answer(request: Any, response: Any) -> Any:
            good, text = self._done(lambda: act(request, response))
            if text != '':
                logger.log(logging.INFO if good else logging.WARNING, '%s: %s', name, text,
                           extra=log.ANSWER)
            return response
        node: Node = self._thread.node if waits else self._node
        services: list[Service] = self._waiting if waits else self._quick
        # with the remaps of the node, which that of the thread does not have
        services.append(node.create_service(kind, self._node.resolve_service_name(name), answer))

    def _set_pose(self, request: Any, _: Any) -> Answer:
        self._session.receive_pose(request.pose)    # which logs a refusal
        return True, ''

    def _toggle(self, request: Any, response: Any) -> Answer:
        response.status = request.on == self._session.input.paused
        return self._pause(SetBool.Request(data=not request.on))

    def _give_datum(self, request: Any, _: Any) -> Answer:
        """Set the datum, unless the graph refers to the present one."""
        place, yaw = request.geo_pose.position, yaw_of(request.geo_pose.orientation)
        if yaw is None:
            return False, 'refused: expected a rotation'
        # that of a message without an angle is not exactly 0
        is_turned = abs(yaw - self._session.input.reader.datum.yaw) > 1e-9
        if (refusal := self._datum_refusal(is_turned=is_turned)) != '':
            return False, refusal
        given = [float(place.latitude), float(place.longitude), yaw]
        try:
            self._do_in_callbacks(lambda: self._session.set_datum(given))
        except ValueError as error:
            return False, f'refused: {error}'
        return True, f'the datum is {given}'

    def _on_earth(self, points: Sequence[Any]) -> tuple[list[Any], Answer]:
        """Return points of the map on the Earth, at the altitude that `gps/filtered` has."""
        datum = self._session.input.reader.datum
        plane, level = datum.plane, datum.altitude
        positions = np.array([(point.x, point.y) for point in points]).reshape(-1, 2)
        found = np.full((len(positions), 3), math.nan)
        if plane is None:
            answer = False, NO_DATUM
        else:
            good = (np.abs(positions) <= LARGEST_COORDINATE).all(axis=1)
            found[good] = plane.to_geodetic(
                positions[good], level if math.isfinite(level) else plane.altitude)
            found[good, 2] = level
            answer = (True, '') if good.all() else (False, (
                f'expected a point in the map, got {positions[~good][0].tolist()}: '
                'NaN is answered'))
        return [self._geo_point(latitude=latitude, longitude=longitude, altitude=altitude)
                for latitude, longitude, altitude in found.tolist()], answer

    def _in_map(self, points: Sequence[Any]) -> tuple[list[Point], Answer]:
        """Return points of the Earth in the map, whatever their altitude: it is a plane."""
        datum = self._session.input.reader.datum
        plane, level = datum.plane, datum.altitude
        place = np.array([(point.latitude, point.longitude) for point in points]).reshape(-1, 2)
        found = np.full_like(place, math.nan)
        if plane is None:
            answer = False, NO_DATUM
        else:
            # where `gps/filtered` lies, so that this is the inverse of toLL
            level = level if math.isfinite(level) else plane.altitude
            good = (np.abs(place) <= (90.0, 360.0)).all(axis=1)
            latitude, longitude = place[good].T
            found[good] = plane.to_map(latitude, longitude, np.full_like(latitude, level))
            answer = (True, '') if good.all() else (False, (
                'expected latitude in [-90, 90] and longitude in [-360, 360], got '
                f'{place[~good][0].tolist()}: NaN is answered'))
        # the height is 0, or NaN as the rest
        return [Point(x=x, y=y, z=0.0 if math.isfinite(x) else x)
                for x, y in found.tolist()], answer


def _converted(convert: Callable[[Sequence[Any]], tuple[list[Any], Answer]], given: str,
               found: str, request: Any, response: Any) -> Answer:
    """Convert the point, or the points, of a request."""
    points = getattr(request, given)
    converted, answer = convert(points if isinstance(points, Sequence) else [points])
    setattr(response, found, converted if isinstance(points, Sequence) else converted[0])
    return answer
