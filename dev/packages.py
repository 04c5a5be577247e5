#!/usr/bin/env python3
# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Draw the packages and their imports, from the code, as a Mermaid flowchart.

    python dev/packages.py [folder of pose_graph_ros]

An arrow leads from the imported package to the one that imports it; its number is how many modules
do. Packages are the folders of `core` and the other folders; a module directly in one is its own
box.
"""

import ast
from collections import Counter
from pathlib import Path
import sys

DEFAULT = Path(__file__).resolve().parents[1] / 'pose_graph_ros'


def box_of(parts: tuple[str, ...]) -> str:
    """Return the box of a module or a name in it, given the parts of its dotted name."""
    return '.'.join(parts[:2]) if parts[0] == 'core' else parts[0]


def main(folder: Path) -> None:
    """Print the flowchart."""
    arrows: Counter[tuple[str, str]] = Counter()
    lines: Counter[str] = Counter()
    for path in sorted(folder.rglob('*.py')):
        text = path.read_text(encoding='utf-8')
        own = box_of(path.relative_to(folder).with_suffix('').parts)
        lines[own] += len(text.splitlines())
        imported = {
            box_of((*node.module.split('.')[1:], alias.name))
            for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)
            and (node.module or '').startswith(f'{folder.name}.') for alias in node.names}
        arrows.update((other, own) for other in imported - {own})
    print('flowchart LR')
    for name, count in sorted(lines.items()):
        if not name.endswith('__init__'):
            print(f'    {name}["{name}: {count} lines"]')
    for (imported_box, importer), count in sorted(arrows.items()):
        print(f'    {imported_box} -->|{count}| {importer}')


if __name__ == '__main__':
    main(Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else DEFAULT)
