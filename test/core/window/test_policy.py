# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""How many of the oldest hidden nodes leave the graph."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.config import WindowConfig
from pose_graph_ros.core.forgetting import n_leaving
from pose_graph_ros.core.odometry.node_table import NodeTable
from pose_graph_ros.core.window.sparse_removal import LIMITS

SECOND = 1_000_000_000


def table_of(n: int) -> NodeTable:
    """Return nodes every two seconds and three metres."""
    table = NodeTable()
    for k in range(n):
        table.append((7 + 2 * k) * SECOND, k, np.array([3.0 * k, 0.0, 0.0]))
    return table


def slow(config: WindowConfig, n: int) -> int:
    """Return how many of the nodes of `table_of(n)` leave, counted one by one."""
    most = 0
    for limit, spacing in ((config.nodes, 1.0), (config.seconds, 2.0), (config.metres, 3.0)):
        if limit > 0:
            group = max(LIMITS.group * limit, 1.0) if spacing == 1.0 else LIMITS.group * limit
            group = math.floor(group) if spacing == 1.0 else group
            newest = n if spacing == 1.0 else (n - 1) * spacing
            begin = math.floor((newest - limit) / group) * group
            most = max(most, sum(k * spacing < begin for k in range(n)))
    return max(min(most, n - LIMITS.newest), 0)


@pytest.mark.parametrize('config', [
    WindowConfig(nodes=20), WindowConfig(seconds=32.0), WindowConfig(metres=48.0),
    WindowConfig(nodes=100, seconds=64.0, metres=200.0), WindowConfig(nodes=1)])
def test_those_beyond_the_smallest_limit_leave_in_groups(config: WindowConfig) -> None:
    for n in (1, 2, 5, 19, 23, 60, 300):
        assert n_leaving(config, table_of(n)) == slow(config, n)


@settings(max_examples=50, deadline=None)
@given(asked=st.lists(st.booleans(), min_size=150, max_size=150),
       config=st.sampled_from([WindowConfig(nodes=17), WindowConfig(seconds=20.0),
                               WindowConfig(metres=31.0)]))
def test_the_nodes_that_are_left_do_not_depend_on_how_often_it_is_asked(
    asked: list[bool], config: WindowConfig,
) -> None:
    table = NodeTable()
    for k, ask in enumerate([*asked, True]):
        table.append((7 + 2 * k) * SECOND, k, np.array([3.0 * k, 0.0, 0.0]))
        if ask:
            table.freeze(np.zeros((n_leaving(config, table), 3)))
    assert table.n_frozen == slow(config, len(table))


def test_what_is_needed_stays_but_not_for_ever() -> None:
    config, leaving = WindowConfig(nodes=40), []
    for n in (50, 60, 80, 90):
        table = table_of(n)
        leaving.append(n_leaving(config, table, needed_ns=int(table.stamps_ns[3]) + SECOND))
    # node 3 goes with all that are more than twice the window old
    assert leaving == [3, 3, 3, 90 - LIMITS.longest_hold * 40]
    # what lies in the part that stays holds nothing up
    table = table_of(60)
    assert n_leaving(config, table, needed_ns=int(table.stamps_ns[50])) == n_leaving(config, table)
