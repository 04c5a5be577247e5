# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A saved graph as three files of plain text: `map.g2o`, `map.json` and `map.tum`.

`SavedGraph` is the whole state of an engine as a value. `core.parts` makes it from the parts of
the engine and restores them from it. Settings are not part of it: a loaded graph has those of the
engine that loads it.

The g2o file holds the hidden nodes, edges and observed nodes that other programs can read. The
JSON file holds the remaining state and the SHA-256 of the g2o file; its first member is the
SHA-256 of all that follows in it. Both are read back bit for bit, or refused. The TUM file holds
the path for other programs and is not read. See docs/design.md, "Saved graphs".
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
import hashlib
import io
import json
import os
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from pose_graph_ros import __version__
from pose_graph_ros.core import saved_columns as sc
from pose_graph_ros.core.alignment import AlignmentState, SavedAlignment
from pose_graph_ros.core.exceptions import FileFormatError, FileWriteError
from pose_graph_ros.core.geometry.geodesy import distances, MapOrigin, TangentPlane
from pose_graph_ros.core.geometry.se2 import FloatArray, wrap
from pose_graph_ros.core.geometry.trajectory import Trajectory
from pose_graph_ros.core.graph import constraints as ct
from pose_graph_ros.core.graph.graph import GraphRows
from pose_graph_ros.core.graph.reweighting import Reweighting
from pose_graph_ros.core.io.atomic_files import write_files
from pose_graph_ros.core.io.g2o import factors_of, g2o_text, NOT_USED, STANDING_FOR
from pose_graph_ros.core.io.g2o_text import GraphText, lines_of, MEASURED, TAGS
from pose_graph_ros.core.io.path_files import tum_text
from pose_graph_ros.core.judgement.judge import SavedJudgement
from pose_graph_ros.core.odometry.node_table import SavedNodes
from pose_graph_ros.core.sources.factor_builder import SourceState
from pose_graph_ros.core.sources.gyro import SavedGyro
from pose_graph_ros.core.sources.queued import Queued

FORMAT = 'pose_graph_ros graph'
VERSION = 8

SUFFIXES = ('.g2o', '.json', '.tum')
_OPENING, _MIDDLE = b'{\n"sha256": "', b'",\n'
_DIGITS = 64
# Tolerances within which a datum equals that of the saved graph [m], [rad].
SAME_PLACE = 0.01
SAME_YAW = 1e-6
# Maximum distance of a fix from the nearest node of a saved graph of the same site [m].
SAME_SITE = 10_000.0
IN_G2O = [kind for kind, factor in ct.FACTORS.items() if factor.tag == 'EDGE_SE2']


@dataclass(frozen=True, slots=True)
class SavedGraph:
    """The state of an engine; a copy that does not change with it."""

    rows: GraphRows
    nodes: SavedNodes
    sources: Mapping[str, SourceState]
    # stamps of the measurements of each source that were seen [ns], ascending, and references
    seen: Mapping[str, tuple[sc.Integers, sc.Integers]]
    losses: Reweighting
    alignment: SavedAlignment
    waiting: tuple[Queued, ...]  # constraints for the next update
    set_aside: tuple[Queued, ...]  # after a failed solve, for the next full optimisation
    judgement: SavedJudgement  # what is believed, and who has decided so
    # the same for people, of all closures and all that is not believed: a sentence by id
    verdicts: Mapping[str, str]
    newest_covariance: sc.Rows3  # of the newest hidden node, in map axes
    chi2: float
    n_left_out: int  # received measurements that are neither in the graph nor saved
    datum: MapOrigin | None  # of the map, if it has one
    gyros: Mapping[str, SavedGyro]
    beacons: Mapping[str, int]  # ids of their landmarks, by name

    @property
    def path(self) -> FloatArray:
        """Poses of all nodes that are no biases, those that have left included, shape (H, 3)."""
        return self.nodes.poses(self.rows.node_ids, self.rows.poses)


MEMBERS = [item.name for item in fields(SavedGraph) if item.name != 'rows']


@dataclass(frozen=True, slots=True)
class SavedRows:
    """The rows of a graph, as far as the g2o file lacks them."""

    # with the values of the nodes that are no poses, and without the factors in the g2o file
    rows: GraphRows
    # rows of the factors that are given here; edges of `IN_G2O` without a third node, and observed
    # nodes on no bias, are in the g2o file
    others: sc.Integers
    factor_kind: sc.Integers  # of all factors
    factor_weight: sc.Numbers


def graph_paths(path: Path) -> tuple[Path, Path, Path]:
    """Return the g2o, JSON and TUM files of a graph, given with or without one of the suffixes."""
    name = path.name.removesuffix(path.suffix) if path.suffix in SUFFIXES else path.name
    g2o, side, tum = (path.with_name(name + suffix) for suffix in SUFFIXES)
    return g2o, side, tum


