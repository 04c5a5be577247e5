# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Play a bag to the node over DDS, as drivers would, and record the node's outputs.

No message is lost: the writers are reliable, and the node's queues hold all messages that it has
not processed yet, by its own count. At the end it is asked for the final optimisation and path,
and to save its graph.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
import time
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path as PathMessage
import rclpy
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger
from tqdm import tqdm

from pose_graph_ros.adapters import bag_writer, bags, parameter_table
from pose_graph_ros.adapters.bags import MessageError, open_bag
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.quantities import NANOSECONDS
from pose_graph_ros.ros.topics import LATCHED_QOS, message_class, STATIC_QOS, TF_TYPE, TFMessage

NODE_NAME = 'pose_graph'  # name of the node, for its service and its diagnostics
RECORDED, KEPT = ('pose', 'filtered_odometry', 'diagnostics'), ('path', 'verdicts')
"""Outputs that are recorded, and those of which only the newest message is."""
# Profiles are reliable if they do not say otherwise.
RELIABLE = QoSProfile(depth=1000)


class Patience(NamedTuple):
    """Longest waits for the node [s], and how far it may fall behind."""

    appear: float = 30.0
    prepare: float = 600.0      # compile, as at its first start
    stall: float = 20.0         # process another message
    answer: float = 90.0
    path_silence: float = 1.0   # after which the last path has come; longer than `path_period`
    unprocessed: int = 400      # messages; well below the depth of the node's queues


PATIENCE = Patience()


