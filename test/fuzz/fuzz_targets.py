# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What is fuzzed: all that reads files or messages of others, each by one function of bytes.

Whatever the bytes, only errors of this package may come of them, each with a message of one line.
"""

from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from copy import deepcopy
import hashlib
import json
from pathlib import Path
import sqlite3
import tempfile
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.typesys import get_typestore, Stores

from pose_graph_ros.adapters import bags, parameters, sources
from pose_graph_ros.adapters.bags import BagMessage, MessageError, open_bag
from pose_graph_ros.cli.shared import parameter_values
from pose_graph_ros.cli.truth import POSE_TYPES, read_truth
from pose_graph_ros.core import measurements as ms
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.config import BackendConfig
from pose_graph_ros.core.exceptions import PoseGraphError
from pose_graph_ros.core.io import g2o, graph_files
from pose_graph_ros.core.io.journal_file import Batch, Entry, JournalFile
from pose_graph_ros.core.io.path_files import read_path
from pose_graph_ros.core.recovery import recovered

Target = Callable[[bytes, Path], None]
CORPUS = Path(__file__).parent / 'corpus'
SECOND = 1_000_000_000
# Values of a JSON file that may stand where others are expected; `DROP` leaves the member out.
DROP = object()
ODD = (None, True, False, 0, -1, 1, 2**31, 2**62, 2**63, -2**63 - 1, 10**400, 0.5, -1e308, 1e308,
       float('nan'), float('inf'), '', 'x', 'n' * 3000, [], [[]], [0], [None], {}, {'x': 0}, DROP)
JAZZY = get_typestore(Stores.ROS2_JAZZY)
KINDS = sources.KINDS
# A source of each kind, two of those that are read in different ways.
VALUES = parameters.checked({
    'sources': [*KINDS, 'wheels', 'down', 'named'], **{f'{name}.type': name for name in KINDS},
    'wheels.type': 'odometry', 'wheels.integrate': 'twist', 'wheels.noise': 'twist',
    'down.type': 'gyro', 'down.mounting': 'down', 'named.type': 'range',
    'named.beacons': ['a 1.0 2.0']})
DEFAULTS = parameters.checked({})
SOURCES = {source.name: source for source in sources.source_list(VALUES)}


def drive() -> PoseGraphBackend:
    """Return a back end that has something of everything that is saved."""
    backend = PoseGraphBackend(sources.backend_config(VALUES))
    for k in range(80):
        stamp = (100 + k) * SECOND // 4
        pose = np.array((0.5 * k, np.sin(0.1 * k), 0.1 * np.cos(0.1 * k)))
        backend.add_odometry(ms.OdometrySample(stamp, pose), 'odometry')
        backend.add_measurement(ms.YawRate(stamp, 0.01, 1e-4), 'gyro')
        if k % 4 == 0:
            backend.add_measurement(ms.Position(
                stamp, pose[:2], np.eye(2) * 0.1, np.zeros(2)), 'fix')
            backend.add_measurement(ms.Range(
                stamp, 'a', float(np.hypot(*(pose[:2] - (20.0, 9.0)))), 0.01, np.zeros(2)),
                'range')
        if k % 20 == 19:
            backend.add_measurement(ms.GlobalPose(stamp, pose, np.eye(3) * 0.1), 'global_pose')
            backend.add_measurement(ms.LoopClosure(stamp, np.array((5.0, 0.0, 0.0)), np.diag((
                0.01, 0.01, 1e-3)), reference_ns=stamp - 5 * SECOND // 2), 'loop_closure')
            backend.update()
    backend.finish()
    backend.update()
    return backend


def graph_text(data: bytes, folder: Path) -> None:
    """A file of g2o, TORO or iSAM."""
    path = folder / 'graph.g2o'
    path.write_bytes(data)
    g2o.read_g2o(path).graph.rows()


def _read_saved(path: Path, body: bytes, text: bytes) -> None:
    """Read a saved graph with these contents and the right checksum, and go on from it."""
    path.write_bytes(b'{\n"sha256": "' + hashlib.sha256(body).hexdigest().encode() + b'",\n'
                     + body)
    path.with_suffix('.g2o').write_bytes(text)
    with suppress(PoseGraphError):
        graph_files.read_datum(path)
    backend = PoseGraphBackend.restored(BackendConfig(), graph_files.read_graph(path))
    backend.update()
    backend.estimate()


class Saved:
    """A saved graph as text and as JSON values."""

    def __init__(self) -> None:
        with tempfile.TemporaryDirectory() as name:
            paths = graph_files.write_graph(drive().saved(), Path(name, 'saved'))
            self.text, content, _ = (path.read_bytes() for path in paths)
        self.members = json.loads(content)
        del self.members['sha256']

    def edited(self, edits: bytes) -> bytes:
        """Return the JSON file after edits, each of a value by its number and an odd one's."""
        root = json.loads(json.dumps(self.members))
        for k in range(0, len(edits) - 2, 3):
            places = list(_places(root))
            if len(places) == 0:
                break
            owner, name = places[int.from_bytes(edits[k:k + 2], 'big') % len(places)]
            value = ODD[edits[k + 2] % len(ODD)]
            if value is DROP:
                del owner[name]
            else:
                owner[name] = deepcopy(value)   # later edits may be of what it has
        return json.dumps(root)[1:].encode()


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """
    Yield members of a tree, as what each belongs to and its name or number in it.

    Of a list these are the first two and the last.
    """
    names = [*tree] if isinstance(tree, dict) else sorted({0, 1, len(tree) - 1} & {
        *range(len(tree))})
    for name, inner in [(name, tree[name]) for name in names]:
        yield tree, name
        if isinstance(inner, dict | list):
            yield from _places(inner)