def write_graph(saved: SavedGraph, path: Path) -> tuple[Path, Path, Path]:
    """
    Return the paths of the g2o, JSON and TUM file of a saved graph, written all or none.

    `path` is that of the g2o file, with or without suffix; the other files are beside it.
    Missing folders are created. If that fails, the path is a folder, or files are there that are
    not of a saved graph, a FileWriteError is raised, and previous files are unchanged.
    """
    if path.name == '' or os.path.isdir(path):
        raise FileWriteError(f'{path}: is a folder, expected the name of a file')
    paths = graph_paths(path)
    others = [str(each) for each in paths if os.path.lexists(each)]
    if len(others) > 0 and not _is_saved_graph(paths[1]):
        raise FileWriteError(f'{" and ".join(others)}: there already, and not of a saved graph, '
                             f'whose {paths[1].name} begins with its SHA-256: choose another name')
    g2o = g2o_text(saved.rows).encode('ascii')
    nodes = saved.nodes
    tum = tum_text(Trajectory(nodes.stamps_ns, saved.path)).encode('ascii')
    members = {
        'format': FORMAT, 'version': VERSION, 'created_by': f'pose_graph_ros {__version__}',
        'g2o_sha256': hashlib.sha256(g2o).hexdigest(),
        'graph': sc.encoded(_saved_rows(saved.rows)),
        **{name: sc.encoded(getattr(saved, name)) for name in MEMBERS}}
    body = (',\n'.join(_lines(members)) + '\n}\n').encode('ascii')
    side = _OPENING + hashlib.sha256(body).hexdigest().encode('ascii') + _MIDDLE + body
    g2o_path, side_path, tum_path = paths
    # the one that tells what the others are comes first
    write_files({side_path: side, g2o_path: g2o, tum_path: tum})
    return paths


def _is_saved_graph(path: Path) -> bool:
    """Tell whether a JSON file begins as that of a saved graph."""
    try:
        with path.open('rb') as file:
            begin = file.read(len(_OPENING) + _DIGITS + len(_MIDDLE))
    except OSError:
        return False
    return begin.startswith(_OPENING) and begin.endswith(_MIDDLE)


def read_graph(path: Path, folder: Path | None = None) -> SavedGraph:
    """
    Read a saved graph, given the path of its g2o file with or without suffix.

    If a folder is given, links that lead out of it are not followed.

    Raises FileFormatError if a file is missing, damaged, truncated, of another version or of
    another graph than the one beside it; the message names it, what was expected and found.
    """
    g2o_path, path, members, g2o = _verified(path, folder)
    try:
        hints = get_type_hints(SavedGraph, include_extras=True)
        rest = {name: sc.decoded(hints[name], members[name]) for name in MEMBERS}
        rows: SavedRows = sc.decoded(SavedRows, members['graph'])
        text = g2o.decode('ascii').partition(STANDING_FOR)[0].replace(NOT_USED, '')
        return SavedGraph(rows=_graph_rows(rows, lines_of(g2o_path, io.StringIO(text))), **rest)
    except sc.MISMATCHES as error:
        raise FileFormatError(f'{path}, with {g2o_path.name}: {error!r}') from error


def read_datum(path: Path, folder: Path | None = None) -> MapOrigin | None:
    """
    Return the datum of a saved graph after a check that its files are whole; None without one.

    It takes a third of the time of `read_graph`, and raises FileFormatError in the same cases,
    except for contents that are wrong although their checksum is right.
    """
    _, path, members, _ = _verified(path, folder)
    try:
        datum: MapOrigin | None = sc.decoded(MapOrigin | None, members['datum'])
        if datum is not None:
            TangentPlane(*datum)  # raises if it is no point on the Earth
    except sc.MISMATCHES as error:
        raise FileFormatError(f'{path}: expected a datum ({error})') from error
    return datum


def _verified(path: Path, folder: Path | None) -> tuple[Path, Path, dict[str, Any], bytes]:
    """Return paths of the g2o and the JSON file, members of the latter, content of the former."""
    if path.name == '':
        raise FileFormatError(f'{path}: expected the name of a file')
    g2o_path, path, _ = graph_paths(path)
    content = _content(path, folder)
    begin = len(_OPENING) + _DIGITS
    body = content[begin + len(_MIDDLE):]
    if not content.startswith(_OPENING) or content[begin:begin + len(_MIDDLE)] != _MIDDLE:
        raise FileFormatError(f'{path}: does not begin as a saved graph does, with its SHA-256')
    if hashlib.sha256(body).hexdigest().encode('ascii') != content[len(_OPENING):begin]:
        raise FileFormatError(f'{path}: is damaged, cut off or was edited: its SHA-256 is not '
                              'the one that it begins with')
    try:
        members = json.loads(b'{' + body)
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f'{path}: expected JSON ({error})') from error
    version = members.pop('version', None)
    if members.pop('format', None) != FORMAT or version != VERSION:
        raise FileFormatError(
            f'{path}: expected a {FORMAT} of version {VERSION}, created by pose_graph_ros; this '
            f'one is of version {version!r}, created by {members.get("created_by")!r}: make it '
            'anew from the bag')
    g2o = _content(g2o_path, folder)
    if hashlib.sha256(g2o).hexdigest() != members.pop('g2o_sha256', None):
        raise FileFormatError(
            f'{g2o_path}: is damaged, or not the file that {path} was written with')
    return g2o_path, path, members, g2o


