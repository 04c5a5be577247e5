# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Bags of given messages."""

from collections.abc import Iterable
from pathlib import Path

from pose_graph_ros.adapters.bag_writer import BagWriter
from pose_graph_ros.cli.simulate import Message


def write_bag(folder: str | Path, messages: Iterable[Message]) -> None:
    """Write messages as a rosbag2, in the order of their stamps."""
    with BagWriter(folder) as bag:
        for topic, type_name, stamp, message in sorted(messages, key=lambda item: item[2]):
            bag.write(topic, type_name, stamp, message)
