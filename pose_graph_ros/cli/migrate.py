# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make a parameter file of those of robot_localization, fuse and slam_toolbox."""

import argparse
from pathlib import Path

from pose_graph_ros.cli.migration import inputs, text
from pose_graph_ros.cli.migration.engine import Migration
from pose_graph_ros.core.exceptions import ConfigError

UNNAMED = Path('pose_graph.yaml')  # what the launch call says where the file goes to the screen


def execute(options: argparse.Namespace) -> int:
    """Run the tool; return the exit code."""
    if options.out is not None and options.out.exists() and not options.force:
        raise ConfigError(f'{options.out}: exists already, not overwritten without --force')
    migration = Migration(inputs.read(options.files), replaces_local=options.replace_local)
    words = [str(each) for each in options.files]
    content = text.parameter_file(migration, options.out or UNNAMED, words)
    if options.out is None:
        print(content, end='')
        return 0
    options.out.write_text(content, encoding='utf-8')
    print('\n'.join(text.lists(migration, options.out)))
    print(f'\nwritten: {options.out}')
    return 0
