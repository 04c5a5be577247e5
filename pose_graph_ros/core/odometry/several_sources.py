# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which of several sources of odometry makes the nodes: the primary one; the others add edges.

The preferred source becomes the primary one unless it begins later than another by more than the
patience. A primary source that is silent for longer than the patience is replaced by the most
preferred source that has samples then. The choice depends on the stamps alone if all sources
deliver samples in the order of stamps, up to the reorder window: when one source settles a stamp,
the earlier samples of all sources are known.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from pose_graph_ros.core.odometry.stream import OdometryStream
from pose_graph_ros.core.quantities import StampNs

Streams = Mapping[str, OdometryStream]


class Silence(NamedTuple):
    """A silence of the primary source during which another source has samples."""

    last_ns: int  # stamp of the last sample before the silence [ns]
    known_ns: int  # stamp of the sample of another source that proves the silence too long [ns]


def choose_first(
    streams: Streams, names: Sequence[str], preferred: str, settled_ns: StampNs, patience_ns: int,
) -> str | None:
    """Return the source that becomes the first primary one, or None if that is not decided yet."""
    ready_ns = []
    for name in names:
        begin_ns = streams[name].first_after(-1)
        if begin_ns is not None and name != preferred:
            begin_ns = streams[name].first_after(begin_ns + patience_ns - 1)
        if begin_ns is not None and begin_ns <= settled_ns:
            ready_ns.append(begin_ns)
    return first_with_sample(streams, names, -1, min(ready_ns)) if len(ready_ns) > 0 else None


def first_with_sample(
    streams: Streams, names: Sequence[str], after_ns: StampNs, until_ns: StampNs,
) -> str:
    """
    Return the first source that has a sample in (after_ns, until_ns]; at least one must have.
    """
    return next(name for name in names
                if (streams[name].first_after(after_ns) or until_ns + 1) <= until_ns)


def find_silence(
    streams: Streams, names: Sequence[str], last_ns: int, settled: tuple[str, int],
    patience_ns: int,
) -> Silence | None:
    """
    Return the first silence of the primary source that is longer than the patience, if any.

    `names` begin with the primary source; the search starts at its sample at `last_ns`. The
    samples before a settled one, given by source and stamp, are known.
    """
    primary, *others = names
    source, settled_ns = settled
    while True:
        # the next sample of the primary source ends its silence
        next_ns = settled_ns if source == primary else streams[primary].first_after(last_ns)
        until_ns = settled_ns + 1 if next_ns is None else min(next_ns, settled_ns + 1)
        after = (streams[name].first_after(last_ns + patience_ns) for name in others)
        known = [stamp_ns for stamp_ns in after if stamp_ns is not None and stamp_ns < until_ns]
        if len(known) > 0:
            return Silence(last_ns, min(known))
        if next_ns is None or next_ns >= settled_ns:
            return None
        last_ns = next_ns
