# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Print the parameters of the node, as tables for docs/parameters.md or as a parameter file."""

import argparse

from pose_graph_ros.adapters.parameters import as_markdown, as_yaml


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    print(as_yaml() if options.yaml else as_markdown(), end='')
    return 0
