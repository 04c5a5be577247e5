# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Serialise the graph as a visualization_msgs/MarkerArray, directly from arrays.

One message object for every point would take seconds instead of milliseconds. The colour of a
constraint shows its error in sigmas: green up to 1, yellow at 2, red from 3. Dashed are loop
closures that are believed weakly (coloured), that wait (blue) or that are doubted (grey). Grey,
too, are measured positions that are not used. No rclpy.
"""

import numpy as np
import numpy.typing as npt

from pose_graph_ros.adapters.output_cdr import CdrStream
from pose_graph_ros.adapters.sources import NANOSECONDS
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.graph.graph_view import GraphView, Lines

# Constants of visualization_msgs/Marker.
LINE_LIST, POINTS, ADD, DELETEALL = 5, 8, 0, 3

# Colours (red, green, blue, alpha) of constraints at these errors [sigma]; interpolated between.
SIGMAS = (1.0, 2.0, 3.0)
COLOURS = ((0.15, 0.7, 0.3, 1.0), (0.95, 0.8, 0.1, 1.0), (0.9, 0.1, 0.1, 1.0))
NODE_COLOUR = (0.4, 0.6, 0.85, 1.0)  # colour of hidden nodes
WAITING_COLOUR, DOUBTED_COLOUR = (0.3, 0.5, 0.95, 0.9), (0.55, 0.55, 0.55, 0.8)
DASHES = 12  # of a dashed line; the gaps are as long
# Sizes of points, and widths of lines [m].
NODE_SIZE, OBSERVED_SIZE, EDGE_WIDTH, CLOSURE_WIDTH = 0.2, 0.25, 0.06, 0.1

NAMESPACES = (
    'hidden_nodes', 'odometry', 'loop_closures', 'observed_errors', 'observed_nodes',
    'weak_closures', 'waiting_closures', 'doubted', 'unused_errors', 'unused_nodes')
"""Namespaces of the markers by id."""

_Colours = npt.NDArray[np.float32]


def markers_cdr(view: GraphView, stamp_ns: int, frame_id: str) -> bytes:
    """
    Return the markers of a graph as a message in little-endian CDR.

    The first marker deletes all previous ones. Kinds without points have no marker, because
    viewers report empty markers as errors.

    Parameters
    ----------
    frame_id : str, frame of the map

    """
    plain = np.empty((0, 4), dtype='<f4')
    drawn = [
        (POINTS, NODE_SIZE, view.nodes, plain),
        (LINE_LIST, EDGE_WIDTH, *_lines(view.odometry)),
        (LINE_LIST, CLOSURE_WIDTH, *_lines(view.loop_closures)),
        (LINE_LIST, EDGE_WIDTH, *_lines(view.observed)),
        (POINTS, OBSERVED_SIZE, view.observed.ends[:, 1], colours(view.observed.sigmas)),
        (LINE_LIST, CLOSURE_WIDTH, *_lines(_dashed(view.weak))),
        (LINE_LIST, CLOSURE_WIDTH, *_plain(_dashed(view.waiting).ends, WAITING_COLOUR)),
        (LINE_LIST, CLOSURE_WIDTH, *_plain(_dashed(view.doubted).ends, DOUBTED_COLOUR)),
        (LINE_LIST, EDGE_WIDTH, *_plain(view.unused.ends, DOUBTED_COLOUR)),
        (POINTS, OBSERVED_SIZE, *_plain(view.unused.ends[:, 1], DOUBTED_COLOUR))]
    shown = [number for number, (_, _, points, _) in enumerate(drawn) if len(points) > 0]
    header = (*divmod(stamp_ns, NANOSECONDS), frame_id)
    stream = CdrStream()
    stream.add('<u4', 1 + len(shown))
    _add_marker(stream, header, '', (0, 0, DELETEALL), 0.0, np.empty((0, 2)), plain)
    for number in shown:
        kind, size, points, point_colours = drawn[number]
        _add_marker(
            stream, header, NAMESPACES[number], (number, kind, ADD), size, points, point_colours)
    return stream.message()


def colours(sigmas: FloatArray) -> _Colours:
    """Return the colours, shape (M, 4), of constraints with these errors, shape (M,) [sigma]."""
    return np.column_stack([
        np.interp(sigmas, SIGMAS, channel) for channel in zip(*COLOURS, strict=True)
    ]).astype(np.float32)


def _lines(lines: Lines) -> tuple[FloatArray, _Colours]:
    """Return the ends of lines as points, shape (2 M, 2), and their colours, shape (2 M, 4)."""
    return lines.ends.reshape(-1, 2), np.repeat(colours(lines.sigmas), 2, axis=0)


def _dashed(lines: Lines) -> Lines:
    """Return the dashes of lines as lines."""
    at = np.linspace(0.0, 1.0, 2 * DASHES)[:, None]
    begin, end = lines.ends[:, 0, None], lines.ends[:, 1, None]
    points = begin + at * (end - begin)
    return Lines(points.reshape(-1, 2, 2), np.repeat(lines.sigmas, DASHES))


def _plain(
    points: FloatArray, colour: tuple[float, float, float, float],
) -> tuple[FloatArray, _Colours]:
    """Return points, shape (..., 2), as one array, and the same colour for each of them."""
    points = points.reshape(-1, 2)
    return points, np.tile(np.array(colour, dtype=np.float32), (len(points), 1))


def _add_marker(  # noqa: PLR0917  fields of a marker
    stream: CdrStream, header: tuple[int, int, str], namespace: str, what: tuple[int, int, int],
    size: float, points: FloatArray, point_colours: _Colours,
) -> None:
    """Add a visualization_msgs/Marker field by field."""
    def add_header() -> None:
        stream.add('<i4', header[0])
        stream.add('<u4', header[1])
        stream.add_text(header[2])

    add_header()
    stream.add_text(namespace)
    stream.add('<i4', *what)
    stream.add('<f8', 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)    # pose
    stream.add('<f8', size, size, 0.0)                      # scale: lines use the first
    stream.add('<f4', *NODE_COLOUR)                         # of points without their own
    stream.add('<i4', 0, 0)                                 # lifetime: forever
    stream.add('u1', 0)                                     # frame_locked
    stream.add('<u4', len(points))
    if len(points) > 0:
        stream.add('<f8', np.pad(points, ((0, 0), (0, 1))))
    stream.add('<u4', len(point_colours))
    stream.add('<f4', point_colours)
    stream.add_text('')         # texture_resource
    add_header()                # texture
    stream.add_text('')
    stream.add('<u4', 0, 0)     # its data, and uv_coordinates
    for _ in range(3):
        stream.add_text('')     # text, mesh_resource and the name of mesh_file
    stream.add('<u4', 0)
    stream.add('u1', 0)         # mesh_use_embedded_materials
