# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What becomes of each parameter of other systems, by the rows in rules.yaml."""

from collections.abc import Callable
from enum import Enum
from importlib.resources import files
import re
from typing import Any, NamedTuple

import yaml


class Fate(Enum):
    """What becomes of a parameter."""

    TAKEN = 'Taken'
    NOT_NEEDED = 'Not needed'
    CHANGED = 'Changes its meaning'
    NONE = 'Has no counterpart'
    UNKNOWN = 'Not known'


class Rule(NamedTuple):
    """What becomes of the parameters with some names: a row of rules.yaml, which says more."""

    name: str
    fate: str
    why: str = ''
    target: str = ''
    convert: str = ''
    value: Any = None  # the row is only for this value; None for all


LOSSES = {'HuberLoss': 'huber', 'CauchyLoss': 'cauchy', 'GemanMcClureLoss': 'geman_mcclure',
          'DCSLoss': 'dcs', 'TukeyLoss': 'tukey', 'TrivialLoss': 'none'}
CONVERSIONS: dict[str, Callable[[Any], Any]] = {
    '': lambda value: value, 'to_false': lambda _: False,
    'to_frequency': lambda period: 1.0 / period,
    'to_datum': lambda value: [float(each) for each in (
        value.split(',') if isinstance(value, str) else value)[:3]],
    'of_ceres': lambda loss: LOSSES.get(loss, 'none'),
    'of_fuse': lambda loss: LOSSES[str(loss).rpartition('::')[2]]}
_CONTENT = yaml.safe_load((files(__package__) / 'rules.yaml').read_text(encoding='utf-8'))
TABLES = {table: [Rule(**row) for row in rows] for table, rows in _CONTENT.items()
          if table != 'sentences'}


def rule_of(table: str, name: str, value: Any) -> Rule:
    """Return the row of a table for a parameter, or one that says that there is none."""
    same = [rule for rule in (*TABLES[table], *TABLES['everywhere'])
            if re.fullmatch(rule.name, name)]
    return next((rule for rule in same if rule.value is None or rule.value == value),
                Rule('', 'unknown', 'no parameter that this tool knows') if len(same) == 0 else
                Rule('', 'not_needed', f'{str(value).lower()} asks for nothing'))
