# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Several bags as one, such as the parts of a long recording."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
import heapq
from pathlib import Path
from typing import Self

from pose_graph_ros.adapters.bags import (
    Bag,
    BagMessage,
    BagReader,
    open_bag,
    Span,
    TopicInfo,
)


class BagSequence(Bag):
    """
    Open bags whose messages come in the order in which they were recorded; a context manager.

    Bags that were recorded at the same time are merged. Of a topic with several types, these are
    joined with ` | `, as in a single bag.

    Parameters
    ----------
    bags : sequence of BagReader, at least one

    """

    def __init__(self, bags: Sequence[BagReader]) -> None:
        self._bags = sorted(bags, key=lambda bag: bag.start_ns)
        self.path = ', '.join(str(bag.path) for bag in self._bags)
        self.topics = {}
        for name in sorted({name for bag in bags for name in bag.topics}):
            found = [bag.topics[name] for bag in bags if name in bag.topics]
            types = sorted({part for info in found for part in info.type.split(' | ')})
            self.topics[name] = TopicInfo(' | '.join(types), sum(info.count for info in found))
        self.start_ns = min(bag.start_ns for bag in self._bags)  # an empty one begins late
        self.end_ns = max(bag.end_ns for bag in self._bags)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        with ExitStack() as stack:
            for bag in self._bags:
                stack.push(bag)

    def _messages(self, topics: Collection[str], span: Span) -> Iterator[BagMessage]:
        parts = [bag.messages([topic for topic in topics if topic in bag.topics], span)
                 for bag in self._bags]
        return heapq.merge(*parts, key=lambda message: message.recorded_ns)


def open_bags(paths: Sequence[str | Path]) -> BagReader | BagSequence:
    """Open bags that follow each other, in any order; raises `BagError` as `open_bag` does."""
    if len(paths) == 1:
        return open_bag(paths[0])
    with ExitStack() as stack:
        bags = [stack.enter_context(open_bag(path)) for path in paths]
        stack.pop_all()
    return BagSequence(bags)
