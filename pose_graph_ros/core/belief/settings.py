# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What is assumed of receivers and of odometry: each number is a sentence about the world."""

from typing import NamedTuple


class BankSettings(NamedTuple):
    """Meaning and unit of each number stand beside it."""

    # --- how often something goes wrong, and how far
    between_faults: float = 300.0  # mean time from one fault of a receiver to the next [s]
    fault: float = 30.0  # mean time that a fault lasts [s]
    between_slips: float = 10000.0  # mean time between slips of odometry [s]
    slip: float = 3.0  # mean time that one lasts, as wheels spin for some seconds [s]
    outliers: float = 0.01  # share of measurements that are wrong by themselves
    # scale of the Cauchy density of what is wrong: hardly anything is known of its size [m]
    fault_size: float = 20.0
    slip_size: float = 1.0
    slip_heading: float = 0.3  # sigma of the heading after a slip [rad]
    # the offset in a fault is as mobile as the error of a good receiver, and wanders [m/sqrt(s)]
    wander: float = 0.1
    # reflections change: in a fault the offset jumps, about three times, and so far [m]
    jump_size: float = 3.0
    # wheels that spin make the way too long, so a robot that must have moved farther than its
    # odometry says by five `slip_size` has hardly slipped: that is less likely by so many nats
    unmoved: float = 7.0

    # --- what is known at the beginning
    headings: int = 16  # headings that are tried, also after a turn that is less known, with
    heading: float = 0.15  # such a sigma [rad]
    # how far a receiver is off that begins in a fault: mostly twice `fault_size`, or as after a
    # cold start [m]
    far_fault: float = 1000.0
    rate: float = 0.005  # sigma of the constant error of the yaw rate [rad/s]
    scale: float = 0.01  # sigma of that of the scale of the way
    # least sigmas to decide by, as maps and mountings are not exact, and covariances mostly too
    # small [m, m, rad]
    least_sigmas: tuple[float, float, float] = (0.3, 0.3, 0.05)

    # --- how noisy all is
    # evidence that is needed for slow errors of a source, for odometry that is not as noisy as it
    # claims or for other noise than that in use, and for each constant error of odometry [nats]
    slow_evidence: float = 10.0
    noise_evidence: float = 3.0
    constant_evidence: float = 1.0
    # medians of variances in units of what is claimed, and sigmas of their logarithms: nobody
    # knows how noisy turns are; what receivers claim of slow errors may be a small part of them
    way: tuple[float, float] = (1.0, 2.0)
    turn: tuple[float, float] = (1.0, 3.0)
    # of the logarithm of all of what a source claims, below and above: hardly any receiver is
    # better than it says, many are worse
    spread: tuple[float, float] = (0.5, 1.0)
    slow: tuple[float, float] = (1.0, 2.0)
    tau: tuple[float, float] = (40.0, 1.0)  # of the time constant of slow errors [s]
    least_white: float = 0.01  # least white part of what a source claims, as a variance
    astray: int = 8  # successive measurements that are wrong after which a filter begins again
    # at which numbers of measurements noise is learnt: the first, and the ratio of the next one
    first_learnt: int = 10
    next_learnt: float = 1.3
    # newest ones that it is learnt from while measurements come, when a quarter of them is new
    most_learnt: int = 2000

    # --- the bank
    hypotheses: int = 144  # at least 5 for each heading that is tried
    sources: int = 4  # sources with an error of their own; further ones share that of the last
    # a hypothesis is dropped that is less likely by so many nats, and while measurements come
    # nothing is learnt from what such noise takes for wrong
    hopeless: float = 30.0
    alike: int = 6  # most hypotheses with the same faults in the same place
    same_place: float = 3.0  # that is within so many sigmas,
    alike_spread: float = 10.0  # with variances within such a factor
    equal: float = 0.4  # within so many sigmas two become one
    period_ns: int = 1_000_000_000  # of each source one measurement in such a time decides [ns]
    # rows from one state that is kept to the next; between old ones, such a part of their age
    checkpoint: int = 16
    kept: int = 8


BANK = BankSettings()