def saved_values(data: bytes, folder: Path) -> None:
    """A saved graph in which some values are others."""
    global _saved  # noqa: PLW0603
    _saved = _saved or Saved()
    body = _saved.edited(data)
    _read_saved(folder / 'saved.json', body, _saved.text)


_saved: Saved | None = None


def saved_text(data: bytes, folder: Path) -> None:
    """The two files of a saved graph, behind each other with a zero in between."""
    text, _, body = data.partition(b'\0')
    digest = hashlib.sha256(text).hexdigest().encode()
    _read_saved(folder / 'saved.json', body.replace(b'DIGEST', digest), text)


def journal_file(data: bytes, folder: Path) -> None:
    """The file of a journal, which is always read, as far as it is whole."""
    path = folder / 'state.db'
    path.write_bytes(data)
    _recover(path)


def journal_rows(data: bytes, folder: Path) -> None:
    """A journal whose log, and behind a zero its state, are these texts, with the right sums."""
    path = folder / 'state.db'
    file = JournalFile(path)
    file.write(Batch(entries=[Entry(0, 1, 'update', [])]))
    file.close()
    log, _, state = data.partition(b'\0')
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute('UPDATE log SET content = ?, digest = ?', (
            log, hashlib.sha256(log).digest()))
        if len(state) > 0:
            connection.execute('INSERT INTO state VALUES (1, ?, ?)', (
                hashlib.sha256(state).digest(), state))
    _recover(path)


def _recover(path: Path) -> None:
    file = JournalFile(path)
    found = file.read(lambda _: None)
    file.close()
    backend = recovered(BackendConfig(), found, lambda *_: np.zeros(2))
    backend.update()
    backend.estimate()


def _read_bag(path: Path) -> None:
    with open_bag(path) as bag:
        for message in bag.messages(list(bag.topics)):
            with suppress(MessageError):
                message.decode()
        reader = bags.reader_of(bag, DEFAULTS)
        inputs = bags.choose_inputs(bag, [*reader.sources.values()], {})
        for source, message, _ in bags.read_inputs(bag, inputs):
            with suppress(MessageError):
                answered(reader.read(source, message.decode()))
        for topic, info in bag.topics.items():
            if info.type in POSE_TYPES:
                read_truth(bag, topic)


def path_file(data: bytes, folder: Path) -> None:
    file = folder / ('path.csv' if b',' in data else 'path.tum')
    file.write_bytes(data)
    read_path(file)


def bag_mcap(data: bytes, folder: Path) -> None:
    (folder / 'bag.mcap').write_bytes(data)
    _read_bag(folder / 'bag.mcap')


def bag_sqlite(data: bytes, folder: Path) -> None:
    (folder / 'bag.db3').write_bytes(data)
    _read_bag(folder / 'bag.db3')


def bag_ros1(data: bytes, folder: Path) -> None:
    (folder / 'old.bag').write_bytes(data)
    _read_bag(folder / 'old.bag')


def bag_folder(data: bytes, folder: Path) -> None:
    """The metadata beside a good file."""
    (folder / 'bag_0.mcap').write_bytes((CORPUS / 'bag_mcap' / 'good').read_bytes())
    (folder / 'metadata.yaml').write_bytes(data)
    _read_bag(folder)


def parameter_file(data: bytes, folder: Path) -> None:
    path = folder / 'parameters.yaml'
    path.write_bytes(data)
    list(parameters.without_effect(('--params-file', str(path)), '/pose_graph'))
    values = parameters.checked_together(
        parameter_values(Namespace(params_file=path, param=[])))
    sources.MessageReader(values)


