# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the node tells of closures that it does not believe, and takes from a person, over DDS."""

import math
from pathlib import Path

from circle import drive, START, true_pose
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from harness import Client, LATCHED, NodeProcess, pose, RELIABLE, stamp_ns
import numpy as np
import pytest
from rcl_interfaces.msg import Log
from rclpy.publisher import Publisher
from visualization_msgs.msg import MarkerArray

from pose_graph_ros.core.geometry import se2

LAP = 20.0 * math.pi
"""Duration of a round of the circle [s]."""
VARIANCES = (0.01, 0.01, 0.0025)


class Verdicts:
    """Decides on closures, and keeps the newest verdicts."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.messages: list[DiagnosticArray] = []
        self._judge: Publisher = client.node.create_publisher(
            KeyValue, 'pose_graph/judge', RELIABLE)
        client.spin_until(lambda: self._judge.get_subscription_count() > 0, 'decisions are heard')
        client.node.create_subscription(
            DiagnosticArray, 'pose_graph/verdicts', self.messages.append, LATCHED)

    @property
    def statuses(self) -> dict[str, DiagnosticStatus]:
        """Statuses of the newest message by their names."""
        return {status.name: status for status in self.messages[-1].status}

    def state(self, number: int) -> str:
        """Return the state of a closure; an empty text if it is not listed."""
        if len(self.messages) == 0:
            return ''
        status = self.statuses.get(f'loop_closure/{number}')
        return '' if status is None else self.values(number)['state']

    def values(self, number: int) -> dict[str, str]:
        return {item.key: item.value for item in self.statuses[f'loop_closure/{number}'].values}

    def decide(self, number: int, decision: str, state: str) -> None:
        """Decide on a closure, and wait until it is in a state."""
        self._judge.publish(KeyValue(key=f'loop_closure/{number}', value=decision))
        self.wait(number, state, decision)

    def wait(self, number: int, state: str, decision: str = 'auto') -> None:
        self.client.spin_until(
            lambda: self.state(number) == state and self.values(number)['decision'] == decision,
            f'closure {number} is {state}')

    def send(self, key: str, value: str) -> None:
        self._judge.publish(KeyValue(key=key, value=value))


def path_error_of_shape(client: Client) -> float:
    """Return the largest error of the distances from the first pose of the path [m]."""
    path = client.paths[-1].poses
    points = np.array([(item.pose.position.x, item.pose.position.y) for item in path])
    truth = np.array([true_pose(stamp_ns(item) * 1e-9 - START)[:2] for item in path])
    return float(np.max(np.abs(np.hypot(*(points - points[0]).T)
                               - np.hypot(*(truth - truth[0]).T))))


@pytest.mark.parametrize('node', [('-p', 'path_period:=0.05')], indirect=True)
def test_closures_are_told_of_with_reasons_and_a_person_decides_on_them(
    node: NodeProcess, client: Client, tmp_path: Path,
) -> None:
    """A round and a bit, with three true closures and two false ones."""
    verdicts = Verdicts(client)
    said: list[str] = []
    client.node.create_subscription(
        Log, '/rosout', lambda message: said.append(message.msg), RELIABLE)
    markers: list[MarkerArray] = []
    client.node.create_subscription(MarkerArray, 'graph', markers.append, LATCHED)
    client.wait_matched()
    drive(client, 70.0, fixes=False)
    for count, (at, wrong) in enumerate(
            ((64.0, 0.0), (65.0, 0.0), (66.0, 0.0), (64.5, 8.0), (65.5, -9.0)), 701):
        x, y, yaw = se2.between(true_pose(at - LAP), true_pose(at))
        client.loop_closure.publish(pose(
            START + at, x, y + wrong, yaw, f'@{START + at - LAP:.9f}', variances=VARIANCES))
        client.wait_processed(count)
    for number in range(3):
        verdicts.wait(number, 'believed')
    for number in (3, 4):
        client.spin_until(
            lambda number=number: verdicts.state(number) in {'doubted', 'waiting'}, 'it is told')
        status, values = verdicts.statuses[f'loop_closure/{number}'], verdicts.values(number)
        assert status.level in (DiagnosticStatus.WARN, DiagnosticStatus.STALE)
        assert status.hardware_id == 'loop_closure'
        assert 'not used' in status.message
        assert float(values['distance']) > 4.0
        assert abs(float(values['residual'].strip('[]').split(',')[1])) > 7.0
    assert float(verdicts.values(3)['stamp']) == pytest.approx(START + 64.5)
    assert sum((item.key, item.value) == ('state', 'believed')
               for status in verdicts.statuses.values() for item in status.values) == 3
    client.wait_values({'loop_closure.believed': '3'})
    client.spin_until(lambda: any(
        'loop_closures' in names and names & {'doubted', 'waiting_closures'}
        for names in ({marker.ns for marker in message.markers} for message in markers)),
        'markers of both kinds of closures come')
    assert client.optimize().success
    assert path_error_of_shape(client) < 0.2

    verdicts.decide(2, 'out', 'doubted')
    assert 'a person' in verdicts.statuses['loop_closure/2'].message
    verdicts.decide(3, 'in', 'believed')
    client.spin_until(lambda: any('loop_closure/3: Used' in text for text in said), 'it is said')
    assert client.optimize().success
    assert path_error_of_shape(client) > 1.0
    client.spin_until(lambda: any('loop_closure/2' in text for text in said
                                  if 'thrown out' in text), 'it is announced')
    assert sum('thrown out' in text and 'loop_closure/2' in text for text in said) == 1
    verdicts.send('loop_closure/99', 'out')
    # of decisions on the same that wait the newest is made
    verdicts.send('loop_closure/98', 'perhaps')
    client.wait_values({'judge.unknown_id': '1', 'judge.unknown_decision': '1'})

    # a decision survives a file
    assert client.set_parameter('graph_file', str(tmp_path / 'map.g2o'))[0]
    assert client.trigger('save_graph').success
    assert '"loop_closure/3": "Used since' in (tmp_path / 'map.json').read_text()
    assert client.trigger('reset').success
    client.spin_until(lambda: list(verdicts.statuses) == ['summary'], 'they are taken back')
    assert client.trigger('load_graph').success
    verdicts.wait(2, 'doubted', 'out')
    verdicts.wait(3, 'believed', 'in')

    # the true ones contradict the one that is forced in: first it must go
    verdicts.send('loop_closure/2', 'auto')
    verdicts.send('loop_closure/3', 'auto')
    client.spin_until(lambda: verdicts.state(3) in {'doubted', 'waiting'}, 'it is judged again')
    for number in range(3):
        verdicts.wait(number, 'believed')
    assert client.optimize().success
    assert path_error_of_shape(client) < 0.2
