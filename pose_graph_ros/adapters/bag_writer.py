# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Write rosbag2 folders in the format of ROS 2 Jazzy, without a ROS installation."""

from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from pathlib import Path
import shutil
import tempfile
from typing import Any, Final, Self

from rosbags import interfaces
from rosbags.interfaces import Connection, ConnectionExtRosbag1, Qos, QosDurability
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

from pose_graph_ros.adapters import bags, damaged_bags
from pose_graph_ros.adapters.bags import BagError, BagMessage

BAG_VERSION: Final = 9  # of the metadata of ROS 2 Jazzy
# the "infinite" duration of rmw, 2^63 - 1 ns
FOREVER = interfaces.QosTime(9223372036, 854775807)
Convert = Callable[[bytes], bytes | memoryview]
"""From a message of ROS 1 to CDR."""


class BagWriter:
    """
    A new rosbag2 folder in mcap, a context manager.

    The bag is moved to its name when the context ends. If the context ends with an exception, no
    bag is written, and a bag that was to be overwritten is kept; what is no rosbag2 folder is
    never replaced. Publishers of latched topics, and of /tf_static, keep their last message for
    late subscribers.
    """

    def __init__(self, folder: str | Path, *, overwrite: bool = False,
                 latched: Collection[str] = ()) -> None:
        self.folder = Path(folder).resolve()
        if self.folder.exists() and not overwrite:
            raise BagError(f'{folder}: exists already, not overwritten')
        if self.folder.exists():
            metadata, suffixes = self.folder / 'metadata.yaml', (*bags.BAG_FILE_SUFFIXES, '.zstd')
            if not metadata.is_file() or (
                    b'rosbag2_bagfile_information' not in metadata.read_bytes()) or not all(
                        each == metadata or (each.is_file() and each.suffix in suffixes)
                        for each in self.folder.iterdir()):
                raise BagError(
                    f'{folder}: is no rosbag2 folder or holds other files, not overwritten')
        self._latched = {'/tf_static', *latched}
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[tuple[str, str], Connection] = {}
        # by type, of ROS 1: name and types in ROS 2, and how its messages are converted
        self._converters: dict[str, tuple[str, Typestore, Convert]] = {}
        # under its final name in a scratch folder: rosbags names the files after their folder
        try:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            self._scratch = Path(tempfile.mkdtemp(
                prefix=f'.{self.folder.name}-', dir=self.folder.parent))
        except OSError as error:
            raise BagError(f'{folder}: cannot be written: {bags.one_line(error)}') from error
        self._writer = Writer(self._scratch / self.folder.name, version=BAG_VERSION,
                              storage_plugin=StoragePlugin.MCAP)
        self._writer.open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exception: object) -> None:
        try:
            if kind is not None:
                self._writer.abort()
                return
            self._writer.close()
            if self.folder.exists():
                self.folder.rename(self._scratch / f'{self.folder.name}.replaced')
            self._writer.path.rename(self.folder)
        finally:
            shutil.rmtree(self._scratch)

    def write(self, topic: str, type_name: str, recorded_ns: int, message: Any) -> None:
        """Append a message of a type of ROS 2 Jazzy: CDR bytes, or an object with its fields."""
        key = topic, type_name
        if key not in self._connections:
            if type_name not in self._types.fielddefs:
                raise BagError(
                    f'{self.folder}: {topic}: type {type_name} is unknown to ROS 2 Jazzy')
            self._connect(key, self._types, _qos(latched=topic in self._latched))
        if not isinstance(message, bytes):
            try:
                message = self._types.serialize_cdr(message, type_name)
            except Exception as error:  # generated code on a foreign object
                raise BagError(f'{self.folder}: {topic}: no valid {type_name}: '
                               f'{bags.one_line(error)}') from error
        self._writer.write(self._connections[key], recorded_ns, message)

    def copy(self, message: BagMessage) -> None:
        """
        Append a message of another bag as it is, or converted if that is of ROS 1.

        Its type may be any that its bag defines. Raises `MessageError` if it cannot be converted.
        """
        source, data, type_name = message.connection, message.raw, message.type
        if isinstance(source.ext, ConnectionExtRosbag1):
            if type_name not in self._converters:
                self._converters[type_name] = _from_ros1(source, self._types)
            type_name, types, convert = self._converters[type_name]
            data = bytes(replace(message, _decode=convert).decode())
        key = message.topic, type_name
        if key not in self._connections:
            if isinstance(source.ext, ConnectionExtRosbag1):
                self._connect(key, types, _qos(
                    latched=message.topic in self._latched or bool(source.ext.latching)))
            else:
                self._connect(key, bags.own_types(source) or self._types,
                              *source.ext.offered_qos_profiles, digest=source.digest)
        self._writer.write(self._connections[key], message.recorded_ns, data)

    def _connect(self, key: tuple[str, str], types: Typestore, *qos: Qos,
                 digest: str = '') -> None:
        known = key[1] in types.fielddefs
        # without a definition the type is left to the reader, as rosbag2 itself does
        self._connections[key] = self._writer.add_connection(
            *key, typestore=types if known else None, msgdef=None if known else '',
            rihs01=None if known else digest or damaged_bags.NO_HASH, offered_qos_profiles=qos)


def _qos(*, latched: bool) -> Qos:
    return Qos(interfaces.QosHistory.KEEP_LAST, 1 if latched else 10,
               interfaces.QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL if latched else
               QosDurability.VOLATILE, FOREVER, FOREVER, interfaces.QosLiveliness.AUTOMATIC,
               FOREVER, avoid_ros_namespace_conventions=False)


def _from_ros1(source: Connection, jazzy: Typestore) -> tuple[str, Typestore, Convert]:
    """
    Return the ROS 2 name of a type of a ROS 1 bag, its types, and what converts messages to CDR.

    A type that Jazzy does not have is that of the bag, with the header of ROS 2.
    """
    from rosbags.convert import converter  # noqa: PLC0415  (needed for few bags)

    own = bags.own_types(source) or get_typestore(Stores.ROS1_NOETIC)
    name, types = converter.STATIC_MSGTYPE_RENAMES.get(source.msgtype, source.msgtype), jazzy
    if name not in jazzy.fielddefs:
        types, header = get_typestore(Stores.EMPTY), 'std_msgs/msg/Header'
        types.register({**own.fielddefs, header: jazzy.fielddefs[header]})
    if converter.is_same_wireformat(own, types, source.msgtype, name):
        return name, types, partial(types.ros1_to_cdr, typename=name)
    return name, types, partial(
        converter.migrate_bytes, own, types, source.msgtype, name, {}, src_is2=False, dst_is2=True)


def message_types() -> dict[str, Any]:
    """Return the classes of the ROS 2 Jazzy messages by name of the type."""
    return dict(get_typestore(Stores.ROS2_JAZZY).types)
