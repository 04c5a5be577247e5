# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of parameters is the one source: yaml file, README and engine agree with it."""

from pathlib import Path

import pytest
import yaml

from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.exceptions import ConfigError
from pose_graph_ros.core.sources import (
    Correlation,
    Heading,
    LOOP_CLOSURES,
    Loss,
    MeasurementSource,
    NoiseFrom,
    OdometrySource,
)
from pose_graph_ros.ros.parameter_texts import as_markdown, as_yaml, sources_as_markdown
from pose_graph_ros.ros.parameters import (
    all_parameters,
    checked,
    defaults,
    PARAMETERS,
    SOURCE_PARAMETERS,
)
from pose_graph_ros.ros.sources import backend_config, Kind, Source, source_list

ROOT = Path(__file__).resolve().parents[2]


def test_the_yaml_file_is_made_from_the_table() -> None:
    assert (ROOT / 'config' / 'pose_graph.yaml').read_text(encoding='utf-8') == as_yaml()


def test_the_yaml_file_holds_every_default() -> None:
    tree = yaml.safe_load(as_yaml())['/**']['ros__parameters']
    for parameter in all_parameters({}):
        value = tree
        for part in parameter.name.split('.'):
            value = value.get(part, []) if isinstance(value, dict) else value
        assert value == parameter.default, parameter.name
        assert type(value) is type(parameter.default), parameter.name


def test_the_tables_of_the_readme_are_made_from_the_tables() -> None:
    readme = (ROOT / 'README.md').read_text(encoding='utf-8')
    assert as_markdown() in readme
    assert sources_as_markdown() in readme


def test_defaults_make_the_default_engine_with_a_loss_for_what_is_in_the_map() -> None:
    config = backend_config(defaults())
    robust = MeasurementSource(loss=Loss.HUBER)
    assert config == BackendConfig(
        odometry={'odom': OdometrySource()},
        measurements={'global_pose': robust, 'fix': robust, 'loop_closure': LOOP_CLOSURES})
    assert source_list(defaults()) == (
        Source('odom', Kind.ODOMETRY, 'odom'),
        Source('global_pose', Kind.GLOBAL_POSE, 'global_pose'),
        Source('fix', Kind.FIX, 'gps/fix'),
        Source('loop_closure', Kind.LOOP_CLOSURE, 'loop_closure'))


NUMBERS = [p for p in (*all_parameters({}), *all_parameters({'sources': ['imu']}))
           if p.smallest is not None]


@pytest.mark.parametrize('parameter', NUMBERS, ids=lambda parameter: parameter.name)
def test_a_number_out_of_range_is_refused(parameter: object) -> None:
    listed = {'sources': ['imu']} if parameter.name.startswith('imu') else {}

    def given(number: float) -> dict[str, object]:
        size = parameter.sizes[-1] if parameter.sizes else 0
        value = [number] * size if isinstance(parameter.default, list) else number
        return {**listed, parameter.name: value}

    for number in (parameter.smallest - 1.0, 1.1 * parameter.largest + 1.0, float('nan')):
        with pytest.raises(ConfigError, match=parameter.name):
            checked(given(number))
    assert checked(given(parameter.largest))[parameter.name] == given(
        parameter.largest)[parameter.name]


@pytest.mark.parametrize('values', [
    {'no_such': 1.0}, {'map_frame': 1}, {'publish_tf': 'yes'}, {'frequency': True},
    {'frequency': '1.0'}, {'datum': 'x'}, {'datum': [1.0, 'x']}, {'datum': [1.0]},
    {'fix.lever_arm': 1.0}, {'fix.lever_arm': [1.0]}, {'odom.robust_loss': 'l1'},
    {'odom.sigma_floor': [0.1]}, {'fix.covariance_override': [1.0, 1.0, 1.0]},
    {'fix.reorder_window': 1.0}, {'odom.heading': 'auto'}, {'imu.topic': 'imu'},
    {'fix.topic': ''}, {'fix.topic': 'a b'}, {'fix.type': 'gps'}, {'fix.type': 1},
    {'sources': 'odom'}, {'sources': [1]}, {'sources': ['odom', 'odom']},
    {'sources': ['odom', 'a.b']}, {'sources': ['odom', '']}, {'sources': ['odom', 'alignment']},
    {'sources': ['odom', 'datum']}, {'wheels.type': 'odometry'}])
def test_a_wrong_name_or_type_is_refused(values: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(values))) as caught:
        checked(values)
    assert '\n' not in str(caught.value)


