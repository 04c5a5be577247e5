# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The policy for SROS2 names what the real node has; asked for security, the node has it."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
import time
from xml.etree import ElementTree

from harness import Client, NodeProcess, PATIENCE
import pytest
from rclpy.node import NodeNameNonExistentError

from pose_graph_ros.adapters.sources import KNOWN_SOURCES
from pose_graph_ros.ros.topics import STATIC_TOPIC, TFMessage

POLICY = Path(__file__).parents[2] / 'config' / 'sros2_policy.xml'
Allowed = set[tuple[str, str]]
"""What may be done, and the full name of the topic or service."""


def allowed(path: str) -> Allowed:
    """Return what the policy allows an enclave."""
    enclave, = ElementTree.parse(POLICY).iterfind(f'enclaves/enclave[@path="{path}"]')
    return {(what, _full(name.text or '', profile))
            for profile in enclave.iter('profile') for group in profile
            for what, rule in group.items() for name in group if rule == 'ALLOW'}


def _full(name: str, profile: ElementTree.Element) -> str:
    """Return the full name of what a profile names, as sros2 has it."""
    space = profile.get('ns', '').rstrip('/')
    if name.startswith('~'):
        return f'{space}/{profile.get("node")}{name[1:]}'
    return name if name.startswith('/') else f'{space}/{name}'


def used(client: Client) -> Iterator[tuple[str, str]]:
    """Yield what the nodes of the process under test do."""
    for node in ('pose_graph', '/'), ('_services', '/pose_graph'):
        for what, ask in (('publish', client.node.get_publisher_names_and_types_by_node),
                          ('subscribe', client.node.get_subscriber_names_and_types_by_node),
                          ('reply', client.node.get_service_names_and_types_by_node),
                          ('request', client.node.get_client_names_and_types_by_node)):
            with suppress(NodeNameNonExistentError):    # whose news has not come yet
                yield from ((what, name) for name, _ in ask(*node))


@pytest.mark.skipif(TFMessage is None, reason='tf2_msgs is not there')
def test_the_policy_names_what_the_node_has_and_no_more(client: Client) -> None:
    policy, end = allowed('/pose_graph'), time.monotonic() + PATIENCE / 6
    while (found := set(used(client))) != policy and time.monotonic() < end:
        client.spin_for(0.05)   # the news of the graph of nodes may come after all else
    assert sorted(found - policy) == [], 'used, but not allowed'
    assert sorted(policy - found) == [], 'allowed, but not used'


def test_drivers_may_send_measurements_and_the_operator_all_else() -> None:
    node, driver, operator = map(allowed, ('/pose_graph', '/driver', '/operator'))
    inputs = {name for what, name in node if what == 'subscribe'}
    sensors = {f'/{topic}' for _, topic in KNOWN_SOURCES.values()} | {STATIC_TOPIC}
    assert inputs & sensors == inputs & {name for what, name in driver if what == 'publish'}
    assert inputs - sensors == inputs & {name for what, name in operator if what == 'publish'}
    assert {name for what, name in node if what == 'reply'} == {
        name for what, name in operator if what == 'request'}
    assert {name for what, name in node if what == 'publish'} <= {
        name for what, name in operator if what == 'subscribe'}
    assert not any(what == 'request' for what, _ in driver)


def test_a_node_without_the_keys_that_it_is_to_have_does_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / 'enclaves').mkdir()
    for name, value in (('ENABLE', 'true'), ('STRATEGY', 'Enforce'), ('KEYSTORE', str(tmp_path))):
        monkeypatch.setenv(f'ROS_SECURITY_{name}', value)
    with NodeProcess(tmp_path, ('--enclave', '/pose_graph')) as node:
        assert node.process.wait(PATIENCE) != 0
        assert 'SECURITY ERROR' in node.stderr()
