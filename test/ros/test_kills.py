# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A real node that is killed at random moments of a drive over DDS loses only the newest."""

from contextlib import ExitStack
import math
import os
from pathlib import Path
import time

from harness import Client, NodeProcess, odometry, pose, stamp_ns
import numpy as np

KILLS = int(os.environ.get('POSE_GRAPH_KILLS', '50'))
# state_period, after which all is on the disk; half of the default, for half of the time [s].
WINDOW = 0.5
RADIUS, SPEED, STEP = 30.0, 20.0, 0.05  # of the drive, a circle [m], [m/s], [s]


class Drive:
    """Sends odometry, and poses in the map; a closure joins each lap with the one before."""

    def __init__(self, client: Client) -> None:
        self.client, self.time = client, 100.0
        self._rng = np.random.default_rng(0)

    def step(self) -> None:
        self.time += STEP
        angle = SPEED / RADIUS * self.time
        x, y, theta = RADIUS * math.sin(angle), -RADIUS * math.cos(angle), angle
        at = math.remainder(theta, math.tau)
        self.client.odom.publish(odometry(self.time, x, y, at, SPEED))
        if round(self.time / STEP) % 5 == 0:
            dx, dy = self._rng.normal(0.0, 0.1, 2)
            self.client.global_pose.publish(pose(self.time, x + dx, y + dy, at))
        self.client.spin_for(STEP)


def test_nothing_older_than_the_window_is_missing_after_a_kill(tmp_path: Path) -> None:
    rng, arguments = np.random.default_rng(1), [
        '-p', f'state_file:={tmp_path / "state.db"}', '-p', 'closing_silence:=0.0',
        '-p', f'state_period:={WINDOW}']
    with ExitStack() as stack:
        process = stack.enter_context(NodeProcess(tmp_path, arguments))
        domain = int(process.env['ROS_DOMAIN_ID'])
        client = stack.enter_context(Client(domain))
        drive, moves, lag = Drive(client), list[float](), 0.0
        held: list[tuple[float, int, int]] = []     # when what was in the graph
        for kill in range(KILLS):
            end = time.monotonic() + rng.uniform(0.1, 2.0 * WINDOW)
            while time.monotonic() < end:
                drive.step()
                values = client.values
                # of a busy disk or processor the node says so
                lag = max(lag, float(values['journal.lag_max_s']))
                if 'hidden_nodes' in values:
                    held.append((time.monotonic(), int(values['hidden_nodes']),
                                 int(values['observed_nodes'])))
            process.process.kill()
            killed_at = time.monotonic()
            process.process.wait()
            # what the killed one has sent, a busy machine may deliver late
            came = -1
            while (count := len(client.paths) + len(client.diagnostics)) > came:
                came = count
                client.spin_for(0.1)
            path = client.paths[-1].poses if len(client.paths) > 0 else []
            for kept in (client.paths, client.diagnostics):
                kept.clear()
            folder = tmp_path / str(kill)
            folder.mkdir()
            process = stack.enter_context(NodeProcess(folder, arguments, domain))
            client.wait_prepared()
            held = [each for each in held if each[0] < killed_at - max(WINDOW, lag)]
            if len(path) > 0:
                client.spin_until(
                    lambda: len(client.paths) > 0 and 'hidden_nodes' in client.values,
                    'the path is there again')
            log = process.stderr()
            assert '.bad-' not in log, 'never a file that does not load'
            if len(path) == 0:
                continue
            again = {stamp_ns(each): each.pose.position for each in client.paths[0].poses}
            # but for the newest odometry at its end
            moves.append(max((math.dist(
                (was.x, was.y), (again[stamp_ns(each)].x, again[stamp_ns(each)].y))
                for each in path[:-1] for was in [each.pose.position]), default=0.0))
            _, nodes, observed = max(held, default=(0.0, 0, 0))
            assert int(client.values['hidden_nodes']) >= nodes
            assert int(client.values['observed_nodes']) >= observed
            assert 'continuing with' in log
        exact = sum(move < 1e-9 for move in moves)
        print(f'{len(moves)} kills with a path, {exact} with the same, others moved by '
              f'{sorted(moves)[-5:]} m; longest lag {lag} s')
        # what was published is there to the bit, or that which was about to be
        assert max(moves) < 0.5
        assert exact > 0.5 * len(moves)


def test_odometry_that_begins_anew_after_a_kill_is_joined_to_the_same_map(tmp_path: Path) -> None:
    arguments = ['-p', f'state_file:={tmp_path / "state.db"}', '-p', 'closing_silence:=0.0',
                 '-p', f'state_period:={WINDOW}']

    def straight(client: Client, begin: float, x: float, odometry_x: float) -> float:
        for k in range(60):
            client.odom.publish(odometry(begin + 0.1 * k, odometry_x + 0.2 * k, 0.0, 0.0))
            if k % 5 == 0:
                client.global_pose.publish(pose(begin + 0.1 * k, x + 0.2 * k, 5.0, 0.0))
            client.spin_for(0.02)
        client.wait_answered(begin + 5.9)
        return x + 11.8
    with ExitStack() as stack:
        process = stack.enter_context(NodeProcess(tmp_path, arguments))
        domain = int(process.env['ROS_DOMAIN_ID'])
        client = stack.enter_context(Client(domain))
        x = straight(client, 100.0, 0.0, 0.0)
        client.spin_for(2.0 * WINDOW)
        process.process.kill()
        process.process.wait()
        for kept in (client.paths, client.diagnostics):
            kept.clear()
        (tmp_path / 'again').mkdir()
        stack.enter_context(NodeProcess(tmp_path / 'again', arguments, domain))
        client.wait_for_the_node()
        client.spin_until(lambda: len(client.paths) > 0, 'the path is there again')
        before = client.paths[-1].poses[:-1]
        # wheels that count from zero, a minute later and half a metre farther
        x = straight(client, 160.0, x + 0.5, 0.0)
        client.optimize()
        assert math.hypot(client.poses[-1].pose.pose.position.x - x,
                          client.poses[-1].pose.pose.position.y - 5.0) < 0.3
        again = {stamp_ns(each): each.pose.position for each in client.paths[-1].poses}
        assert all(math.dist((each.pose.position.x, each.pose.position.y), (
            again[stamp_ns(each)].x, again[stamp_ns(each)].y)) < 0.2 for each in before)
