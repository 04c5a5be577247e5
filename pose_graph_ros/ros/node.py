# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The managed node: its parameters and the transitions of its lifecycle."""

from collections.abc import Callable, Sequence
import logging
import time
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import qos_profile_services_default

from pose_graph_ros.adapters import parameters as rules
from pose_graph_ros.adapters.parameter_table import Change, Parameter, PARAMETERS
from pose_graph_ros.adapters.sources import KNOWN_SOURCES
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.ros import compatible, log, services, session, topics
from pose_graph_ros.ros.stored_graphs import with_folder

logger = logging.getLogger(__name__)

# Of parameters, at once and in a second from then on: each is checked with all others, while
# odometry waits.
MOST_CHANGES, CHANGE_RATE = 100, 20.0


class PoseGraphNode(LifecycleNode):
    """
    The online back end of pose-graph SLAM as a managed node.

    This class has the parameters and the lifecycle; `Session` does the work of a configured node.
    Raises `ConfigError` if `sources`, which determines the other parameters, is not valid.
    """

    def __init__(self, **node_options: Any) -> None:
        # what a file or the command line gives, also to parameters that are not declared
        self._overrides: dict[str, Any] = {}
        self._changes_until = 0.0   # how far those so far reach at the rate that is allowed [s]
        super().__init__(
            'pose_graph', automatically_declare_parameters_from_overrides=True, **node_options)
        self._log = log.NodeLog(self.get_logger())
        self.failure = ''  # why the last transition failed
        self._session: session.Session | None = None
        self._offered: services.Services | None = None
        self._service_thread: services.ServiceThread | None = None
        # the node's own parameters that have a value
        self._given = with_folder(self._declare(PARAMETERS))
        for source in rules.listed_sources(self._given):
            kind = self._declare([rules.type_parameter(source)])[f'{source}.type']
            self._given |= self._declare(rules.source_parameters(source, kind))
        self._own = {parameter.name: parameter for parameter in rules.all_parameters(self._given)}
        # rclpy does not warn of unknown parameters, as a file may be for several nodes;
        # pose_graph.yaml has defaults of sources that `sources` may leave out
        usual = {parameter.name: parameter.default for source, (kind, _) in KNOWN_SOURCES.items()
                 for parameter in rules.source_parameters(source, kind.name)}
        for name, value in sorted(self._overrides.items()):
            # those of rclpy are declared, or will be with the publishers and subscriptions
            if not self.has_parameter(name) and not name.startswith(topics.OVERRIDES) and (
                    rules.is_own(name, self._own)) and (
                    name not in usual or not rules.is_same(rules.plain(value), usual[name])):
                logger.warning('%s', rules.unknown(name, self._own))

    def destroy_node(self) -> None:
        """Destroy the node; what is logged from now on goes elsewhere."""
        if self._service_thread is not None:
            self._service_thread.close(1.0)     # for files of the graph that are written
        self._log.close()
        super().destroy_node()

    # ---- lifecycle

    def begin(self, arguments: Sequence[str]) -> None:
        """Tell of parameter files in the arguments that are for others; start by `autostart`."""
        for sentence in rules.without_effect(arguments, self.get_fully_qualified_name()):
            logger.warning('%s', sentence)
        if self.get_parameter('autostart').value:
            self.start()
        else:
            logger.info('autostart is false: waiting for the transition configure')

    def start(self) -> None:
        """Configure and activate; raises `ConfigError` with the reason if a transition fails."""
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() is not TransitionCallbackReturn.SUCCESS:
                raise ConfigError(self.failure)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check the parameters; start worker, services and diagnostics."""
        return self._transition(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start receiving and publishing."""
        return self._transition(self._configured.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop receiving and publishing; keep the graph."""
        return self._transition(
            self._configured.deactivate, 'inactive: nothing is received; the graph stays')

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Discard everything: before the end, or to be unconfigured again, also after an error."""
        return self._transition(self.close, 'cleaned up: the graph is discarded')

    on_shutdown = on_error = on_cleanup

    def _transition(self, change: Callable[[], None], done: str = '') -> TransitionCallbackReturn:
        """Change the state, and log that; if it fails, keep the reason, which rclpy does not."""
        try:
            change()
        except ConfigError as error:
            self.failure = str(error)
            if self.executor is not None:   # else `start` raises it
                logger.error('no transition: %s', error)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.failure = f'{type(error).__name__}: {error}'
            logger.exception('a transition failed')
            return TransitionCallbackReturn.ERROR
        if done != '':
            logger.info('%s', done)
        return TransitionCallbackReturn.SUCCESS

    @property
    def _configured(self) -> session.Session:
        assert self._session is not None, 'rclpy allows the transition only when configured'
        return self._session

    def _configure(self) -> None:
        values = rules.checked_together(self._given)
        topics.check_topics(self, values, self._overrides)
        self._session = session.Session(self, values)
        if self._service_thread is None:
            self._service_thread = services.ServiceThread(self)
        offer = services.Services if values['compatible'] == 'none' else compatible.Compatible
        self._offered = offer(self, self._session, self._service_thread)

    def close(self) -> None:
        """Stop the worker and destroy all that was configured."""
        closing: list[services.Services | session.Session | None] = [self._offered, self._session]
        self._offered = self._session = None
        for each in closing:
            if each is not None:
                each.close()

    # ---- parameters

    def create_service(self, *arguments: Any, **options: Any) -> Any:
        """Create a service; of requests that wait, also on parameters, the newest ten are kept."""
        return super().create_service(
            *arguments, **{**options, 'qos_profile': qos_profile_services_default})

    def declare_parameters(self, namespace: str, parameters: Any,
                           ignore_override: bool = False) -> list[RosParameter]:
        """Return parameters after declaring them; of all that are given only note the values."""
        if ignore_override:
            self._overrides = {name: value for name, value, _ in parameters}
            return []
        return super().declare_parameters(namespace, parameters, ignore_override)

    def _declare(self, parameters: Sequence[Parameter]) -> dict[str, Any]:
        """Declare parameters and return those that are set."""
        given: dict[str, Any] = {}
        for parameter in parameters:
            if not self.has_parameter(parameter.name):
                descriptor = ParameterDescriptor(
                    description=f'{parameter.description} [{parameter.unit}]'.removesuffix(' []'),
                    additional_constraints=rules.constraints(parameter),
                    read_only=parameter.change is Change.START,
                    # numbers may be given as 5 for 5.0
                    dynamic_typing=not isinstance(parameter.default, bool | str))
                if parameter.smallest is not None and parameter.largest is not None:
                    descriptor.floating_point_range = [FloatingPointRange(
                        from_value=parameter.smallest, to_value=parameter.largest)]
                # an array without a value has no type yet
                default = None if parameter.default == [] else parameter.default
                self.declare_parameter(parameter.name, default, descriptor)
            value = self.get_parameter(parameter.name).value
            is_list = isinstance(parameter.default, list)
            if value is not None and not (is_list and value in rules.NOTHING):
                given[parameter.name] = rules.plain(value)
            elif is_list and parameter.default != [] and parameter.name in self._overrides:
                given[parameter.name] = []  # so rcl hands over [], which is not the default
        return given

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """
        Set several parameters, all or none, as the services for parameters do.

        A parameter, also a read-only one, can be set to the value that it has, and one that is
        not set to nothing, so that a node takes what `ros2 param dump` has written of it.
        """
        now = time.monotonic()
        if self._changes_until > now + MOST_CHANGES / CHANGE_RATE:
            return _refused(f'more than {MOST_CHANGES} changes of parameters at once: wait')
        changes = []
        for parameter in parameter_list:
            name = parameter.name
            if not self.has_parameter(name):
                self._count_change(now)
                return _refused(rules.unknown(name, self._own))
            value = self._plain(name, parameter.value)
            # rclpy refuses what is read-only; without a value it would undeclare it
            if not rules.is_same(value, self._plain(name, self.get_parameter(name).value)):
                changes.append(parameter if value != [] else RosParameter(
                    name, RosParameter.Type.DOUBLE_ARRAY, []))
        own = {each.name: each.value for each in changes if each.name in self._own}
        if len(changes) == 0:
            return SetParametersResult(successful=True)
        self._count_change(now)
        try:
            given = rules.changed(self._given, own, configured=self._session is not None)
        except ConfigError as error:
            return _refused(error)
        result = super().set_parameters_atomically(changes)
        if result.successful and len(own) > 0:
            self._given = given
            try:
                if self._session is not None:
                    self._session.configure(given)
            except Exception as error:
                # raised from here, the client would get no answer
                logger.exception('a change of parameters failed')
                return _refused(f'failed: {type(error).__name__}: {error}')
        return result

    def _count_change(self, now: float) -> None:
        self._changes_until = max(self._changes_until, now) + 1.0 / CHANGE_RATE

    def set_parameters(self, parameter_list: list[RosParameter]) -> list[SetParametersResult]:
        """Set several parameters, each for itself."""
        return [self.set_parameters_atomically([each]) for each in parameter_list]

    def _plain(self, name: str, value: Any) -> Any:
        """Return a value of a parameter with its arrays as lists, also where it is unset."""
        can_be_unset = name in self._own and self._own[name].default == []
        return [] if can_be_unset and value in rules.NOTHING else rules.plain(value)


def _refused(reason: object) -> SetParametersResult:
    return SetParametersResult(successful=False, reason=str(reason))
