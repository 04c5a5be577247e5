# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Offline tools around the engine, behind the command `pose-graph`; none of them imports rclpy.

Bags, g2o files and command line options come in. Corrected paths, pictures, tables of errors,
graphs and simulated bags go out. Read first `main`, which lists the tools, then `replay`, which
runs a bag through the engine.
"""

import math
from typing import Any


def finite(value: Any) -> Any:
    """Return values for JSON, which has no infinity: None in its place."""
    if isinstance(value, dict):
        return {key: finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
