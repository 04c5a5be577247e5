# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What a worker is told. The caller loads no engine, which takes seconds."""

from typing import Any, NamedTuple

from pose_graph_ros.cli.fleet.recordings import Recording


class Task(NamedTuple):
    """What a worker is told."""

    out: str  # folder of the results
    run: str  # name of the call, for what is not finished
    settings: str  # their id
    recording: Recording


def do(task: Task) -> dict[str, Any]:
    """Return the row of a drive, with its `content`."""
    from pose_graph_ros.cli.fleet.worker import result_of  # noqa: PLC0415

    return result_of(task)
