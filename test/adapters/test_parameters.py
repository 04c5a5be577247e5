# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The table of parameters is the one source: yaml file, documentation and engine agree with it."""

from array import array
from collections.abc import Mapping
import contextlib
import copy
import math
from pathlib import Path
import re

from hypothesis import given, settings, strategies as st
import pytest
import yaml

from pose_graph_ros.adapters.parameter_table import Change, Parameter
from pose_graph_ros.adapters.parameters import (
    all_parameters,
    as_markdown,
    as_yaml,
    changed,
    checked,
    checked_together,
    explanation,
    is_own,
)
from pose_graph_ros.adapters.sources import (
    backend_config,
    FIX,
    GLOBAL_POSE,
    IMU,
    LOOP_CLOSURE,
    ODOMETRY,
    SET_POSE,
    Source,
    source_list,
)
from pose_graph_ros.core.config import (
    BackendConfig,
    FOUND,
    Heading,
    LOOP_CLOSURES,
    Loss,
    MeasurementSource,
    NoiseFrom,
    OdometrySource,
    Robust,
    SET_POSES,
)
from pose_graph_ros.core.exceptions import ConfigError

ROOT = Path(__file__).resolve().parents[2]


def test_the_full_yaml_file_is_made_from_the_table() -> None:
    assert (ROOT / 'config' / 'pose_graph_full.yaml').read_text(encoding='utf-8') == as_yaml()
    (module,) = re.findall(r'tables in (\S+\.py)', as_yaml())
    assert 'PARAMETERS: ' in (ROOT / module).read_text(encoding='utf-8')


def flat(tree: Mapping[str, object], prefix: str = '') -> dict[str, object]:
    values: dict[str, object] = {}
    for name, value in tree.items():
        values |= flat(value, f'{prefix}{name}.') if isinstance(value, dict) else {
            prefix + name: value}
    return values


def test_the_short_yaml_file_changes_nothing_whatever_in_it_is_put_to_use() -> None:
    text = (ROOT / 'config' / 'pose_graph.yaml').read_text(encoding='utf-8')
    assert 'pose_graph_full.yaml' in text
    assert len(text.splitlines()) <= 30
    given = flat(yaml.safe_load(text)['/**']['ros__parameters'])
    known = checked({})
    assert {name: known.get(name) for name in given} == given
    assert all(type(value) is type(known[name]) for name, value in given.items())
    # with what stands there as an example, too
    examples = re.sub(r'(?m)^( +)# (\w+: \[)', r'\1\2', text)
    more = flat(yaml.safe_load(examples)['/**']['ros__parameters'])
    assert set(more) - set(given) == {'datum', 'fix.covariance_override'}
    checked_together(more)


def test_the_yaml_file_holds_every_default() -> None:
    tree = yaml.safe_load(as_yaml())['/**']['ros__parameters']
    for parameter in all_parameters({}):
        value = tree
        for part in parameter.name.split('.'):
            value = value.get(part, []) if isinstance(value, dict) else value
        assert value == parameter.default, parameter.name
        assert type(value) is type(parameter.default), parameter.name


def test_the_tables_of_the_documentation_are_made_from_the_tables() -> None:
    page = (ROOT / 'docs' / 'parameters.md').read_text(encoding='utf-8')
    assert all(table in page for table in as_markdown().split('\n\n'))


def test_defaults_make_the_default_engine_with_a_loss_for_what_is_in_the_map() -> None:
    config = backend_config(checked({}))
    robust = MeasurementSource(robust=Robust.JUDGED, loss=Loss.HUBER, correlation_time=FOUND)
    assert config == BackendConfig(
        odometry={'odom': OdometrySource()},
        measurements={SET_POSE: SET_POSES, 'global_pose': robust, 'fix': robust,
                      'loop_closure': LOOP_CLOSURES})
    assert source_list(checked({})) == (
        Source('odom', ODOMETRY, 'odom'),
        Source('global_pose', GLOBAL_POSE, 'global_pose'),
        Source('fix', FIX, 'gps/fix'),
        Source('loop_closure', LOOP_CLOSURE, 'loop_closure'))


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
    {'fix.lever_arm': 1.0}, {'fix.lever_arm': [1.0]}, {'fix.robust_loss': 'l1'},
    {'fix.sigma_floor': [0.1]}, {'fix.covariance_override': [1.0, 1.0, 1.0]},
    {'fix.reorder_window': 1.0}, {'odom.heading': 'auto'}, {'imu.topic': 'imu'},
    {'fix.topic': ''}, {'fix.topic': 'a b'}, {'fix.type': 'gps'}, {'fix.type': 1},
    {'sources': 'odom'}, {'sources': [1]}, {'sources': ['odom', 'odom']},
    {'sources': ['odom', 'a.b']}, {'sources': ['odom', '']}, {'sources': ['odom', 'alignment']},
    {'sources': ['odom', 'datum']}, {'wheels.type': 'odometry'}, {'sources': 5},
    {'sources': ['odom', 'autostart']}, {'datum': b'ab'}, {'datum': [math.inf, 0.0]},
    {'datum': [10**400, 0.0]}, {'datum': [math.nan, 0.0]}, {'datum': [True, False]}])
