# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which sources have all their messages refused, and why; imports no rclpy."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

LEAST = 3  # number of refused messages from which a source is reported
PATIENCE = 5.0  # time since its last accepted message from which it is, if there was one [s]
INTENDED = ('paused', 'thinned')  # reasons that the user has asked for


@dataclass(frozen=True, slots=True)
class _Accepted:
    """The state when the newest message was accepted."""

    count: int = 0
    at: float = 0.0  # [s]
    refused: Mapping[str, int] = field(default_factory=dict)  # by reason


class Refusals:
    """Follows the counts of all sources, to tell those that nothing is accepted from any more."""

    def __init__(self) -> None:
        self._accepted: dict[str, _Accepted] = {}

    def update(
        self, received: Mapping[str, int], counts: Counter[tuple[str, str]],
        details: Mapping[tuple[str, str], str], now: float,
    ) -> dict[str, str]:
        """
        Return what to say of the sources of which the newest messages were all refused.

        Parameters
        ----------
        received : mapping, number of messages by source
        counts : Counter, number of messages by source and 'accepted' or a reason
        details : mapping, of the newest refusal by source and reason
        now : float, by a monotonic clock [s]

        """
        said = {}
        for source, total in received.items():
            refused = {reason: counts[name, reason] for name, reason in details
                       if name == source and reason not in INTENDED}
            accepted, before = counts[source, 'accepted'], self._accepted.get(source, _Accepted())
            if accepted > before.count:
                self._accepted[source] = before = _Accepted(accepted, now, refused)
            newest = Counter({reason: count - before.refused.get(reason, 0)
                              for reason, count in refused.items()})
            count = newest.total()
            if count >= LEAST and (accepted == 0 or now - before.at > PATIENCE):
                begin = f'{count} of {total}' if accepted == 0 else f'the newest {count}'
                said[source] = (f'{begin} messages of {source} were refused: '
                                f'{_reasons(source, newest, details)}')
        return said


def _reasons(source: str, counts: Counter[str], details: Mapping[tuple[str, str], str]) -> str:
    """Return all reasons with the newest detail of each, the most frequent first."""
    found = [(reason, count) for reason, count in counts.most_common() if count > 0]
    return '; '.join(
        (f'{count} times ' if len(found) > 1 else '') + f'{reason} ({details[source, reason]})'
        for reason, count in found)
