# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of parameters is the one source: yaml file, README and engine agree with it."""

from pathlib import Path

import pytest
import yaml

from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.ros.parameters import (
    as_markdown,
    as_yaml,
    backend_config,
    checked,
    defaults,
    PARAMETERS,
)

ROOT = Path(__file__).resolve().parents[2]


def test_the_yaml_file_is_made_from_the_table() -> None:
    assert (ROOT / 'config' / 'pose_graph.yaml').read_text(encoding='utf-8') == as_yaml()


def test_the_yaml_file_holds_every_default() -> None:
    tree = yaml.safe_load(as_yaml())['/**']['ros__parameters']
    for parameter in PARAMETERS:
        value = tree
        for part in parameter.name.split('.'):
            value = value.get(part, []) if isinstance(value, dict) else value
        assert value == parameter.default, parameter.name
        assert type(value) is type(parameter.default), parameter.name


def test_the_table_of_the_readme_is_made_from_the_table() -> None:
    assert as_markdown() in (ROOT / 'README.md').read_text(encoding='utf-8')


def test_defaults_make_the_default_engine() -> None:
    assert backend_config(defaults()) == BackendConfig()


@pytest.mark.parametrize('parameter', [p for p in PARAMETERS if p.smallest is not None],
                         ids=lambda parameter: parameter.name)
def test_a_number_out_of_range_is_refused(parameter: object) -> None:
    for value in (parameter.smallest - 1.0, parameter.largest + 1.0, float('nan')):
        with pytest.raises(ConfigError, match=parameter.name):
            checked({parameter.name: value})
    assert checked({parameter.name: parameter.largest})[parameter.name] == parameter.largest


@pytest.mark.parametrize('values', [
    {'no_such': 1.0}, {'map_frame': 1}, {'publish_tf': 'yes'}, {'frequency': True},
    {'frequency': '1.0'}, {'datum': 'x'}, {'datum': [1.0, 'x']}, {'fix.lever_arm': 1.0}])
def test_a_wrong_name_or_type_is_refused(values: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(values))):
        checked(values)


def test_every_parameter_says_what_it_does() -> None:
    for parameter in PARAMETERS:
        assert parameter.description.endswith(('.', ',')), parameter.name
        assert len(parameter.description) > 10, parameter.name
    assert len({parameter.name for parameter in PARAMETERS}) == len(PARAMETERS)
