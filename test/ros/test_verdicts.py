# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the node tells of closures and fixes that it does not believe, and takes from a person."""

from circle import drive
from diagnostic_msgs.msg import DiagnosticArray, KeyValue
from harness import Client, LATCHED, RELIABLE
import pytest


@pytest.fixture
def judge(client: Client) -> object:
    """Return a publisher of decisions that the node hears."""
    publisher = client.node.create_publisher(KeyValue, 'pose_graph/judge', RELIABLE)
    client.spin_until(lambda: publisher.get_subscription_count() > 0, 'the node hears decisions')
    return publisher


def test_a_decision_that_cannot_be_is_counted(client: Client, judge: object) -> None:
    drive(client, 2.0)
    for key, value in (('loop_closure/99', 'out'), ('loop_closure/99', 'perhaps')):
        judge.publish(KeyValue(key=key, value=value))
    client.spin_until(
        lambda: 'judge.unknown_id' in client.values and 'judge.unknown_decision' in client.values,
        'both are counted')
    assert client.values['received'] == client.values['processed']


def test_verdicts_come_to_who_asks_late_and_are_taken_back_with_the_graph(client: Client) -> None:
    drive(client, 2.0)
    found: list[DiagnosticArray] = []
    client.node.create_subscription(
        DiagnosticArray, 'pose_graph/verdicts', found.append, LATCHED)
    client.spin_until(lambda: len(found) > 0, 'verdicts come')
    assert found[-1].header.frame_id == 'map'
    assert found[-1].status[0].name == 'summary'
    count = len(found)
    assert client.trigger('reset').success
    client.spin_until(lambda: len(found) > count, 'they are taken back')
    assert [status.name for status in found[-1].status] == ['summary']
