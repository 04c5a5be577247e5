# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which topics of a bag feed the node, and what is held out."""

from pathlib import Path
from types import SimpleNamespace

from bag_of_messages import write_bag
import numpy as np
import pytest

from pose_graph_ros.adapters.bags import (
    BagError,
    choose_inputs,
    Inputs,
    open_bag,
    read_inputs,
    TopicInfo,
)
from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import FIX, GLOBAL_POSE, KNOWN_SOURCES, source_list
from pose_graph_ros.cli.simulate import (
    fix_messages,
    loop_closure_messages,
    odometry_messages,
)
from pose_graph_ros.core.geometry.trajectory import Trajectory

POSE = GLOBAL_POSE.message_type
SOURCES = source_list(checked({}))


def bag(**topics: str) -> SimpleNamespace:
    """Stand for a reader with topics, each given as name = input whose type it has."""
    infos = {f'/{name}': TopicInfo(KNOWN_SOURCES[source][0].message_type, 1)
             for name, source in topics.items()}
    return SimpleNamespace(path='bag', topics=infos, describe=lambda: ', '.join(infos))


@pytest.mark.parametrize(('reader', 'wanted', 'expected'), [
    (bag(o='odom'), {}, {'odom': '/o'}),
    (bag(o='odom', f='fix'), {}, {'odom': '/o', 'fix': '/f'}),
    (bag(o='odom', p='global_pose'), {}, {'odom': '/o', 'global_pose': '/p'}),
    # a pose beside fixes may be anything, an estimate of another program for instance
    (bag(o='odom', f='fix', p='global_pose'), {}, {'odom': '/o', 'fix': '/f'}),
    (bag(o='odom', p='global_pose', q='global_pose'), {}, {'odom': '/o'}),
    (bag(o='odom', loop_closure='loop_closure'), {},
     {'odom': '/o', 'loop_closure': '/loop_closure'}),
    (bag(o='odom', loop_closure='loop_closure', p='global_pose'), {},
     {'odom': '/o', 'loop_closure': '/loop_closure', 'global_pose': '/p'}),
    (bag(o='odom', f='fix', p='global_pose'), {'global_pose': '/p'},
     {'odom': '/o', 'global_pose': '/p'}),
    (bag(o='odom', f='fix', p='global_pose'), {'fix': '/f'}, {'odom': '/o', 'fix': '/f'}),
    (bag(o='odom', f='fix', p='global_pose'), {'fix': '/f', 'global_pose': '/p'},
     {'odom': '/o', 'fix': '/f', 'global_pose': '/p'}),
    (bag(o='odom', ground_truth='odom', gt='odom'), {}, {'odom': '/o'}),
    (bag(o='odom', truth='global_pose', robot_gt='odom', gtx='fix'), {},
     {'odom': '/o', 'fix': '/gtx'}),
    (bag(truth='odom'), {'odom': '/truth'}, {'odom': '/truth'}),
    (bag(o='odom', p='odom', c='loop_closure'), {'odom': '/p', 'loop_closure': '/c'},
     {'odom': '/p', 'loop_closure': '/c'}),
])
def test_the_choice_of_topics(
    reader: SimpleNamespace, wanted: dict[str, str], expected: dict[str, str],
) -> None:
    assert choose_inputs(reader, SOURCES, wanted).topics == expected


@pytest.mark.parametrize(('reader', 'wanted', 'said'), [
    (bag(f='fix'), {}, 'odometry'),
    (bag(o='odom', p='odom'), {}, 'choose --odom /o or --odom /p'),
    (bag(o='odom', f='fix', g='fix'), {}, '--fix /f or --fix /g'),
    (bag(o='odom', f='fix'), {'fix': '/x'}, r'no topic /x \(--fix\); the bag has /o, /f'),
    (bag(o='odom', f='fix'), {'global_pose': '/f'},
     f'--global-pose /f is of type {FIX.message_type}, expected {POSE}')])
def test_a_choice_that_is_not_clear_names_the_candidates(
    reader: SimpleNamespace, wanted: dict[str, str], said: str,
) -> None:
    with pytest.raises(BagError, match=said):
        choose_inputs(reader, SOURCES, wanted)


