# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Which runs to believe, and which to remember.

The set of runs with the lowest price is a shortest path through the runs in the order of time. So
old ones can be forgotten: their prices pass on to those after them.
"""

import numpy as np

from pose_graph_ros.core.judgement.odometry_chain import OdometryChain
from pose_graph_ros.core.judgement.runs import EVENT, LEAST_MEMBERS, Run, Transition

# Number of runs that are remembered; time after which those of few members are forgotten [ns].
MOST_RUNS = 24
SHORT_LIVED_NS = 30_000_000_000
# Excess of the price of a believed run over that of a hopeless one.
HOPELESS = 50.0


def best_runs(runs: list[Run], chain: OdometryChain) -> list[tuple[Run, Transition]]:
    """
    Return the runs to believe, in the order of time, each with the way from the one before.

    Parameters
    ----------
    runs : list of Run, at least one

    """
    ordered = sorted(runs, key=lambda run: (run.begin_ns, run.number))
    total: list[float] = []
    before: list[tuple[int, Transition]] = []
    for k, run in enumerate(ordered):
        cost, best = run.before, (-1, Transition(0.0))
        for m, other in enumerate(ordered[:k]):
            for way in run.ways_after(other, chain):
                price = total[m] + way.price
                if way.cut >= 0:
                    lasted = (other.end_ns - other.states[way.cut][0]) * 1e-9
                    if not any(wrong.n > 1 and wrong.seconds >= lasted
                               for wrong in ordered[m + 1:k]):
                        price += EVENT  # no wrong run follows that they could be the beginning of
                if price < cost:
                    cost, best = price, (m, way)
        total.append(cost - run.price)
        before.append(best)
    k, chosen = int(np.argmin(total)), []
    while k >= 0:
        chosen.append((ordered[k], before[k][1]))
        k = before[k][0]
    return chosen[::-1]


def remembered(runs: list[Run], stamp_ns: int) -> list[Run]:
    """
    Return the runs without those that cannot win any more, and at most `MOST_RUNS` of them.

    Parameters
    ----------
    stamp_ns : int, of the newest measurement

    """
    price = max((run.price for run in runs if run.believed), default=0.0)
    runs = [run for run in runs if run.believed or not (
        (run.n < LEAST_MEMBERS and stamp_ns - run.end_ns > SHORT_LIVED_NS)
        or (run.contradicted and price > run.price + HOPELESS))]
    while len(runs) > MOST_RUNS:
        doubted = [run for run in runs if not run.believed]
        runs.remove(min(doubted, key=lambda run: run.seconds) if len(doubted) > 0
                    else min(runs, key=lambda run: run.begin_ns))
    return runs


def without_old(runs: list[Run], node: int, kept: Run | None, chain: OdometryChain) -> list[Run]:
    """
    Return the runs without those that ended before a node; their prices pass on to those after.

    The rest of the shortest path through all of them stays the same.

    Parameters
    ----------
    node : int, id of the first node that stays in the graph
    kept : Run, optional, that stays

    """
    left = sorted(runs, key=lambda run: (run.begin_ns, run.number))
    for old in [run for run in left if run.track.node < node and run is not kept]:
        left.remove(old)
        for run in left:
            for way in run.ways_after(old, chain):
                price = old.before - old.price + way.price
                if way.cut < 0 and price < run.before:
                    jump = (old.track.node, run.first.node, way.scale)
                    run.before = price
                    run.jumps_before = old.jumps_before + ((jump,) if way.scale > 1.0 else ())
            run.prices.pop(old.number, None)
    return [run for run in runs if run in left]