def test_a_name_that_is_not_known_has_to_have_a_type() -> None:
    with pytest.raises(ConfigError, match=r'wheels\.type: expected one of odometry, global_pose'):
        checked({'sources': ['wheels']})
    with pytest.raises(ConfigError, match=r"wheels\.topic' is not known: wheels is not in"):
        checked({'wheels.topic': 'wheels'})
    with pytest.raises(ConfigError, match=r'a source of type odometry has none'):
        checked({'sources': ['wheels'], 'wheels.type': 'odometry', 'wheels.lever_arm': [0.0, 0.0]})


@pytest.mark.parametrize(('values', 'said'), [
    ({'sources': ['fix']}, 'at least one of type odometry'),
    ({'fix.sigma_floor': [2.0, 0.1], 'fix.sigma_ceiling': 1.0}, 'source fix: .*ceiling')])
def test_values_that_do_not_go_together_are_refused(values: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        backend_config(checked(values))


def test_every_setting_of_a_source_reaches_the_engine() -> None:
    values = checked({
        'sources': ['visual', 'odom', 'rear', 'compass', 'closer'], 'odometry_patience': 3.0,
        'visual.type': 'odometry', 'visual.topic': '/vo', 'visual.time_offset': -0.125,
        'visual.noise': 'twist', 'visual.sigma_distance': 0.1, 'visual.sigma_lateral': 0.2,
        'visual.sigma_heading_distance': 0.3, 'visual.sigma_heading_turn': 0.4,
        'visual.sigma_floor': [0.5, 0.6], 'visual.covariance_scale': 0.7,
        'visual.reorder_window': 0.8, 'visual.maximum_speed': 9.0, 'visual.robust_loss': 'huber',
        'visual.rejection_threshold': 1.1,
        'rear.type': 'fix', 'rear.covariance_policy': 'refuse',
        'rear.covariance_override': [1.2], 'rear.covariance_scale': 1.3,
        'rear.sigma_floor': [1, 1.5], 'rear.sigma_ceiling': 16.0, 'rear.default_sigma': [1.7, 1.8],
        'rear.robust_loss': 'cauchy', 'rear.rejection_threshold': 1.9,
        'compass.robust_loss': 'cauchy',
        'rear.minimum_period': 0.19,
        'rear.correlation_time': 20.0, 'rear.correlation_model': 'inflate',
        'rear.white_share': 0.21, 'rear.lever_arm': [0.22, 0.23],
        'compass.type': 'imu', 'compass.yaw_offset': 0.24,
        'closer.type': 'loop_closure'})
    config, sources = backend_config(values), source_list(values)
    assert list(config.odometry) == ['visual', 'odom']
    visual = config.odometry['visual']
    assert (visual.noise_from, visual.covariance_scale, visual.reorder_window,
            visual.maximum_speed, visual.loss, visual.rejection_threshold) == (
                NoiseFrom.TWIST, 0.7, 0.8, 9.0, Loss.HUBER, 1.1)
    noise = visual.noise
    assert (noise.sigma_distance, noise.sigma_lateral, noise.sigma_heading_distance,
            noise.sigma_heading_turn, noise.sigma_floor_position, noise.sigma_floor_heading) == (
                0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    assert config.odometry['odom'] == OdometrySource()
    rear, policy = config.measurements['rear'], config.measurements['rear'].covariance
    assert (rear.loss, rear.rejection_threshold, rear.correlation_time, rear.correlation,
            rear.white_share) == (Loss.CAUCHY, 1.9, 20.0, Correlation.INFLATE, 0.21)
    assert rear.minimum_period == 0.19
    assert config.measurements['compass'].loss is Loss.CAUCHY
    assert (policy.repair, policy.override, policy.scale, policy.position_floor,
            policy.heading_floor, policy.position_ceiling, policy.default_position,
            policy.default_heading, policy.heading) == (
                False, (1.2,), 1.3, 1.0, 1.5, 16.0, 1.7, 1.8, Heading.AUTO)
    assert config.measurements['closer'] == LOOP_CLOSURES
    assert config.odometry_patience == 3.0
    assert sources == (
        Source('visual', Kind.ODOMETRY, '/vo', -125_000_000),
        Source('odom', Kind.ODOMETRY, 'odom'),
        Source('rear', Kind.FIX, 'rear', lever_arm=(0.22, 0.23)),
        Source('compass', Kind.IMU, 'compass', yaw_offset=0.24),
        Source('closer', Kind.LOOP_CLOSURE, 'closer'),
        Source('loop_closure', Kind.LOOP_CLOSURE, 'loop_closure'))


def test_every_parameter_says_what_it_does() -> None:
    for parameter in (*PARAMETERS, *SOURCE_PARAMETERS):
        assert parameter.description.endswith(('.', ',')), parameter.name
        assert len(parameter.description) > 10, parameter.name
    names = [parameter.name for parameter in all_parameters({})]
    assert len(set(names)) == len(names)
    assert all(len(parameter.kinds) > 0 for parameter in SOURCE_PARAMETERS)
