#!/usr/bin/env python3
# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Resolve dev/requirements.in into requirements.lock (`make lock`).

Run it with the oldest supported Python, 3.11: what is the newest for 3.11 also exists for 3.12.
pip only resolves here (--dry-run), nothing is installed.
"""

import json
from pathlib import Path
import re
import subprocess
import sys

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / 'dev' / 'requirements.in'
LOCK = ROOT / 'requirements.lock'

HEADER = """\
# Everything in .venv, pinned; valid for Python 3.11 and 3.12 on x86_64 Linux.
# Made by `make lock` from dev/requirements.in: edit that file, or raise a single pin here by hand.
# dev/setup.sh installs this file with --no-deps, so a name missing here is missing in .venv.
"""
OLDEST = (3, 11)


def normalised(name: str) -> str:
    """Return the name of a distribution as package indexes spell it."""
    return re.sub(r'[-_.]+', '-', name).lower()


def resolve() -> dict[str, str]:
    """Return name -> version of everything that the source file asks for, directly or not."""
    command = [
        sys.executable, '-m', 'pip', 'install', '--dry-run', '--ignore-installed', '--quiet',
        '--report', '-', '-r', str(SOURCE),
    ]
    report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    found = (entry['metadata'] for entry in report['install'])
    return {normalised(entry['name']): entry['version'] for entry in found}


def lock_lines(versions: dict[str, str]) -> list[str]:
    """Return the lock's lines: the groups of the source file, then what those groups pull in."""
    rest = dict(versions)
    lines = []
    groups = SOURCE.read_text().split('\n\n')[1:]       # the first block explains the file
    for line in '\n\n'.join(['', *groups]).strip().splitlines():
        match = re.match(r'[A-Za-z0-9][\w.-]*', line)
        if match is None:
            lines.append(line)
        else:
            name = normalised(match.group())
            lines.append(f'{name}=={rest.pop(name)}')
    wheels = {name for name in rest if name.startswith('ros-')}
    for title, names in (
        ('Pulled in by the above: ROS', wheels),
        ('Pulled in by the above: other', rest.keys() - wheels),
    ):
        lines += ['', f'# {title}', *(f'{name}=={rest[name]}' for name in sorted(names))]
    return lines


def main() -> int:
    """Write the lock file."""
    if sys.version_info[:2] != OLDEST:
        print('lock: run this with Python 3.11, the oldest supported one', file=sys.stderr)
        return 1
    versions = resolve()
    LOCK.write_text(HEADER + '\n' + '\n'.join(lock_lines(versions)) + '\n')
    print(f'lock: {len(versions)} pins in {LOCK.name}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
