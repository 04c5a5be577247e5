# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What takes too long is interrupted, and the outputs go on from odometry, over DDS."""

from pathlib import Path

from harness import Client, NodeProcess, odometry, PATIENCE
import numpy as np
from std_srvs.srv import Trigger

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import (
    BackendConfig,
    Loss,
    MeasurementSource,
    OdometrySource,
    Robust,
)
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.io.graph_files import write_graph
from pose_graph_ros.core.measurements import LoopClosure, OdometrySample

SECOND = 1_000_000_000
N_NODES, N_CLOSURES = 1500, 90
"""With so many closures, all of them wrong, a full optimisation has a thousand iterations."""
ROBUST = MeasurementSource(robust=Robust.LOSS, loss=Loss.CAUCHY)
"""Of closures that are all used, so that nothing decided meanwhile makes it easier."""


def write_tangle(file: Path) -> np.ndarray:
    """Write a graph with wrong closures; return the newest odometry, at the time `N_NODES`."""
    rng, pose = np.random.default_rng(5), np.zeros(3)
    backend = PoseGraphBackend(BackendConfig(
        odometry={'odom': OdometrySource()}, measurements={'loop_closure': ROBUST}))
    for step in range(1, N_NODES + 1):
        pose = se2.compose(pose, np.array([1.0, 0.0, rng.normal(0.0, 0.05)]))
        backend.add_odometry(OdometrySample(step * SECOND, pose))
    for _ in range(N_CLOSURES):
        begin, end = np.sort(rng.choice(N_NODES - 10, 2, replace=False) + 1).tolist()
        backend.add_measurement(LoopClosure(
            end * SECOND, rng.normal(size=3), 0.01 * np.eye(3), reference_ns=begin * SECOND),
            'loop_closure')
    backend.finish()
    backend.update()
    write_graph(backend.saved(), file)
    return pose


def test_poses_follow_odometry_while_an_optimisation_takes_too_long(tmp_path: Path) -> None:
    pose = write_tangle(tmp_path / 'tangle.g2o')
    arguments = ('-p', 'load_graph_on_start:=true', '-p', f'graph_file:={tmp_path}/tangle.g2o',
                 '-p', 'closing_silence:=0.0', '-p', 'solve_timeout:=0.3',
                 '-p', 'loop_closure.robust:=loss', '-p', 'loop_closure.robust_loss:=cauchy')
    with NodeProcess(tmp_path, arguments) as process, Client(
            int(process.env['ROS_DOMAIN_ID'])) as client:
        steps = 0

        def move() -> None:
            nonlocal steps
            steps += 1
            seconds = N_NODES + 0.05 * steps
            ahead = se2.compose(pose, np.array([0.05 * steps, 0.0, 0.0]))
            client.odom.publish(odometry(seconds, *ahead.tolist()))
            client.spin_for(0.05)

        while len(client.poses) == 0:
            move()
            assert steps < 20 * PATIENCE, 'the node answers odometry'
        optimize, asked = client.node.create_client(Trigger, 'pose_graph/optimize'), steps
        client.spin_until(optimize.service_is_ready, 'the service is there')
        client.wait_matched()
        answered = optimize.call_async(Trigger.Request())
        client.poses.clear()
        while not answered.done():
            move()
        # about six, at the rate of odometry
        assert len(client.poses) > 2
        assert not answered.result().success
        assert 'it took too long' in answered.result().message
        client.spin_until(lambda: len(client.poses) >= steps - asked, 'all odometry is answered')
        client.wait_values({'worker.timed_out': '1'})
        assert 'the full optimisation has taken longer than 0.3 s' in process.stderr()
        # who has the time can have it done
        assert client.set_parameter('solve_timeout', 0.0) == (True, '')
        assert client.trigger('optimize').success
