# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What only tools use, on top of the engine: certificates, tuning, simulation, drawing.

Arrays and graphs go in and come out, as in `core`. Nothing in `core`, `adapters` or `ros` imports
from here. Each package says in its `__init__` what happens in it.
"""
