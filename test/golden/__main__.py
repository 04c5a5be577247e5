# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Make the golden files anew, or compare with them.

    make golden                                                # makes all that are out of date
    make golden GOLDEN_ARGS='--check --exact'                  # after moves and renames: all bits
    make golden GOLDEN_ARGS='--check --tolerance 1e-9'         # after a change of the arithmetic
    make golden GOLDEN_ARGS='--check window thinning'          # some of them

The exit code is 1 where something differs. The tests compare with a tolerance that other
processors keep, and leave out the large ones. Cases that need public data are left out where
these are not there.
"""

import argparse
from pathlib import Path
import sys
import tempfile
import time

import pose_graph_ros  # noqa: F401  before NumPy, whose threads it limits

sys.path.insert(1, str(Path(__file__).resolve().parents[1] / 'helpers'))

from golden_cases import CASES, is_large, needs
from golden_runner import compared, FILES, PORTABLE, Runner, text_of
from public_data import missing

SHOWN = 6


def run(options: argparse.Namespace) -> int:
    """Run the cases, and return the exit code."""
    names, differing, total = options.names or list(CASES), 0, 0.0
    FILES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        runner = Runner(Path(folder))
        for name in names:
            if missing(*needs(name)):
                print(f'{name}: left out, {missing(*needs(name))}')
                continue
            begin = time.process_time()
            record = runner.run(name)
            seconds = time.process_time() - begin
            total += 0.0 if is_large(name) else seconds
            found = compared(name, record, options.tolerance, exact=options.exact)
            if not options.check:
                found = compared(name, record, 0.0, exact=True)
                (FILES / f'{name}.json').write_text(text_of(record), encoding='utf-8')
            differing += len(found) > 0
            print(f'{name}: {"same" if len(found) == 0 else f"{len(found)} differ"}, '
                  f'{seconds:.1f} s', flush=True)
            for line in found if options.all else found[:SHOWN]:
                print(f'    {line}')
    for file in sorted(FILES.glob('*.json')) if len(options.names) == 0 else ():
        if file.stem not in CASES:
            print(f'{file.name}: no such case' + ('' if options.check else ', removed'))
            differing += 1
            if not options.check:
                file.unlink()
    print(f'{len(names)} cases, {differing} '
          + ('differ' if options.check else 'of their files are new or other')
          + f'; those of the tests took {total:.0f} s')
    return 1 if options.check and differing > 0 else 0


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        prog='golden', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('names', nargs='*', choices=[[], *CASES], default=[], metavar='CASE',
                        help='run these, in this order; all by default')
    parser.add_argument('--check', action='store_true', help='compare, and write nothing')
    parser.add_argument('--exact', action='store_true', help='compare the hashes, too')
    parser.add_argument('--tolerance', type=float, default=PORTABLE, metavar='T',
                        help='what figures may differ by, relatively or [m, rad] '
                             '(default: %(default)s)')
    parser.add_argument('--all', action='store_true', help='show all differences')
    return run(parser.parse_args())


if __name__ == '__main__':
    sys.exit(main())
