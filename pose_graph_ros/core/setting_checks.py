# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checks of single settings, which raise ConfigError."""

from enum import Enum
import math

from pose_graph_ros.core.exceptions import ConfigError


def require(settings: object, *names: str, positive: bool = False) -> None:
    """
    Raise ConfigError unless the named settings are finite and not negative.

    Parameters
    ----------
    settings : object
    *names : str, attributes of `settings`
    positive : bool, whether 0 is invalid, too

    """
    for name in names:
        value = getattr(settings, name)
        if not math.isfinite(value) or value < 0.0 or (positive and value == 0.0):
            expected = 'a positive number' if positive else 'a number that is not negative'
            raise ConfigError(
                f'{type(settings).__name__}.{name}: expected {expected}, got {value!r}')


def require_member(settings: object, name: str, kind: type[Enum]) -> None:
    """
    Raise ConfigError unless the named setting is a member of an enumeration.

    Parameters
    ----------
    settings : object
    name : str, attribute of `settings`
    kind : type, the enumeration

    """
    value = getattr(settings, name)
    if not isinstance(value, kind):
        raise ConfigError(f'{type(settings).__name__}.{name}: expected one of '
                          f'{", ".join(map(str, kind))}, got {value!r}')


def require_same(what: str, present: object, wanted: object, *names: str) -> None:
    """
    Raise ConfigError if one of the named settings differs, as it cannot change while it runs.

    Parameters
    ----------
    what : str, of the settings, for the message
    present, wanted : object
    *names : str, attributes of both

    """
    for name in names:
        old, new = getattr(present, name), getattr(wanted, name)
        if old != new:
            raise ConfigError(
                f'{what}.{name}: cannot change while it runs, expected {old!r}, got {new!r}')
