# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Show how far a bag has been read or written, on a terminal only."""

from collections.abc import Collection, Iterable, Iterator
import sys
from typing import TypeVar

from pose_graph_ros.adapters.bags import Bag, BagMessage, Span

DELAY = 0.5  # after which a bar appears [s]
STEPS = 500  # number of times that it moves
FORMAT = '{desc}: {percentage:3.0f} % |{bar}| {n:.0f} of {total:.0f} s [{remaining} left]'

Item = TypeVar('Item')


def watched(items: Iterable[Item], title: str, total: int) -> Iterable[Item]:
    """
    Return the same items, with a bar on standard error while they are used, if that is a terminal.

    Parameters
    ----------
    items : iterable
    title : str, in front of the bar
    total : int, number of items

    """
    if not sys.stderr.isatty():
        return items
    from tqdm import tqdm  # noqa: PLC0415  (not needed without a terminal)

    return tqdm(items, desc=title, total=total, leave=False, delay=DELAY)


class WatchedBag(Bag):
    """
    A bag that shows a bar on standard error while its messages are read, if that is a terminal.

    Parameters
    ----------
    title : str, in front of the bar

    """

    def __init__(self, bag: Bag, title: str) -> None:
        self.path, self.topics = bag.path, bag.topics
        self.start_ns, self.end_ns = bag.start_ns, bag.end_ns
        self._bag, self._title = bag, title

    def _messages(self, topics: Collection[str], span: Span) -> Iterator[BagMessage]:
        messages = self._bag.messages(topics, span)
        return self._watched(messages, span) if sys.stderr.isatty() else messages

    def _watched(self, messages: Iterator[BagMessage], span: Span) -> Iterator[BagMessage]:
        from tqdm import tqdm  # noqa: PLC0415  (not needed without a terminal)

        begin_ns = self.start_ns if span.begin_ns is None else span.begin_ns
        end_ns = self.end_ns if span.end_ns is None else min(span.end_ns, self.end_ns)
        step_ns = max((end_ns - begin_ns) // STEPS, 1)
        shown_ns = begin_ns
        with tqdm(desc=self._title, total=max(end_ns - begin_ns, 1) * 1e-9, bar_format=FORMAT,
                  leave=False, delay=DELAY) as bar:
            for message in messages:
                if message.recorded_ns - shown_ns >= step_ns:
                    bar.update((message.recorded_ns - shown_ns) * 1e-9)
                    shown_ns = message.recorded_ns
                yield message