def test_every_fifth_fix_is_held_out_and_nothing_else(tmp_path: Path) -> None:
    steps = np.arange(1, 51)
    path = Trajectory(steps * 10**8, np.column_stack((steps, steps, 0 * steps)))
    write_bag(tmp_path / 'bag', (
        *odometry_messages('/odom', 'odom', path, (0.0,) * 6),
        *fix_messages('/fix', steps * 10**8 + 1, np.full((50, 3), 10.0), sigma=1.0),
        *loop_closure_messages('/loop_closure', np.column_stack((steps, steps + 9)) * 10**8,
                               np.zeros((50, 3)), np.eye(3))))
    with open_bag(tmp_path / 'bag') as reader:
        messages = list(read_inputs(reader, choose_inputs(reader, SOURCES, {}, hold_out=5)))
    held_out = [is_held_out for source, _, is_held_out in messages if source == 'fix']
    assert held_out == [False, False, False, False, True] * 10
    assert not any(is_held_out for source, _, is_held_out in messages if source != 'fix')
    assert sorted({source for source, *_ in messages}) == ['fix', 'loop_closure', 'odom']


def test_sources_of_other_names_are_looked_up_by_their_topics() -> None:
    sources = source_list(checked({
        'sources': ['odom', 'visual', 'fix', 'rear'], 'visual.type': 'odometry',
        'visual.topic': 'vo', 'rear.type': 'fix', 'rear.topic': '/rear/fix'}))
    reader = bag(o='odom', vo='odom', f='fix', **{'rear/fix': 'fix'})
    inputs = choose_inputs(reader, sources, {})
    assert inputs.topics == {'odom': '/o', 'visual': '/vo', 'fix': '/f', 'rear': '/rear/fix'}
    assert list(inputs.topics) == ['odom', 'visual', 'fix', 'rear']
    assert inputs.fixes == ['fix', 'rear']
    # what the bag does not have is left out
    assert choose_inputs(bag(o='odom', f='fix'), sources, {}).topics == {'odom': '/o', 'fix': '/f'}
    with pytest.raises(BagError, match=r'rear\.topic /rear/fix is of type'):
        choose_inputs(bag(o='odom', **{'rear/fix': 'odom'}), sources, {'odom': '/o'})


def test_a_topic_that_the_parameters_name_is_taken_before_a_guess() -> None:
    sources = source_list(checked({'odom.topic': '/wheels'}))
    reader = bag(o='odom', wheels='odom')
    assert choose_inputs(reader, sources, {}).topics == {'odom': '/wheels'}
    assert choose_inputs(reader, sources, {'odom': '/o'}).topics == {'odom': '/o'}


def test_the_topic_of_the_truth_is_no_guess() -> None:
    reader = bag(o='odom', t='odom')
    assert choose_inputs(reader, SOURCES, {}, truth='/t').topics == {'odom': '/o'}
    assert choose_inputs(reader, SOURCES, {'odom': '/t'}, truth='/t').topics == {'odom': '/t'}
    with pytest.raises(BagError, match='but that of the truth, /t; the bag has'):
        choose_inputs(bag(t='odom'), SOURCES, {}, truth='/t')
    with pytest.raises(BagError, match='for the odometry; the bag has /gt'):
        choose_inputs(bag(gt='odom'), SOURCES, {})


def test_an_option_for_a_source_that_is_not_there_says_so() -> None:
    sources = source_list(checked({'sources': ['odom']}))
    with pytest.raises(BagError, match='--fix /f: the parameter sources has no fix'):
        choose_inputs(bag(o='odom', f='fix'), sources, {'fix': '/f'})
    assert choose_inputs(bag(o='odom', f='fix'), sources, {}).topics == {'odom': '/o'}


@pytest.mark.parametrize('hold_out', [-1, 1])
def test_holding_out_all_or_less_than_none_is_refused(hold_out: int) -> None:
    with pytest.raises(BagError, match='--hold-out'):
        Inputs({'odom': '/odom'}, hold_out=hold_out)
