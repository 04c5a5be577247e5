# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Thinning: a robot that drives in one hall for ever, with a graph that does not grow."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
import time

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np

from benchmark.metrics import ACCURACY, Metric
from benchmark.section import say, Section, Table
from benchmark.window_day import resident
from pose_graph_ros.cli.picture import BLUE, GREY, INK, VERMILION
from pose_graph_ros.core.config import ThinningConfig
from pose_graph_ros.core.geometry import se2
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.constraints import EdgeKind, Edges
from pose_graph_ros.core.graph.graph import GraphUpdate
from pose_graph_ros.core.odometry.node_table import ThinnedNodes
from pose_graph_ros.core.smoother.incremental import IncrementalSmoother
from pose_graph_ros.core.window.sparse_removal import sparse_removal
from pose_graph_ros.core.window.thinning import groups, removed, simplify, Thinning

LENGTH, WIDTH, RADIUS = 30.0, 20.0, 3.0
"""Of the hall, and of the bends [m]."""
ODOMETRY_SIGMA, CLOSURE_SIGMA = np.array((0.03, 0.02, 0.01)), np.array((0.05, 0.05, 0.02))
"""Of a metre of odometry, and of a loop closure [m, m, rad]."""
CLOSURE_EVERY, RECENT = 5, 60
"""Nodes from closure to closure, and nodes that none leads to as they are too new."""
PASSES, SHARED, QUICK_PASSES, QUICK_SHARED = 500, 30, 40, 20
"""Passes of the thinned graph, and of those that are driven with the whole graph as well."""
CELLS = 1.0, 2.0
"""`ThinningConfig.cell` [m]."""
COMPARISON, LONG = 'comparison', 'long'
"""Cases."""
TENTHS = 10
GROWN, SLOWER = 1.05, 1.25
"""Ratios of the last tenth of the passes to the second up to which the graph counts as flat."""
PICTURE = 'hall.png'


@dataclass(slots=True)
class Drive:
    """A drive: true poses, odometry between them, and closures `(from, to, mean)`."""

    truth: FloatArray
    odometry: FloatArray
    closures: dict[int, tuple[int, FloatArray]]
    ends: list[int]
    """Node at which each pass ends."""


@dataclass(slots=True)
class Record:
    """What was measured at the end of each pass, and over its steps."""

    nodes: list[int] = field(default_factory=list)
    edges: list[int] = field(default_factory=list)
    resident: list[float] = field(default_factory=list)
    """Memory of the process [MB]."""
    mean_ms: list[float] = field(default_factory=list)
    squared: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    positions: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    longest_ms: float = 0.0


def pass_of(rng: np.random.Generator, *, back: bool) -> FloatArray:
    """Return true poses, 1 m apart, of a pass along the walls at a random distance."""
    inset = rng.uniform(1.0, 5.0)
    sides = [LENGTH - 2.0 * (inset + RADIUS), WIDTH - 2.0 * (inset + RADIUS)] * 2
    poses, s = [], np.arange(0.0, 0.5 * np.pi * RADIUS, 0.01)
    x, y, theta = inset + RADIUS, inset, 0.0
    for side in sides:
        along = np.arange(0.0, side, 0.01)
        poses.append(np.column_stack((
            x + along * np.cos(theta), y + along * np.sin(theta), np.full(len(along), theta))))
        x, y = x + side * np.cos(theta), y + side * np.sin(theta)
        bend = theta + s / RADIUS
        poses.append(np.column_stack((
            x + RADIUS * (np.sin(bend) - np.sin(theta)),
            y - RADIUS * (np.cos(bend) - np.cos(theta)), bend)))
        x, y = x + RADIUS * (np.cos(theta) - np.sin(theta)), y + RADIUS * (
            np.sin(theta) + np.cos(theta))
        theta += 0.5 * np.pi
    every = np.concatenate(poses)[::100]
    turned = np.array((0.0, 0.0, np.pi))
    return every[::-1] + turned if back else every


def drive(passes: int, seed: int) -> Drive:
    """
    Return a drive of many passes, some of them the other way round.

    Parameters
    ----------
    passes : int
    seed : int

    """
    rng = np.random.default_rng(seed)
    parts = [pass_of(rng, back=k > 0 and rng.random() < 0.3) for k in range(passes)]
    truth = se2.wrapped(np.concatenate(parts))
    odometry = se2.compose(se2.between(truth[:-1], truth[1:]),
                           rng.standard_normal((len(truth) - 1, 3)) * ODOMETRY_SIGMA)
    closures, seen = {}, dict[tuple[int, int], list[int]]()
    for k, (x, y) in enumerate(np.floor(truth[:, :2]).astype(int).tolist()):
        if k % CLOSURE_EVERY == 0:
            near = [j for p in (-1, 0, 1) for q in (-1, 0, 1) for j in seen.get((x + p, y + q), [])
                    if j < k - RECENT]
            if near:
                j = near[rng.integers(len(near))]
                closures[k] = j, se2.compose(se2.between(truth[j], truth[k]),
                                             rng.standard_normal(3) * CLOSURE_SIGMA)
        seen.setdefault((x, y), []).append(k)
    return Drive(truth, odometry, closures, (np.cumsum(list(map(len, parts))) - 1).tolist())