class Player(Node):
    """Publishes a bag and records the node's outputs."""

    def __init__(self, inputs: bags.Inputs, topics: Mapping[str, str], context: Context,
                 is_running: Callable[[], bool]) -> None:
        super().__init__('pose_graph_player', context=context)
        self._inputs, self._is_running = inputs, is_running
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self)
        self._writers = {source: self.create_publisher(
            message_class(kind.message_type), topics[source], RELIABLE)
            for source, kind in inputs.kinds.items()}
        self._static = None if TFMessage is None else self.create_publisher(
            TFMessage, bags.STATIC_FRAMES[0], STATIC_QOS)
        # topic, type, time of arrival [ns] and bytes of the node's messages
        self._recorded: list[tuple[str, str, int, bytes]] = []
        self._newest: dict[str, tuple[str, str, int, bytes]] = {}  # on the latched topics
        self.diagnostics: dict[str, str] = {}  # the newest values of the node's diagnostics
        outputs = {name: parameter_table.OUTPUTS[name][:2] for name in (*RECORDED, *KEPT)}
        if TFMessage is not None:
            outputs['tf'] = '/tf', TF_TYPE
        for name, (relative, type_name) in outputs.items():
            topic = self.resolve_topic_name(relative.replace('~', NODE_NAME))
            self.create_subscription(
                message_class(type_name), topic, partial(self._record, name, topic, type_name),
                LATCHED_QOS if name in KEPT else RELIABLE, raw=True)
        self._optimize, self._save = (self.create_client(Trigger, f'{NODE_NAME}/{name}')
                                      for name in ('optimize', 'save_graph'))

    def _record(self, output: str, topic: str, type_name: str, raw: bytes) -> None:
        received = topic, type_name, time.time_ns(), raw
        own = [status for status in deserialize_message(raw, DiagnosticArray).status
               if status.name.partition(':')[0].rpartition('/')[2] == NODE_NAME
               ] if output == 'diagnostics' else []
        if len(own) > 0:
            self.diagnostics = {value.key: value.value for value in own[0].values}
        if output in KEPT:
            self._newest[output] = received
        elif output != 'diagnostics' or len(own) > 0:
            self._recorded.append(received)

    @property
    def processed(self) -> int:
        """Number of messages that the node has processed, by its diagnostics."""
        return int(self.diagnostics.get('processed', 0))

    def _spin_until(self, done: Callable[[], bool], timeout: float, failure: str) -> None:
        """Receive messages until a condition holds, at most for a time [s]."""
        end = time.monotonic() + timeout
        while not done():
            if not self._is_running():
                raise PoseGraphError('the node ended early')
            if time.monotonic() > end:
                raise PoseGraphError(f'{failure} (waited {timeout:g} s)')
            self._executor.spin_once(timeout_sec=0.05)

    def play(self, bag: Path, rate: float) -> Counter[str]:
        """
        Return the numbers of messages by input, after publishing those of a bag.

        They are all processed then. The rate is relative to the recorded one; 0 is as fast as the
        node can process. Messages that are held out are counted under `held_out`, and those that
        cannot be decoded under `malformed`.
        """
        self._spin_until(
            lambda: all(writer.get_subscription_count() > 0 for writer in self._writers.values())
            and len(self.diagnostics) > 0 and self._optimize.service_is_ready()
            and self._save.service_is_ready(), PATIENCE.appear, 'the node does not subscribe')
        self._spin_until(lambda: self.diagnostics.get('prepared') != '0', PATIENCE.prepare,
                         'the node is still compiling')
        sent = self.processed
        published: Counter[str] = Counter()
        with open_bag(bag) as reader:
            if self._static is not None:
                for frames in bags.read_static_frames(reader):
                    self._static.publish(frames.raw)
            # the other side of a match may learn of it a little later
            settled = time.monotonic() + 0.5
            self._spin_until(lambda: time.monotonic() > settled, 2.0, '')
            total = sum(reader.topics[topic].count for topic in self._inputs.topics.values())
            start = first_ns = None
            progress = tqdm(total=total, disable=None, unit=' messages')     # on a terminal
            for source, message, held_out in bags.read_inputs(reader, self._inputs):
                if held_out:
                    published['held_out'] += 1
                    continue
                try:
                    message.decode()
                except MessageError:
                    # the middleware would drop it, and the replay leaves it out as well
                    published['malformed'] += 1
                    continue
                if start is None or first_ns is None:
                    start, first_ns = time.monotonic(), message.recorded_ns
                if rate > 0.0:
                    instant = start + (message.recorded_ns - first_ns) * 1e-9 / rate
                    while (left := instant - time.monotonic()) > 0.0:
                        self._executor.spin_once(timeout_sec=min(left, 0.05))
                self._writers[source].publish(message.raw)
                published[source] += 1
                sent += 1
                if sent - self.processed > PATIENCE.unprocessed:
                    self._wait_for(sent - PATIENCE.unprocessed // 2)
                self._executor.spin_once(timeout_sec=0.0)
                progress.update()
        progress.close()
        self._wait_for(sent)
        return published

    def _wait_for(self, count: int) -> None:
        """Wait until the node has processed a number of messages, as long as it makes progress."""
        while (before := self.processed) < count:
            self._spin_until(
                lambda before=before: self.processed > before, PATIENCE.stall,  # type: ignore[misc]
                f'the node has processed {before} of {count} messages and makes no progress')

    def request_final_optimization(self) -> tuple[bool, str]:
        """Call ~/optimize, and wait for the path after it; return success and message."""
        asked_ns = time.time_ns()
        response = self._call(self._optimize, 'the optimisation')
        answered_ns = time.time_ns()

        def is_last() -> bool:
            """Tell whether no other path comes: an earlier one may still come first."""
            path_ns = self._newest['path'][2] if 'path' in self._newest else 0
            silence_ns = time.time_ns() - max(answered_ns, path_ns)
            return path_ns > asked_ns and silence_ns > PATIENCE.path_silence * NANOSECONDS
        self._spin_until(is_last, PATIENCE.answer, 'no path came after the optimisation')
        return bool(response.success), str(response.message)

    def _call(self, service: Client, what: str) -> Trigger.Response:
        asked = service.call_async(Trigger.Request())
        self._spin_until(asked.done, PATIENCE.answer, f'no answer to {what}')
        return asked.result()

    def write(self, folder: Path) -> int:
        """
        Have the node save its graph, and write a rosbag2 of all that it has published.

        Return the number of poses of the newest path.
        """
        answer = self._call(self._save, 'saving the graph')
        if not answer.success:
            raise PoseGraphError(f'~/save_graph: {answer.message}')
        newest = list(self._newest.values())
        with bag_writer.BagWriter(folder, overwrite=True, latched=[
                topic for topic, *_ in newest]) as writer:
            for message in (*self._recorded, *newest):
                writer.write(*message)
        return len(deserialize_message(self._newest['path'][-1], PathMessage).poses)


def play(bag: Path, out: Path, inputs: bags.Inputs, topics: Mapping[str, str], *, rate: float,
         is_running: Callable[[], bool]) -> bool:
    """
    Play a bag to the node on its topics, and write its outputs as a rosbag2.

    Return whether the final optimisation converged. `is_running` tells whether the node still is.
    """
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        player = Player(inputs, topics, context, is_running)
        published = player.play(bag, rate)
        success, answer = player.request_final_optimization()
        n_poses = player.write(out)
        print('published: ' + ', '.join(f'{key} {count}' for key, count in published.items()))
        print(f'the node: processed {player.processed}; optimisation {answer}; '
              f'path of {n_poses} poses')
    finally:
        rclpy.try_shutdown(context=context)
    return success