def _lines(members: dict[str, Any], indent: str = '') -> Iterator[str]:
    """Yield the text of each member of an object, with one line for each nested member."""
    for name, value in members.items():
        if isinstance(value, dict) and len(value) > 0:
            inner = ',\n'.join(_lines(value, indent + '  '))
            yield f'{indent}{json.dumps(name)}: {{\n{inner}\n{indent}}}'
        else:
            text = json.dumps(value, separators=(',', ':'), allow_nan=False)
            yield f'{indent}{json.dumps(name)}: {text}'


def _content(path: Path, folder: Path | None) -> bytes:
    try:
        with path.open('rb') as file:
            # a link may have been put there after any check of the name
            real = Path(f'/proc/self/fd/{file.fileno()}').resolve()
            if folder is not None and not real.is_relative_to(folder):
                raise FileFormatError(f'{path}: leads out of {folder}')
            return file.read()
    except (OSError, ValueError) as error:
        raise FileFormatError(f'{path}: cannot be read ({error})') from error


def _saved_rows(rows: GraphRows) -> SavedRows:
    factors = rows.factors
    in_json = np.flatnonzero(np.where(
        factors.j < 0, np.isin(factors.i, rows.node_ids[rows.is_bias]),
        ~np.isin(factors.kind, IN_G2O) | (factors.k >= 0)))
    return SavedRows(
        rows._replace(poses=rows.poses[~rows.is_pose], factors=factors.rows(in_json)), in_json,
        factors.kind, factors.weight)


def _graph_rows(saved: SavedRows, text: GraphText) -> GraphRows:
    """Return the rows of a graph from both files."""
    rows, is_pose = saved.rows, saved.rows.is_pose
    poses = np.zeros((len(is_pose), 3))
    poses[is_pose], poses[~is_pose] = text.rows['VERTEX_SE2']['numbers'], rows.poses
    # others are in the JSON file
    tags = [tag for tag in MEASURED if TAGS[tag].kind is None]
    in_g2o = ct.Factors.joined([factors_of(tag, text.rows[tag]) for tag in tags])
    # in which those of edges come first
    lines = np.concatenate([text.rows[tag]['line'] for tag in tags])
    table = ct.Factors.joined([in_g2o.rows(np.argsort(lines)), rows.factors])
    others = np.delete(np.arange(len(table)), saved.others)
    is_edge = np.isin(saved.factor_kind[others], IN_G2O)
    place = np.concatenate((others[is_edge], others[~is_edge], saved.others))
    return rows._replace(poses=poses, factors=table.rows(np.argsort(place)).replaced(
        kind=saved.factor_kind, weight=saved.factor_weight))


def site_refusal(saved: SavedGraph, datum: MapOrigin | None, fix: MapOrigin | None) -> str | None:
    """
    Return why a saved graph cannot belong to the site of the robot; None if it can.

    A datum that the user has set must equal that of the saved graph, except for the altitude. A
    fix, the one that the current datum comes from or any other, must be near the saved graph.
    """
    if saved.datum is None:
        return None
    if datum is not None and (refusal := datum_refusal(saved.datum, datum)) is not None:
        return refusal
    if fix is not None:
        # of the datum or the nearest node, whichever is nearer
        metres = float(distances(fix, saved.datum.latitude, saved.datum.longitude)[0])
        if saved.alignment.state == AlignmentState.ALIGNED.value:   # the nodes are in the map
            points = TangentPlane(*saved.datum).to_geodetic(saved.path[:, :2])
            metres = min(metres, float(np.min(distances(fix, points[:, 0], points[:, 1]))))
        if not metres <= SAME_SITE:
            return (f'the saved graph is of another site: its datum is {saved.datum}, the present '
                    f'one {fix}, which is {metres / 1000.0:.1f} km from the nearest node')
    return None


def datum_refusal(saved: MapOrigin, datum: MapOrigin) -> str | None:
    """Return why the datum of a saved graph is not the one that was set; None if it is."""
    metres = float(distances(saved, datum.latitude, datum.longitude)[0])
    turned = abs(wrap(datum.yaw - saved.yaw))
    if metres <= SAME_PLACE and turned <= SAME_YAW:
        return None
    return (f'the saved graph is of another site: its datum is {saved}, the present one {datum}; '
            f'they are {metres:.2f} m and {turned:.6f} rad apart')