def run(course: Drive, passes: int, config: ThinningConfig) -> Record:
    """
    Solve for a drive step by step.

    Parameters
    ----------
    course : Drive
    passes : int, how many of its passes
    config : ThinningConfig

    """
    smoother, thinning, thinned = IncrementalSmoother(), Thinning(), ThinnedNodes()
    record, times = Record(), list[float]()
    smoother.update(GraphUpdate(hidden=course.truth[:1], fix=[0]))
    squared, nees = list[float](), list[float]()
    information = np.diag(ODOMETRY_SIGMA**-2)
    ends = iter(course.ends[:passes])
    end = next(ends)
    for k in range(1, course.ends[passes - 1] + 1):
        begin = time.perf_counter()
        smoother.extend(course.odometry[k - 1], information)
        if k in course.closures:
            smoother.update(GraphUpdate(edges=_closure(k, *course.closures[k], thinned)))
        places = thinning.places(smoother, config, k + 1)
        if places is not None:
            for group in groups(smoother.graph, places):
                if removed(smoother, sparse_removal(smoother.graph, group.nodes)) is None:
                    break
                thinned.add(*group)
            for _ in simplify(smoother):
                pass
        times.append(1e3 * (time.perf_counter() - begin))
        if k % CLOSURE_EVERY == CLOSURE_EVERY - 1:
            off = smoother.graph.poses_of(k) - course.truth[k]
            off[2] = se2.wrap(off[2])
            squared.append(float(off[0]**2 + off[1]**2))
            nees.append(float(off @ np.linalg.solve(smoother.newest_covariance(), off)) / 3.0)
        if k == end:
            record.nodes.append(smoother.graph.n_nodes)
            record.edges.append(smoother.graph.n_edges)
            record.resident.append(resident())
            record.mean_ms.append(float(np.mean(times)))
            record.squared.append(float(np.mean(squared)))
            record.nees.append(float(np.mean(nees)))
            record.longest_ms = max(record.longest_ms, *times)
            end = next(ends, -1)
            for values in (times, squared, nees):
                values.clear()
    record.positions = smoother.graph.poses[:, :2].copy()
    return record


def _closure(node: int, other: int, mean: FloatArray, thinned: ThinnedNodes) -> Edges:
    """Return the edge of a closure, to the node that stands for the other one if it has left."""
    noise = np.diag(CLOSURE_SIGMA**2)
    place = thinned.place(other)
    if place is not None:
        adjoint = se2.adjoint(se2.inverse(mean))
        other, noise = place.anchor, noise + adjoint @ place.noise @ adjoint.T
        mean = se2.compose(place.mean, mean)
    information = np.linalg.inv(noise)
    return Edges([other], [node], [mean], [0.5 * (information + information.T)],
                 [EdgeKind.LOOP_CLOSURE])


def section(
    *, quick: bool, seeds: int | None, folder: Path, cases: Sequence[str] = (),
) -> Section:
    """
    Compare the thinned graph with the whole one.

    Parameters
    ----------
    quick : bool
    seeds : int, optional, drives of the comparison
    folder : Path, where the picture goes
    cases : sequence of str, only cases that hold one of these; all if empty

    """
    passes, shared = (QUICK_PASSES, QUICK_SHARED) if quick else (PASSES, SHARED)
    n = seeds or (2 if quick else 4)
    found = Section(
        'Does the graph grow with the area or with the time?',
        f'A robot drives along the walls of a hall of {LENGTH:.0f} x {WIDTH:.0f} m, every pass at '
        'another distance from them and some the other way round. A hidden node each metre, a '
        f'closure to an older pass each {CLOSURE_EVERY} m, no fixes. Errors are those of the '
        'newest pose, the first node being fixed at the truth. `thinning.cell` is '
        f'{" or ".join(f"{cell:g} m" for cell in CELLS)}.')
    found.tables = [
        Table(f'The first {shared} passes, {n} drives', (
            'graph', 'nodes', 'edges', 'rms [m]', 'over whole', 'NEES',
            'step, last passes [ms]')),
        Table(f'One drive of {passes} passes, {CELLS[-1]:g} m', (
            'passes', 'nodes', 'edges', 'rms [m]', 'NEES', 'mean step [ms]', 'memory [MB]'))]
    wanted = [case for case in (COMPARISON, LONG)
              if len(cases) == 0 or any(part in case for part in cases)]
    if COMPARISON in wanted:
        _compare(found, [drive(shared, seed) for seed in range(n)], shared)
    if LONG in wanted:
        record = run(drive(passes, 0), passes, ThinningConfig(cell=CELLS[-1], newest=30))
        _fill_long(found, record)
        draw(record, run(drive(shared, 0), shared, ThinningConfig()), folder / PICTURE)
        found.notes.append(f'![Nodes and time of a step over the passes]({PICTURE})')
    return found


