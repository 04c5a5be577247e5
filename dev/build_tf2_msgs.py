#!/usr/bin/env python3
# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Build dev/tf2_msgs into the virtual environment whose Python runs this file.

The environment holds the ROS 2 wheels together with their message generators; g++, cmake and make
(or ninja) come from the system. dev/setup.sh calls this; the output is meant for its log.
"""

import os
from pathlib import Path
import re
import subprocess
import sys
import sysconfig
import tempfile

PREFIX = Path(sys.prefix)
SOURCE = Path(__file__).resolve().parent / 'tf2_msgs'

# The message wheels export the include folders of the image that they were built in.
BUILD_IMAGE = re.compile(
    r'/opt/python/cp\d+-cp\d+/(include/python3\.\d+|lib/python3\.\d+/site-packages)')


def point_exports_here() -> None:
    """Replace the build image's folders in the wheels' cmake files by those of this Python."""
    include, packages = (sysconfig.get_path(key) for key in ('include', 'purelib'))
    for path in PREFIX.glob('share/*/cmake/*.cmake'):
        text = path.read_text(encoding='utf-8')
        fixed = BUILD_IMAGE.sub(
            lambda match: include if match[1].startswith('include') else packages, text)
        if fixed != text:
            # a new file: the old one may be a hard link into the cache of uv
            path.unlink()
            path.write_text(fixed, encoding='utf-8')


def build_environment() -> dict[str, str]:
    """Return the environment for cmake: the generators are found, system tools run as usual."""
    wheels_only = {'LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE'}
    inherited = {key: value for key, value in os.environ.items() if key not in wheels_only}
    path = os.pathsep.join((str(PREFIX / 'bin'), inherited.get('PATH', os.defpath)))
    return {**inherited, 'AMENT_PREFIX_PATH': str(PREFIX), 'PATH': path}


def main() -> int:
    """Configure, build and install; return the status of the first command that fails."""
    point_exports_here()
    with tempfile.TemporaryDirectory(prefix='tf2_msgs_') as folder:
        commands = (
            ['cmake', '-S', str(SOURCE), '-B', folder, f'-DCMAKE_INSTALL_PREFIX={PREFIX}',
             f'-DCMAKE_PREFIX_PATH={PREFIX}', f'-DPython3_EXECUTABLE={sys.executable}',
             '-DPython3_FIND_VIRTUALENV=ONLY', '-DBUILD_TESTING=OFF',
             '-DCMAKE_BUILD_TYPE=Release'],
            ['cmake', '--build', folder, '--parallel', str(os.cpu_count() or 1)],
            ['cmake', '--install', folder],
        )
        for command in commands:
            status = subprocess.run(command, env=build_environment(), check=False).returncode
            if status != 0:
                return status
    return 0


if __name__ == '__main__':
    sys.exit(main())
