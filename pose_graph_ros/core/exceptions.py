# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The exceptions that `core` raises; all of them derive from `PoseGraphError`."""


class PoseGraphError(Exception):
    """Root of all exceptions of this package."""


class ConfigError(PoseGraphError, ValueError):
    """A setting has a value that it cannot take."""


class GraphUpdateError(PoseGraphError, ValueError):
    """A `GraphUpdate` does not fit the graph; the graph is unchanged."""


class FileFormatError(PoseGraphError, ValueError):
    """A file cannot be read; the message names the file and, where there is one, the line."""


class LinearSolveError(PoseGraphError):
    """The linear system has no unique solution (H is singular or not positive definite)."""


class NothingToSaveError(PoseGraphError):
    """There is no graph yet that could be saved."""


class FileWriteError(PoseGraphError):
    """Files cannot be written; what was there before is as it was."""