def _compare(found: Section, courses: Sequence[Drive], shared: int) -> None:
    """Add the rows of the first passes, with the whole graph and with thinned ones."""
    whole: list[Record] = []
    for name, config in (('whole', ThinningConfig()), *(
            (f'{cell:g} m', ThinningConfig(cell=cell, newest=30)) for cell in CELLS)):
        say(f'hall: {name}')
        records = [run(course, shared, config) for course in courses]
        whole = whole or records
        rms, reference = (float(np.sqrt(np.mean([each.squared for each in some])))
                          for some in (records, whole))
        nees = float(np.mean([each.nees for each in records]))
        found.tables[0].add(
            name, f'{records[0].nodes[-1]}', f'{records[0].edges[-1]}', f'{rms:.3f}',
            f'{rms / reference:.3f}', f'{nees:.2f}',
            f'{np.mean([each.mean_ms[-5:] for each in records]):.2f}')
        found.metrics.append(Metric(f'hall, {name}: rms', rms, 'm', ACCURACY))


def _fill_long(found: Section, record: Record) -> None:
    """Add the rows of many passes, and whether nodes, edges, times and memory are flat."""
    parts = np.array_split(np.arange(len(record.nodes)), TENTHS)
    for part in parts:
        last = part[-1]
        found.tables[1].add(
            f'{last + 1}', f'{record.nodes[last]}', f'{record.edges[last]}',
            f'{np.sqrt(np.mean(np.take(record.squared, part))):.3f}',
            f'{np.mean(np.take(record.nees, part)):.2f}',
            f'{np.mean(np.take(record.mean_ms, part)):.2f}', f'{record.resident[last]:.1f}')
    for name, values, most in (
            ('nodes', record.nodes, GROWN), ('edges', record.edges, GROWN),
            ('mean step', record.mean_ms, SLOWER), ('memory', record.resident, GROWN)):
        early, late = (float(np.mean(np.take(values, part))) for part in (parts[1], parts[-1]))
        found.metrics.append(Metric(
            f'hall, {name}, last tenth of {len(record.nodes)} passes over the second',
            late / early, '', ACCURACY, most))


def draw(record: Record, whole: Record, file: Path) -> None:
    """
    Draw both graphs in the hall, and their size and times over the passes.

    Parameters
    ----------
    record : Record, of the thinned graph
    whole : Record, of the whole graph, with fewer passes
    file : Path

    """
    figure = Figure(figsize=(13.0, 7.0), dpi=100, facecolor='white', layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    for panel, each, colour, name in (
            (axes[0, 0], whole, VERMILION, 'whole graph'),
            (axes[1, 0], record, BLUE, 'thinned graph')):
        panel.add_patch(_walls())
        panel.plot(*each.positions.T, '.', color=colour, markersize=2.5)
        panel.set_title(f'{name}: {each.nodes[-1]} nodes after {len(each.nodes)} passes',
                        fontsize=11, color=INK)
        panel.set_aspect('equal')
        panel.set_xlabel('[m]')
    for panel, name, label in ((axes[0, 1], 'nodes', 'hidden nodes in the graph'),
                               (axes[1, 1], 'mean_ms', 'mean time of a step [ms]')):
        for each, colour, text in ((whole, VERMILION, 'whole'), (record, BLUE, 'thinned')):
            values = getattr(each, name)
            panel.plot(np.arange(1, len(values) + 1), values, color=colour, label=text)
        panel.set_yscale('log')
        panel.set_xlabel('passes')
        panel.set_title(label, fontsize=11, color=INK)
        panel.legend(frameon=False)
        panel.spines[['top', 'right']].set_visible(False)
        panel.tick_params(colors=GREY)
    figure.savefig(file)


def _walls():  # type: ignore[no-untyped-def]
    from matplotlib.patches import Rectangle  # noqa: PLC0415

    return Rectangle((0.0, 0.0), LENGTH, WIDTH, fill=False, edgecolor=INK, linewidth=1.5)
