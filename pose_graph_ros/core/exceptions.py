# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The exceptions of the engine; all derive from `PoseGraphError`."""

# Reason of all that fails as another thread wants it to end.
INTERRUPTED = 'it took too long'


class PoseGraphError(Exception):
    """Base class of all exceptions of this package."""


class ConfigError(PoseGraphError, ValueError):
    """A setting has an invalid value."""


class NumbaVersionError(PoseGraphError, ImportError):
    """The installed version of Numba is not supported."""


class GraphUpdateError(PoseGraphError, ValueError):
    """A `GraphUpdate` is inconsistent with the graph, which is unchanged."""


class FileFormatError(PoseGraphError, ValueError):
    """A file cannot be read; the message names the file and, for text, the line."""


class LinearSolveError(PoseGraphError):
    """The linear system has no unique solution (H is singular or not positive definite)."""


class NothingToSaveError(PoseGraphError):
    """There is no graph to save, because it has no hidden node yet."""


class FileWriteError(PoseGraphError):
    """Files cannot be written; existing files are unchanged."""
