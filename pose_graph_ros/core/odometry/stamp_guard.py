# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Plausibility of stamps: a few stamps far from the newest one do not become the newest one."""

# Number of consecutive far stamps that are rejected; the next one is accepted.
EVIDENCE = 5


class StampGuard:
    """
    Tracks the newest plausible stamp of a stream of messages.

    A stamp that is far from the newest one may come from a faulty clock. It is rejected unless
    `EVIDENCE` far ones came directly before it: then the earlier stamps are taken to be wrong.

    Parameters
    ----------
    limit_ns : int, distance from the newest stamp beyond which a stamp is far [ns]
    behind : bool, whether stamps behind the newest one can be far, and not only those ahead of it

    """

    def __init__(self, limit_ns: int, *, behind: bool) -> None:
        self.limit_ns = limit_ns
        self._behind = behind
        self.newest_ns = 0
        """Newest accepted stamp [ns]; 0 before the first."""
        self._n_far = 0

    def accepts(self, stamp_ns: int) -> bool:
        """Tell whether a stamp [ns] is accepted; if so, update the newest one."""
        ahead_ns = stamp_ns - self.newest_ns
        if self.newest_ns == 0 or (
                ahead_ns <= self.limit_ns and not (self._behind and -ahead_ns > self.limit_ns)):
            self.newest_ns = max(self.newest_ns, stamp_ns)
        else:
            self._n_far += 1
            if self._n_far <= EVIDENCE:
                return False
            self.newest_ns = stamp_ns
        self._n_far = 0
        return True

    def shift(self, by_ns: int) -> None:
        """Add an offset [ns] to the newest stamp, because all stamps from now on have it."""
        if self.newest_ns > 0:
            self.newest_ns = max(self.newest_ns + by_ns, 1)

    def reset(self, newest_ns: int = 0) -> None:
        """Set the newest stamp [ns]; with 0 the next stamp is accepted, whatever it is."""
        self.newest_ns, self._n_far = newest_ns, 0