def parameter_options(data: bytes, _folder: Path) -> None:
    """Options `--param`, one a line."""
    lines = data.decode(errors='replace').splitlines()
    parameters.checked_together(parameter_values(Namespace(params_file=None, param=lines)))


def answered(answer: Any) -> Any:
    """Return an answer or a measurement; an answer has one line."""
    assert not isinstance(answer, ms.Answer) or '\n' not in answer.detail, answer
    return answer


def _use(name: str, message: Any) -> None:
    """Convert a message, and give what it is to the engine."""
    reader = sources.MessageReader(VALUES)
    measured = answered(reader.read(name, message))
    backend = PoseGraphBackend(sources.backend_config(VALUES))
    for k in range(3):
        backend.add_odometry(ms.OdometrySample(
            (k + 1) * SECOND, np.array((2.0 * k, 0.0, 0.0))), 'odometry')
    if isinstance(measured, ms.OdometrySample):
        backend.add_odometry(measured, name)
    elif not isinstance(measured, ms.Answer):
        backend.add_measurement(measured, name)
    backend.finish()


def message_bytes(data: bytes, _folder: Path) -> None:
    """A message in CDR of the source with the number in the first byte."""
    name = [*SOURCES][data[0] % len(SOURCES)] if len(data) > 0 else 'odometry'
    kind = SOURCES[name].kind.message_type
    message = BagMessage('/topic', kind, 0, data[1:], None, lambda raw: (
        JAZZY.deserialize_cdr(raw, kind)))  # type: ignore[arg-type]
    _use(name, message.decode())


def transforms(data: bytes, _folder: Path) -> None:
    """A message of static transforms in CDR, by which another one is read."""
    message = BagMessage('/tf_static', 'tf2_msgs/msg/TFMessage', 0, data, None, lambda raw: (
        JAZZY.deserialize_cdr(raw, 'tf2_msgs/msg/TFMessage')))  # type: ignore[arg-type]
    reader = sources.MessageReader(VALUES)
    reader.frames.receive(message.decode())
    reader.frames.transform('a', 'base_link')


ODD_FIELDS = (float('nan'), float('inf'), -1e308, 1e308, 5e-324, 0, -1, 2**31, 2**63, 10**400, '',
              '/', 'x' * 3000, 'x42', '@1.5', '@1.', 'tag/a', b'', None, [], [0.0], (),
              np.zeros(0), np.full(36, np.nan), np.full(36, 1e308), np.zeros(9), True, {},
              SimpleNamespace())


def message_fields(data: bytes, _folder: Path) -> None:
    """
    A message with odd fields, as one of a bag may be that has a definition of its own.

    Behind the number of the source come edits, each of a field by its number and an odd value's.
    """
    name = [*SOURCES][data[0] % len(SOURCES)] if len(data) > 0 else 'odometry'
    message = _plain(SOURCES[name].kind.message_type)
    for k in range(1, len(data) - 1, 2):
        fields = list(_fields(message))
        owner, field = fields[data[k] % len(fields)]
        setattr(owner, field, ODD_FIELDS[data[k + 1] % len(ODD_FIELDS)])
    _use(name, message)


def _plain(kind: str) -> SimpleNamespace:
    """Return a message of a type with zeros, at 2.5 s."""
    message = SimpleNamespace()
    for name, (form, detail) in JAZZY.get_msgdef(kind).fields:
        base = detail[0] if isinstance(detail, tuple) and form.name == 'BASE' else ''
        setattr(message, name, _plain(detail) if form.name == 'NAME' else (
            np.zeros(detail[1] if isinstance(detail, tuple) else 0) if form.name == 'ARRAY' else (
                '' if base == 'string' else 0.5 if base.startswith('float') else 0)))
    if kind == 'builtin_interfaces/msg/Time':
        message.sec, message.nanosec = 2, 500_000_000
    return message


def _fields(message: SimpleNamespace) -> Iterator[tuple[SimpleNamespace, str]]:
    for name, value in vars(message).items():
        yield message, name
        if isinstance(value, SimpleNamespace):
            yield from _fields(value)


TARGETS: dict[str, Target] = {target.__name__: target for target in (
    graph_text, saved_text, saved_values, path_file, bag_mcap, bag_sqlite, bag_ros1, bag_folder,
    journal_file, journal_rows, parameter_file, parameter_options, message_bytes, message_fields,
    transforms)}


def run_target(name: str, data: bytes) -> None:
    """Give bytes to a target; raises what must not come of them."""
    memory = Path('/dev/shm')
    with tempfile.TemporaryDirectory(
            prefix='fuzz_', dir=memory if memory.is_dir() else None) as folder:
        try:
            TARGETS[name](data, Path(folder))
        except PoseGraphError as error:
            assert '\n' not in str(error), f'not one line: {error}'  # noqa: PT017
