# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whatever comes and is done, in whatever order; `make fuzz` runs it for longer."""

from backend_machine import Histories, SHORT

TestHistories = Histories.TestCase
TestHistories.settings = SHORT
