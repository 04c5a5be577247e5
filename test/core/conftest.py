# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the tests: the same examples in every run, no clock, and tables that must grow."""

from hypothesis import settings

from pose_graph_ros.core.graph import tables

settings.register_profile('core', deadline=None, derandomize=True, max_examples=40)
settings.load_profile('core')

tables.FIRST_ROWS = 16  # type: ignore[misc]  # small graphs would never grow out of real ones
