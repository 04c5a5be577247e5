# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hidden nodes by one odometry source or several: where they are, and the edges between them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
import functools

from hypothesis import given, settings, strategies as st
import numpy as np
import pytest

from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig, NodePolicy, OdometryNoise, OdometrySource
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import Factors
from pose_graph_ros.core.measurements import OdometrySample
from pose_graph_ros.core.odometry.hidden_nodes import HiddenNodes, NewNode

SECOND = 1_000_000_000
EPOCH = 1_767_225_600 * SECOND
# Compositions of poses of some 100 m.
ROUNDING = 1e-9
PATIENCE = 2.0


@functools.cache
def truth(time: float) -> FloatArray:
    """Where the robot is at a time [s]: 2 m/s in wide bends."""
    fine = np.linspace(0.0, time, max(int(time * 50), 2))
    theta = 0.8 * np.sin(0.2 * fine)
    pose = np.array([np.trapezoid(2.0 * np.cos(theta), fine),
                     np.trapezoid(2.0 * np.sin(theta), fine), theta[-1]])
    pose.flags.writeable = False
    return pose


def stamp_of(time: float) -> int:
    return EPOCH + round(time * 1e9)


def samples(times: Sequence[float], frame: FloatArray) -> list[OdometrySample]:
    """Sample true odometry, seen from a frame of its own."""
    return [OdometrySample(stamp_of(t), se2.between(frame, truth(t))) for t in times]


FRAMES = {'wheel': np.array([3.0, -1.0, 0.7]), 'visual': np.array([-20.0, 5.0, -2.0]),
          'lidar': np.array([0.0, 9.0, 3.0])}
CONFIG = BackendConfig(
    odometry={name: OdometrySource(noise=OdometryNoise(sigma_distance=0.01 * k))
              for k, name in enumerate(FRAMES, 1)}, odometry_patience=PATIENCE)


@dataclass
class Made:
    """The arguments with which nodes were made."""

    means: list[FloatArray] = field(default_factory=list)
    information: list[FloatArray | None] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)
    refuse: int = 0
    """Number of nodes that are refused next."""

    def __call__(self, new: NewNode) -> int:
        if self.refuse > 0 and new.information is not None:
            self.refuse -= 1
            return -1
        self.means.append(new.mean)
        self.information.append(new.information)
        self.sources.append(new.source)
        return len(self.means) - 1

    @property
    def poses(self) -> FloatArray:
        """Return where odometry alone puts the nodes."""
        poses = self.means[:1]
        for mean in self.means[1:]:
            poses.append(se2.compose(poses[-1], mean))
        return np.array(poses)


def grown(
    arrivals: Sequence[tuple[str, OdometrySample]], config: BackendConfig = CONFIG,
    refuse: Sequence[int] = (), *, finish: bool = True,
) -> tuple[HiddenNodes, Made, list[tuple[str, Factors]]]:
    made = Made()
    nodes = HiddenNodes(config, made)
    for k, (source, sample) in enumerate(arrivals):
        made.refuse += k in refuse
        nodes.add_sample(sample, source)
    if finish:
        nodes.finish()
    assert len(nodes) == len(made.means)
    return nodes, made, nodes.take_secondary_edges()


def by_stamp(times: dict[str, Sequence[float]]) -> list[tuple[str, OdometrySample]]:
    return sorted(((name, one) for name, when in times.items()
                   for one in samples(when, FRAMES[name])), key=lambda item: item[1].stamp_ns)


def edge_of(made: Made, k: int) -> FloatArray:
    return np.linalg.inv(made.information[k])


def assert_true(nodes: HiddenNodes, made: Made, atol: float = 1e-3) -> None:
    """Odometry without noise: the nodes are where the robot was, from the first one."""
    times = (nodes.stamps_ns - EPOCH) * 1e-9
    expected = np.array([truth(t) for t in times])
    expected = se2.between(expected[:1], expected)
    np.testing.assert_allclose(
        se2.between(made.poses[:1], made.poses)[:, :2], expected[:, :2], atol=atol)


# --- Where the nodes are ---------------------------------------------------------------------

