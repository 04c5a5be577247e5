#!/usr/bin/env python3
# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Resolve dev/requirements*.in into requirements.lock and requirements-test.lock (`make lock`).

The first has what runs the node, the second what tests and checks need beside it. Run this with
the oldest supported Python, 3.11: what is the newest for 3.11 also exists for 3.12. pip only
resolves here (--dry-run), nothing is installed.
"""

import json
from pathlib import Path
import re
import subprocess
import sys

ROOT = Path(__file__).resolve().parents[1]
RUN, TEST = (ROOT / 'dev' / f'{name}.in' for name in ('requirements', 'requirements-test'))

HEADER = """\
# {what}, pinned; valid for Python 3.11 and 3.12 on x86_64 Linux.
# Made by `make lock` from dev/{source}: edit that file, or raise a single pin here by hand.
# dev/setup.sh installs this file with --no-deps, so a name missing here is missing in .venv.
"""
OLDEST = (3, 11)


def normalised(name: str) -> str:
    """Return the name of a distribution as package indexes spell it."""
    return re.sub(r'[-_.]+', '-', name).lower()


def resolve(*sources: Path, constraints: Path | None = None) -> dict[str, str]:
    """Return name -> version of everything that source files ask for, directly or not."""
    command = [
        sys.executable, '-m', 'pip', 'install', '--dry-run', '--ignore-installed', '--quiet',
        '--report', '-', *(word for source in sources for word in ('-r', str(source)))]
    if constraints is not None:
        command += ['-c', str(constraints)]
    report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    found = (entry['metadata'] for entry in report['install'])
    return {normalised(entry['name']): entry['version'] for entry in found}


def lock_lines(source: Path, versions: dict[str, str]) -> list[str]:
    """Return a lock's lines: the groups of its source file, then what those groups pull in."""
    rest = dict(versions)
    lines = []
    groups = source.read_text().split('\n\n')[1:]       # the first block explains the file
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
        if len(names) > 0:
            lines += ['', f'# {title}', *(f'{name}=={rest[name]}' for name in sorted(names))]
    return lines


def write_lock(source: Path, what: str, versions: dict[str, str]) -> Path:
    """Write the lock of a source file, and return its path."""
    lock = ROOT / f'{source.stem}.lock'
    header = HEADER.format(what=what, source=source.name)
    lock.write_text('\n'.join([header, *lock_lines(source, versions)]) + '\n')
    print(f'lock: {len(versions)} pins in {lock.name}')
    return lock


def main() -> int:
    """Write the lock files."""
    if sys.version_info[:2] != OLDEST:
        print('lock: run this with Python 3.11, the oldest supported one', file=sys.stderr)
        return 1
    run = resolve(RUN)
    lock = write_lock(RUN, 'What runs the node in .venv', run)
    both = resolve(RUN, TEST, constraints=lock)
    write_lock(TEST, 'What tests and checks need in .venv beside requirements.lock',
               {name: version for name, version in both.items() if name not in run})
    return 0


if __name__ == '__main__':
    sys.exit(main())
