# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Settings of the property tests: the same examples in every run, no clock."""

from hypothesis import settings

settings.register_profile('core', deadline=None, derandomize=True)
settings.load_profile('core')
