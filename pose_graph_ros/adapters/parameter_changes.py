# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check changes of parameters: whether they are allowed now and consistent; no ROS."""

from array import array
from collections.abc import Mapping
from typing import Any

from pose_graph_ros.adapters.conversions import frame
from pose_graph_ros.adapters.fixes import datum_of
from pose_graph_ros.adapters.parameters import (
    all_parameters,
    Change,
    checked,
    checked_value,
    Parameter,
    unknown,
)
from pose_graph_ros.adapters.sources import backend_config
from pose_graph_ros.core.exceptions import ConfigError

FRAMES = ('map_frame', 'odom_frame', 'base_link_frame')
NOTHING = (None, 'null', 'None')
"""What is not set, as rcl and `ros2 param load` read what `ros2 param dump` has written."""


def plain(value: Any) -> Any:
    """Return the value of a ROS parameter with an array as a list."""
    return list(value) if isinstance(value, array | tuple) else value


def is_same(one: Any, other: Any) -> bool:
    """Tell whether two plain values are equal as parameters: 5 and 5.0 are, 1 and True are not."""
    return bool(one == other) and isinstance(one, bool) == isinstance(other, bool)


def changed(
    values: Mapping[str, Any], wanted: Mapping[str, Any], *, configured: bool,
) -> dict[str, Any]:
    """
    Return all parameters with some of them changed, after all checks.

    Parameters
    ----------
    values : mapping, present parameters; a missing one has its default
    wanted : mapping
        Changes by name. None and an empty list unset a parameter that can be unset. Setting the
        present value is always allowed.
    configured : bool, whether the node is configured (active or not)

    Raises
    ------
    ConfigError
        If a parameter is unknown, has a wrong type, is out of range, cannot be changed now, or
        contradicts another one; the message says what was expected or what to do instead.

    """
    parameters = {parameter.name: parameter for parameter in all_parameters(values)}
    new = {name: values.get(name, parameter.default) for name, parameter in parameters.items()}
    for name, value in wanted.items():
        if name not in parameters:
            raise unknown(name, parameters)
        parameter = parameters[name]
        good = checked_value(
            parameter, [] if value is None and parameter.default == [] else value)
        if good != new[name]:
            _require_changeable(parameter, configured=configured)
            new[name] = good
    new = checked(new)
    require_together(new)
    return new


def _require_changeable(parameter: Parameter, *, configured: bool) -> None:
    name = parameter.name
    if parameter.change is Change.START:
        raise ConfigError(f'parameter {name} is read at the start: give it in a parameter file '
                          f'or by -p {name}:=..., and start the node again')
    if parameter.change is Change.UNCONFIGURED and configured:
        raise ConfigError(f'parameter {name} is taken when the node is configured: `ros2 '
                          'lifecycle set` it to deactivate and cleanup, change it, and configure '
                          'it again')


def require_together(values: Mapping[str, Any]) -> None:
    """
    Check the conditions on more than one parameter, and raise a `ConfigError` if one is broken.

    The three frames must be different, the datum a point on the Earth, there must be odometry, and
    settings of a source must not contradict each other.
    """
    frames = [frame(values[name]) for name in FRAMES]
    if '' in frames:
        raise ConfigError(f'parameter {FRAMES[frames.index("")]}: expected the name of a frame, '
                          "got ''")
    if len(set(frames)) < len(frames):
        raise ConfigError(f'parameters {", ".join(FRAMES)}: expected three different names, got '
                          f'{", ".join(map(repr, frames))}')
    datum_of(values)
    backend_config(values)