def slow_nodes(
    stamps: Sequence[int], poses: Sequence[FloatArray], policy: NodePolicy,
) -> list[int]:
    """Walk through the samples; return the stamps of the nodes."""
    last, result = 0, [stamps[0]]
    for k in range(1, len(stamps)):
        way = np.hypot(*(poses[k] - poses[last])[:2])
        turn = abs(np.angle(np.exp(1j * (poses[k][2] - poses[last][2]))))
        time = (stamps[k] - stamps[last]) * 1e-9
        if (time >= policy.heartbeat
                or (time >= policy.minimum_interval and (
                    way >= policy.minimum_travel_distance
                    or turn >= policy.minimum_travel_heading))
                or (time >= policy.moving_interval and (way >= 0.05 or turn >= 0.05))):
            last = k
            result.append(stamps[k])
    return result


@settings(max_examples=15)
@given(st.integers(0, 10**6))
def test_nodes_are_where_a_slow_walk_puts_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 200
    stamps = (EPOCH + np.cumsum(rng.integers(1, SECOND // 2, n))).tolist()
    speed = np.repeat(rng.choice([0.0, 0.01, 0.5, 3.0], n // 10), 10)
    turn = np.repeat(rng.choice([0.0, 0.005, 0.1], n // 10), 10)
    poses = [rng.uniform(-9.0, 9.0, 3)]
    for k in range(1, n):
        dt = (stamps[k] - stamps[k - 1]) * 1e-9
        poses.append(se2.compose(poses[-1], np.array([speed[k] * dt, 0.0, turn[k] * dt])))
    for policy in (NodePolicy(), NodePolicy(
            minimum_travel_distance=0.4, minimum_interval=0.0, moving_interval=3.0,
            heartbeat=4.0)):
        nodes, made, edges = grown(
            [('wheel', OdometrySample(*item)) for item in zip(stamps, poses, strict=True)],
            BackendConfig(nodes=policy))
        # samples at rest are left out only after they were checked for a node
        assert nodes.stamps_ns.tolist() == slow_nodes(stamps, poses, policy)
        assert edges == []
        at = np.searchsorted(stamps, nodes.stamps_ns)
        np.testing.assert_allclose(
            se2.wrapped(made.poses), se2.wrapped(np.array(poses)[at]), atol=ROUNDING)


def test_a_node_that_cannot_be_made_is_made_at_the_next_sample() -> None:
    arrivals = by_stamp({'wheel': np.arange(0.0, 20.0, 0.1)})
    whole, _, _ = grown(arrivals)
    nodes, made, _ = grown(arrivals, refuse=(50, 100))
    assert len(nodes) in (len(whole), len(whole) - 1)
    assert np.count_nonzero(~np.isin(nodes.stamps_ns, whole.stamps_ns)) > 0
    assert_true(nodes, made)


# --- Several sources -------------------------------------------------------------------------

@settings(max_examples=15)
@given(st.floats(0.02, 0.4), st.floats(0.02, 0.4), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_another_source_adds_edges_between_the_nodes_that_it_covers(
    period: float, phase: float, late: float, early: float,
) -> None:
    begin, end = max(0.0, late), 20.0 - max(0.0, early)
    other = np.arange(begin + phase, end, period)
    arrivals = by_stamp({'wheel': np.arange(0.0, 20.0, 0.1), 'visual': other})
    nodes, made, edges = grown(arrivals)
    alone, _, _ = grown([item for item in arrivals if item[0] == 'wheel'])
    np.testing.assert_array_equal(nodes.stamps_ns, alone.stamps_ns)
    assert set(made.sources) == {'wheel'}
    covered = [k for k, stamp in enumerate(nodes.stamps_ns.tolist())
               if stamp_of(other[0]) <= stamp <= stamp_of(other[-1])]
    assert [(int(edge.i[0]), int(edge.j[0])) for _, edge in edges] == [
        (k, k + 1) for k in covered[:-1]]
    for source, edge in edges:
        assert source == 'visual'
        i, j = (truth((nodes.stamps_ns[k[0]] - EPOCH) * 1e-9) for k in (edge.i, edge.j))
        # the noise contains the error of interpolation
        off = edge.mean[0] - se2.between(i, j)
        sigma = np.sqrt(np.diagonal(np.linalg.inv(edge.information[0])))
        assert np.all(np.abs(off) < sigma + 1e-4)


# --- The primary source ----------------------------------------------------------------------

WHEEL = np.arange(0.0, 30.0, 0.1)
VISUAL = np.arange(0.03, 30.0, 0.07)


def without(times: FloatArray, begin: float, end: float) -> FloatArray:
    return times[(times < begin) | (times >= end)]


@pytest.mark.parametrize('silence', [2.5, 8.0, 100.0])
def test_a_silent_primary_source_is_replaced(silence: float) -> None:
    wheel = without(WHEEL, 10.0, 10.0 + silence)
    nodes, made, edges = grown(by_stamp({'wheel': wheel, 'visual': VISUAL}))
    times = (nodes.stamps_ns - EPOCH) * 1e-9
    assert made.sources == ['wheel' if t < 10.0 else 'visual' for t in times]
    assert np.max(np.diff(times)) < 1.0     # no node is missing
    assert_true(nodes, made)
    # both sources have edges where both have samples
    ends = {(int(edge.i[0]), int(edge.j[0])) for _, edge in edges}
    for k in range(1, len(nodes) - 1):
        in_gap = times[k + 1] > 9.9 and times[k] < 10.0 + silence
        assert ((k, k + 1) in ends) == (not in_gap and times[k] > 0.03)
    # the first edge of the source after its silence spans that
    across = [edge for source, edge in edges if edge.j[0] - edge.i[0] > 1]
    assert len(across) == (1 if silence < 20.0 else 0)


@pytest.mark.parametrize('begin', [8.0, 9.95, 10.5, 14.0])
def test_a_source_that_began_late_can_become_primary(begin: float) -> None:
    visual = np.arange(begin, 30.0, 0.07)
    nodes, made, _ = grown(by_stamp({'wheel': WHEEL[WHEEL < 10.0], 'visual': visual}))
    times = (nodes.stamps_ns - EPOCH) * 1e-9
    k = int(np.searchsorted(times, 9.95))
    assert made.sources == ['wheel'] * k + ['visual'] * (len(nodes) - k)
    off = made.means[k] - se2.between(truth(times[k - 1]), truth(times[k]))
    sigma = np.sqrt(np.diagonal(edge_of(made, k)))
    assert np.all(np.abs(off) < 2.0 * sigma + 1e-3)
    if begin < 9.95:
        assert sigma[0] < 0.1     # they overlap: nothing is unknown
    else:
        assert sigma[0] > 0.4
        assert times[k] == pytest.approx(begin, abs=1e-6)
    # the motions before and after the change are exact
    for part in (slice(0, k), slice(k, None)):
        poses, expected = made.poses[part], np.array([truth(t) for t in times[part]])
        np.testing.assert_allclose(
            se2.between(poses[:1], poses)[:, :2], se2.between(expected[:1], expected)[:, :2],
            atol=1e-3)


def test_no_motion_is_lost_if_nodes_are_refused_while_the_primary_source_changes() -> None:
    arrivals = by_stamp({'wheel': WHEEL[WHEEL < 10.0], 'visual': np.arange(12.0, 30.0, 0.07)})
    change = next(k for k, (name, one) in enumerate(arrivals)
                  if name == 'visual' and one.stamp_ns > stamp_of(12.25))
    nodes, made, _ = grown(arrivals, refuse=range(change, change + 5))
    assert nodes.stamps_ns[-1] > stamp_of(29.0)
    late = int(np.searchsorted(nodes.stamps_ns, stamp_of(11.0)))
    poses = made.poses[late:]
    expected = np.array([truth((t - EPOCH) * 1e-9) for t in nodes.stamps_ns[late:]])
    np.testing.assert_allclose(
        se2.between(poses[:1], poses)[:, :2], se2.between(expected[:1], expected)[:, :2],
        atol=1e-3)


# --- Order of arrival ------------------------------------------------------------------------

SILENCES = st.lists(st.tuples(
    st.sampled_from(list(FRAMES)), st.floats(0.0, 25.0), st.floats(1.7, 9.0)), max_size=5)


@settings(max_examples=12)
@given(SILENCES, st.data(), st.sampled_from((0.0, 0.02, 0.24)))
def test_nodes_and_edges_do_not_depend_on_the_order_of_arrival(
    silences: list[tuple[str, float, float]], data: st.DataObject, spread: float,
) -> None:
    times = {'wheel': np.arange(0.0, 30.0, 0.1), 'visual': np.arange(0.03, 30.0, 0.13),
             'lidar': np.arange(1.31, 30.0, 0.2)}
    for name, begin, long in silences:
        times[name] = without(times[name], begin, begin + long)
    arrivals = by_stamp(times)
    rng = np.random.default_rng(data.draw(st.integers(0, 10**6)))
    delays = rng.uniform(0.0, spread, len(arrivals)) * 1e9
    order = np.argsort([one.stamp_ns - EPOCH + delay for (_, one), delay in zip(
        arrivals, delays, strict=True)])
    shuffled = [arrivals[k] for k in order]
    expected, made, edges = grown(arrivals)
    nodes, made_too, edges_too = grown(shuffled)
    np.testing.assert_array_equal(nodes.stamps_ns, expected.stamps_ns)
    assert nodes._primaries == expected._primaries
    assert made_too.sources == made.sources
    np.testing.assert_array_equal(made_too.means, made.means)
    for a, b in zip(made.information[1:], made_too.information[1:], strict=True):
        np.testing.assert_array_equal(a, b)

    def table(edges: list[tuple[str, Factors]]) -> list[tuple[object, ...]]:
        return sorted((source, int(edge.i[0]), int(edge.j[0]), edge.mean.tobytes(),
                       edge.information.tobytes()) for source, edge in edges)

    assert table(edges_too) == table(edges)
    if len(nodes) > 0:
        for stamp in np.linspace(nodes.stamps_ns[0], nodes.covered_ns, 40).astype(int).tolist():
            one, other = expected.attach(stamp), nodes.attach(stamp)
            assert (one is None) == (other is None)
            if one is not None:
                assert one.node == other.node
                np.testing.assert_array_equal(one.motion, other.motion)
                np.testing.assert_array_equal(one.noise, other.noise)


# --- In the graph ----------------------------------------------------------------------------


def test_a_jump_makes_the_estimate_stale_at_once() -> None:
    backend = PoseGraphBackend(CONFIG)
    for sample in samples(WHEEL[:50], FRAMES['wheel']):
        backend.add_odometry(sample, 'wheel')
    before, revision = backend.estimate(), backend.revision
    here = samples(WHEEL[50:51], FRAMES['wheel'])[0]
    backend.add_odometry(OdometrySample(here.stamp_ns, np.zeros(3)), 'wheel')
    assert backend.revision != revision
    after = backend.estimate()
    np.testing.assert_array_equal(after.T_odom_base, 0.0)
    assert np.hypot(*(after.T_map_base - before.T_map_base)[:2]) < 0.3
    assert after.covariance[0, 0] > before.covariance[0, 0] + 0.2


def test_without_the_samples_behind_thinned_nodes_motions_are_interpolated_between_nodes() -> None:
    nodes, _, _ = grown([('wheel', one) for one in samples(
        np.arange(0.0, 30.0, 0.02).tolist(), FRAMES['wheel'])])
    instants = [int(stamp) + 200_000_000 for stamp in nodes.stamps_ns[2:20:3]]
    before = [nodes.attach(stamp_ns) for stamp_ns in instants]
    nodes.drop_samples(5)   # nothing was thinned out
    assert len(nodes.streams['wheel'].timeline) > 1000
    nodes.thin(nodes.ids[[4]], nodes.ids[[3]], np.array([[2.0, 0.0, 0.0]]), 0.01 * np.eye(3)[None])
    nodes.drop_samples(5)
    timeline = nodes.streams['wheel'].timeline
    assert len(timeline) < 6 * 50
    restored = HiddenNodes(CONFIG, Made())
    restored.restore(nodes.saved())
    for stamp_ns, one in zip(instants, before, strict=True):
        for each in (nodes, restored):
            other = each.attach(stamp_ns)
            assert one is not None
            assert other is not None
            assert other.node == one.node
            # the bend between two nodes is not known
            np.testing.assert_allclose(other.motion, one.motion, atol=0.02)
            assert np.min(np.linalg.eigvalsh(other.noise)) > 0.0
