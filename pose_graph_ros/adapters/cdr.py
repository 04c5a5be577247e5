# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Write messages as the bytes of the middleware: plain CDR in little endian.

Large messages are made so, as objects for all their parts would take seconds.
"""

import struct

import numpy as np
import numpy.typing as npt

_LENGTH = struct.Struct('<I')


class CdrStream:
    """A stream of CDR: the position of each number is a multiple of its size."""

    def __init__(self) -> None:
        self._data = bytearray()

    def add(self, code: str, *numbers: npt.ArrayLike) -> None:
        """Add numbers, or an array, as a type of NumPy."""
        array = np.asarray(numbers, dtype=code)
        self._data += bytes(-len(self._data) % array.itemsize) + array.tobytes()

    def add_text(self, text: str) -> None:
        """Add a string."""
        name = text.encode() + b'\0'
        self._data += bytes(-len(self._data) % 4) + _LENGTH.pack(len(name)) + name

    def message(self) -> bytes:
        """Return the message, with the bytes that tell the encoding in front."""
        return b'\x00\x01\x00\x00' + bytes(self._data)