def test_a_wrong_name_or_type_is_refused(values: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(values))) as caught:
        checked(values)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(('values', 'said'), [
    ({'sources': ['fix']}, 'at least one of type odometry'),
    ({'fix.sigma_floor': [0.1, 3.0]}, r'fix\.sigma_floor: expected less'),
    ({'datum': [95.0, 10.0]}, r'datum: expected latitude'),
    ({'map_frame': ''}, "parameter map_frame: expected the name of a frame, got ''"),
    ({'map_frame': '/odom'}, 'map_frame, .* expected three different names')])
def test_values_that_do_not_go_together_are_refused(values: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        checked_together(values)


def test_every_setting_of_a_source_reaches_the_engine() -> None:
    values = checked({
        'sources': ['visual', 'odom', 'rear', 'compass', 'closer'],
        'visual.type': 'odometry', 'visual.topic': '/vo', 'visual.time_offset': -0.125,
        'visual.noise': 'twist', 'visual.sigma_distance': 0.1, 'visual.sigma_lateral': 0.2,
        'visual.sigma_heading_distance': 0.3, 'visual.sigma_heading_turn': 0.4,
        'visual.covariance_scale': 0.7, 'visual.maximum_speed': 9.0,
        'rear.type': 'fix', 'rear.covariance_override': [1.2], 'rear.covariance_scale': 1.3,
        'rear.sigma_floor': [1, 1.5], 'rear.robust_loss': 'cauchy', 'rear.robust': 'loss',
        'rear.correlation_time': 20.0, 'rear.lever_arm': [0.22, 0.23],
        'compass.robust_loss': 'tukey',
        'compass.type': 'imu', 'compass.yaw_offset': 0.24,
        'closer.type': 'loop_closure'})
    config, sources = backend_config(values), source_list(values)
    assert list(config.odometry) == ['visual', 'odom']
    visual = config.odometry['visual']
    assert (visual.noise_from, visual.covariance_scale, visual.maximum_speed) == (
        NoiseFrom.TWIST, 0.7, 9.0)
    noise = visual.noise
    assert (noise.sigma_distance, noise.sigma_lateral, noise.sigma_heading_distance,
            noise.sigma_heading_turn) == (0.1, 0.2, 0.3, 0.4)
    assert config.odometry['odom'] == OdometrySource()
    rear, policy = config.measurements['rear'], config.measurements['rear'].covariance
    assert (rear.robust, rear.loss, rear.rejection_threshold, rear.correlation_time) == (
        Robust.LOSS, Loss.CAUCHY, 3.0, 20.0)
    compass = config.measurements['compass']
    assert (compass.loss, compass.rejection_threshold, compass.minimum_period) == (
        Loss.TUKEY, 5.0, 0.5)
    assert (policy.repair, policy.override, policy.scale, policy.position_floor,
            policy.heading_floor, policy.heading) == (True, (1.2,), 1.3, 1.0, 1.5, Heading.AUTO)
    assert config.measurements['closer'] == LOOP_CLOSURES
    assert sources == (
        Source('visual', ODOMETRY, '/vo', -125_000_000),
        Source('odom', ODOMETRY, 'odom'),
        Source('rear', FIX, 'rear', lever_arm=(0.22, 0.23)),
        Source('compass', IMU, 'compass', yaw_offset=0.24),
        Source('closer', LOOP_CLOSURE, 'closer'),
        Source('loop_closure', LOOP_CLOSURE, 'loop_closure'))


# --- Names that are not known

KNOWN = {parameter.name for parameter in all_parameters({})}


@pytest.mark.parametrize(('name', 'said'), [
    ('frequncy', 'did you mean frequency?'), ('Frequency', 'did you mean frequency?'),
    ('odom.sigma_distnce', 'did you mean odom.sigma_distance?'),
    ('window.second', 'did you mean window.seconds?'),
    ('odm.sigma_distance', 'odm is not in sources; did you mean odom.sigma_distance?'),
    ('imu.topic', 'imu is not in sources'), ('wheels.type', 'wheels is not in sources'),
    ('odom.lever_arm', 'a source of the type of odom has none'),
    ('robust_loss', 'did you mean fix.robust_loss?'),
    ('gain', ''), ('odom.gain', ''), ('', ''), ('.', '')])
def test_the_nearest_name_is_offered(name: str, said: str) -> None:
    assert explanation(name, KNOWN) == said


@pytest.mark.parametrize(('name', 'own'), [
    ('gain', True), ('odom.gain', True), ('odm.topic', True), ('planner.gain', False),
    ('local_costmap.robot.radius', False), ('window.gain', True),
    ('alignment.gain', False)])
def test_groups_that_the_node_does_not_have_are_for_other_nodes(name: str, own: bool) -> None:
    assert is_own(name, KNOWN) is own


# --- Changes while the node runs -----------------------------------------------------------------

PRESENT = checked({'sources': ['odom', 'global_pose', 'fix', 'imu']})
TABLE = {parameter.name: parameter for parameter in all_parameters(PRESENT)}


@pytest.mark.parametrize(('name', 'came', 'taken'), [
    ('frequency', 5, 5.0), ('frequency', 0.5, 0.5), ('publish_tf', False, False),
    ('fix.lever_arm', array('d', [1.0, 0.5]), [1.0, 0.5]), ('fix.lever_arm', (1, 2), [1.0, 2.0]),
    ('fix.covariance_override', [1.0], [1.0]), ('fix.robust_loss', 'cauchy', 'cauchy'),
    ('graph_file', 'maps/graph.g2o', 'maps/graph.g2o')])
@pytest.mark.parametrize('configured', [False, True])
def test_a_change_is_taken_as_the_table_has_it(
    name: str, came: object, taken: object, configured: bool,
) -> None:
    new = changed(PRESENT, {name: came}, configured=configured)
    assert new == {**PRESENT, name: taken}
    assert type(new[name]) is type(taken)
    assert backend_config(new) is not None


@pytest.mark.parametrize('nothing', [[], (), array('d'), None])
def test_what_can_be_unset_is_unset(nothing: object) -> None:
    values = checked({'datum': [48.0, 11.0], 'fix.covariance_override': [1.0]})
    assert changed(values, {'fix.covariance_override': nothing}, configured=True) == {
        **values, 'fix.covariance_override': []}
    assert changed(values, {'datum': nothing}, configured=False)['datum'] == []
    with pytest.raises(ConfigError, match=r'fix\.lever_arm: expected'):
        changed(values, {'fix.lever_arm': nothing}, configured=True)


@pytest.mark.parametrize(('wanted', 'said'), [
    ({'sources': ['odom']}, r'sources is read at the start: .*start the node again'),
    ({'fix.type': 'imu'}, r'fix\.type is read at the start'),
    ({'fix.sigma_floor': [0.1, 3.0]}, r'fix\.sigma_floor: expected less than'),
    ({'map_frame': 'world'}, r'map_frame is taken when the node is configured: .*cleanup'),
    ({'odom.noise': 'twist'}, r'odom\.noise is taken when'),
    ({'fix.correlation_time': 20.0}, r'fix\.correlation_time is taken when')])
def test_a_change_is_refused_with_a_reason_whole(wanted: dict[str, object], said: str) -> None:
    before = copy.deepcopy(PRESENT)
    with pytest.raises(ConfigError, match=said) as caught:
        changed(PRESENT, {'path_period': 3.0, **wanted}, configured=True)
    assert '\n' not in str(caught.value)
    assert before == PRESENT


def some_value(parameter: Parameter) -> st.SearchStrategy[object]:
    """Draw a good value for it, more often than not."""
    low = -90.0 if parameter.smallest is None else parameter.smallest
    high = 90.0 if parameter.largest is None else parameter.largest
    number = st.floats(low, high) | st.integers(math.ceil(low), math.floor(high))
    if isinstance(parameter.default, bool):
        return st.booleans()
    if isinstance(parameter.default, str):
        return st.sampled_from(parameter.choices or ('a', '/a/b', 'map', ''))
    if isinstance(parameter.default, float):
        return number
    if parameter.name == 'sources':
        return st.just(list(PRESENT['sources'])) | st.lists(st.sampled_from('abc'))
    return st.sampled_from(parameter.sizes).flatmap(
        lambda size: st.lists(number, min_size=size, max_size=size))


ANYTHING = st.one_of(
    st.booleans(), st.integers(), st.floats(), st.text(), st.binary(max_size=3), st.none(),
    st.lists(st.floats() | st.integers() | st.text(max_size=2) | st.booleans(), max_size=4),
    st.lists(st.floats(), max_size=3).map(lambda numbers: array('d', numbers)),
    st.lists(st.integers(-9, 9), max_size=3).map(tuple))
ONE_CHANGE = st.sampled_from(sorted(TABLE)).flatmap(lambda name: st.tuples(
    st.just(name), some_value(TABLE[name])))
ANY_CHANGE = st.tuples(st.sampled_from([*sorted(TABLE), 'no_such', 'fix.no_such']), ANYTHING)


@settings(max_examples=150, deadline=None)
@given(st.lists(ONE_CHANGE | ANY_CHANGE, max_size=4).map(dict), st.booleans())
def test_whatever_is_wanted_is_taken_whole_or_refused(
    wanted: dict[str, object], configured: bool,
) -> None:
    before = copy.deepcopy(PRESENT)
    with contextlib.suppress(ConfigError):
        new = changed(PRESENT, wanted, configured=configured)
        # what has been taken would be taken at the start, too, and nothing else has changed
        assert checked(new) == new
        checked_together(new)
        assert {name for name in new if new[name] != before[name]} <= set(wanted)
        for name in new:
            if new[name] != before[name]:
                assert TABLE[name].change is Change.ALWAYS or (
                    TABLE[name].change is Change.UNCONFIGURED and not configured)
    assert before == PRESENT
