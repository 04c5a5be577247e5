# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
The real node over DDS while half of its loop closures are wrong: its longest update.

    .venv/bin/python -m benchmark.robust_node --nodes 10000 --rate 50

A drive through a city like city10000, with as many right closures and as many wrong ones, is sent
many times faster than it was driven. The longest update is what the node says in its diagnostics,
by the clock; its latency is that of `odometry/filtered`, as in `benchmark.load`.
"""

import argparse
from collections.abc import Sequence
import gc
import math
import time

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np

from benchmark.feeder import Feeder, Phase, SECOND, SENT_QOS
from benchmark.load import NODE, PARAMETERS, started
from benchmark.robust_closures import Recording
from benchmark.robust_timing import city
from benchmark.robust_worlds import with_false
from benchmark.section import say

FIRST_NS = 1_700_000_000 * SECOND
SPEED = 1.0
"""Of the recording [m/s]."""


class ClosureFeeder(Feeder):
    """Also sends loop closures."""

    def play(self, recording: Recording, rate: float) -> Phase:
        """
        Send a recording, and note what comes back.

        Parameters
        ----------
        recording : Recording
        rate : float, of odometry [Hz]

        """
        closures = self._node.create_publisher(
            PoseWithCovarianceStamped, 'loop_closure', SENT_QOS)
        self.wait_until(lambda: closures.get_subscription_count() > 0, 'closures are heard')
        phase = self._phase = Phase(rate)
        closure, begin = 0, time.monotonic()
        gc.collect()
        gc.disable()
        with self._listening() as listen:
            for k, stamp in enumerate(recording.stamps_ns.tolist()):
                listen(begin + k / rate)
                x, y, theta = recording.odometry[k].tolist()
                self._n_sent += 1
                phase.sent_ns[FIRST_NS + stamp] = time.monotonic_ns()
                self._odometry.publish(self._odometry_template.fill(
                    FIRST_NS + stamp, x=x, y=y, qz=math.sin(0.5 * theta),
                    qw=math.cos(0.5 * theta), speed=SPEED))
                while (closure < len(recording.ends)
                       and recording.arrival_ns[closure] <= stamp):
                    self._n_sent += 1
                    closures.publish(_message(recording, closure))
                    closure += 1
        gc.enable()
        return phase


def _message(recording: Recording, number: int) -> PoseWithCovarianceStamped:
    reference, stamp = (FIRST_NS + recording.ends[number]).tolist()
    message = PoseWithCovarianceStamped()
    message.header.frame_id = f'@{reference // SECOND}.{reference % SECOND:09d}'
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
    x, y, theta = recording.poses[number].tolist()
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation.z = math.sin(0.5 * theta)
    message.pose.pose.orientation.w = math.cos(0.5 * theta)
    covariance = np.zeros((6, 6))
    covariance[np.ix_((0, 1, 5), (0, 1, 5))] = recording.covariances[number]
    message.pose.covariance = covariance.ravel().tolist()
    return message


def main(argv: Sequence[str] | None = None) -> None:
    """Drive once, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--nodes', type=int, default=10_000)
    parser.add_argument('--rate', type=float, default=50.0, help='of odometry [Hz]')
    parser.add_argument('--wrong', type=float, default=0.5, help='share of the closures')
    options = parser.parse_args(argv)
    recording = with_false(city(options.nodes), options.wrong, 1, 0)
    with started(NODE, PARAMETERS, feeder_type=ClosureFeeder) as (process, feeder):
        assert isinstance(feeder, ClosureFeeder)
        feeder.wait_until_ready()
        feeder.rest(0.5)
        before = process.memory()['VmRSS']
        phase = feeder.play(recording, options.rate)
        feeder.settle()
        values, latency = feeder.values, phase.latency
        say(f'{values["hidden_nodes"]} hidden nodes, {len(recording.ends)} closures, '
            f'{100 * options.wrong:.0f} % wrong, {options.rate:g} nodes a second: '
            f'{values["loop_closure.believed"]} believed, {values["loop_closure.doubted"]} '
            f'doubted, {values["loop_closure.waiting"]} wait')
        say(f'update mean {values["solve_mean_ms"]} ms, longest {values["solve_max_ms"]} ms; '
            f'latency of the output p50 / p99 / most: '
            f'{" / ".join(f"{each:.1f}" for each in np.percentile(latency, (50, 99, 100)))} ms; '
            f'resident {before:.0f} MB, then {process.memory()["VmRSS"]:.0f} MB')


if __name__ == '__main__':
    main()
