# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a decision on all measurements in the map costs, in the prices of `runs`."""

from collections.abc import Iterable
import math

import numpy as np

from pose_graph_ros.core.judgement.fix_states import LONE
from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.run_set import BEGIN_HEADING, gate, NOWHERE
from pose_graph_ros.core.judgement.runs import EVENT, LONGEST, RATE, SLIP, SLIP_HEADING, slip_price
from pose_graph_ros.core.judgement.tracks import Observation, Track


def decision_cost(
    decided: Iterable[tuple[int, Observation, int, bool]], begin: Track | None,
    chain: OdometryChain,
) -> float:
    """
    Return the sum of the squared distances of all measurements and the prices of what is wrong.

    Parameters
    ----------
    decided : iterable of stamp [ns], observation, number of its run, and whether it is believed,
        in the order of stamps
    begin : Track, optional, where the robot is by what is not among them

    """
    total, main = 0.0, begin
    wrong: dict[int, tuple[int, Track]] = {}
    for stamp_ns, seen, run, believed in decided:
        before_ns, before = (stamp_ns, main) if believed else wrong.get(run, (stamp_ns, None))
        if not believed:
            total += EVENT if before is None else RATE * min(
                (stamp_ns - before_ns) * 1e-9, LONGEST)
        if before is None:
            known = seen.mean if main is None else main.moved(chain, seen.node).pose
            after = Track(seen.node, known, np.diag((NOWHERE, NOWHERE, BEGIN_HEADING**2)))
        else:
            after = before.moved(chain, seen.node).bent(before.pose)
            d2, most = after.innovation(seen).d2, gate(seen.size)
            total += min(d2, most)
            if believed and d2 > most:
                price, after = _slipped(before, after, seen, chain)
                total += min(price, d2 - most)
        after = after.updated(after.innovation(seen))
        if believed:
            main = after
        elif run != LONE:
            wrong[run] = stamp_ns, after
    return total


def _slipped(
    before: Track, after: Track, seen: Observation, chain: OdometryChain,
) -> tuple[float, Track]:
    """Return the price of a slip that explains an observation, and the track with it."""
    error, _, cov, _, _ = after.innovation(seen)
    size = math.hypot(error[0], error[1])
    way = float(np.diff(chain.travel(np.array((before.node, seen.node))))[0])
    slip = np.diag((*2 * ((SLIP**2 + size**2) / 3.0,), SLIP_HEADING**2))
    price = slip_price(size, 0.5 * float(cov[0, 0] + cov[1, 1]), way)
    return price, after._replace(cov=after.cov + slip)
