# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What run.json is made from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pose_graph_ros.adapters.sources import Kind
from pose_graph_ros.cli.evaluation import Drive, ErrorRow
from pose_graph_ros.cli.run.recorder import Recorder
from pose_graph_ros.core.backend import PoseGraphBackend
from pose_graph_ros.core.estimate import Estimate, UpdateReport
from pose_graph_ros.core.geometry.geodesy import MapOrigin
from pose_graph_ros.core.judgement.texts import Key
from pose_graph_ros.core.judgement.verdicts import Verdict


@dataclass(slots=True)
class Run:
    """A run at its end."""

    title: str
    subtitle: str
    drive: Drive
    backend: PoseGraphBackend
    estimate: Estimate
    """With its path, which is that of `drive`."""
    verdicts: Sequence[Verdict]
    recorder: Recorder
    values: Mapping[str, Any]
    """All parameters of the node."""
    kinds: Mapping[str, Kind]
    """Kinds of the sources that have a topic."""
    counts: Mapping[tuple[str, str], int]
    """Messages by source and answer."""
    rows: Sequence[ErrorRow]
    """Table of errors."""
    report: UpdateReport | None = None
    """Of the final optimisation; None if it was made elsewhere."""
    origin: MapOrigin | None = None
    """Of the map on the Earth; None if it is unknown."""
    seconds: float | None = None
    """Time that the run took [s]."""
    refused: Mapping[Key, str] = field(default_factory=dict)
    """Why loop closures were refused."""
    errors: dict[str, Any] | None = None
    """Errors over time, as in run.json."""

    @property
    def start_ns(self) -> int:
        """Stamp of the first pose of the path [ns]."""
        return int(self.drive.corrected.stamps_ns[0])
