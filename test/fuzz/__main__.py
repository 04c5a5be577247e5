# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Try inputs that nobody thought of, on each target for some time, and on the state machine.

    make fuzz                                             # all, for ten minutes each
    make fuzz FUZZ_SECONDS=60 FUZZ_ARGS='graph_text'      # one of them, for one

Atheris chooses them by what of our code, of rosbags and of PyYAML they make run. Finds are kept in
`test/fuzz/corpus`, one for each place that raises: mend them, and commit them with that. The state
machine is hypothesis's, with other seeds each time. The exit code is 1 if anything was found.
"""

import argparse
import hashlib
import logging
from pathlib import Path
import re
import subprocess
import sys
import tempfile
import time
import traceback

import pose_graph_ros

HERE = Path(__file__).resolve().parent
sys.path[1:1] = [str(HERE), str(HERE.parent / 'helpers')]
MACHINE = 'histories'
# What atheris instruments, and of the engine only what reads: what Numba compiles must stay as it
# is.
INSTRUMENTED = 'pose_graph_ros', 'rosbags', 'yaml', 'ruamel'
READING = re.compile(r'core/(io/.*|saved_columns|parts|recovery|sources/(validation|kinds))\.py')
LONGEST = 20  # that an input may take [s]: four times what it may without instruments
MEMORY = 1500  # that a process may take [MB]
LARGEST = 20_000  # input [bytes]


def fuzz(name: str, folders: list[str], seconds: int) -> None:
    """Run a target in this process, which this ends."""
    import atheris  # noqa: PLC0415  (only `make fuzz` installs it)

    package = Path(pose_graph_ros.__file__).parent
    others = [path.relative_to(package.parent).with_suffix('').as_posix().replace('/', '.')
              for path in package.rglob('core/**/*.py')
              if READING.fullmatch(path.relative_to(package).as_posix()) is None]
    others += ['yaml.scanner']  # looks back at each of a thousand brackets, too slow with more
    with atheris.instrument_imports(INSTRUMENTED, [each.removesuffix(
            '.__init__') for each in others]):
        import fuzz_targets  # noqa: PLC0415
    logging.disable()
    places = set[tuple[str, int | None]]()

    def once(data: bytes) -> None:
        try:
            fuzz_targets.run_target(name, data)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            if (place.filename, place.lineno) not in places:
                places.add((place.filename, place.lineno))
                path = HERE / 'corpus' / name / f'find-{hashlib.sha256(data).hexdigest()[:12]}'
                path.write_bytes(data)
                print(f'FIND {path}: {type(error).__name__}: {" ".join(str(error).split())[:200]}',
                      f'({place.filename}:{place.lineno})', flush=True)

    for seed in sorted((HERE / 'corpus' / name).iterdir()):     # the first use loads much
        once(seed.read_bytes())
    atheris.Setup(
        [sys.argv[0], *folders, f'-max_total_time={seconds}', f'-timeout={LONGEST}',
         f'-rss_limit_mb={MEMORY}', f'-max_len={LARGEST}', '-print_final_stats=1',
         f'-artifact_prefix={HERE / "corpus" / name}/'],
        once)
    atheris.Fuzz()


def tried(name: str, seconds: int, log: Path) -> bool:
    """Run a target in a process of its own, and print what came of it; return whether it held."""
    seeds = HERE / 'corpus' / name
    seeds.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as found, log.open('w+', encoding='utf-8') as out:
        code = subprocess.run(
            [sys.executable, str(HERE), name, '--inside', found, '--seconds', str(seconds)],
            stdout=out, stderr=subprocess.STDOUT, check=False).returncode
    text = log.read_text('utf-8', errors='replace')
    runs = re.findall(r'stat::number_of_executed_units: (\d+)', text) or re.findall(
        r'^#(\d+)', text, re.MULTILINE) or ['0']
    covered = re.findall(r'cov: (\d+)', text) or ['0']
    finds = re.findall(r'^FIND (.*)', text, re.MULTILINE) + re.findall(
        r'Test unit written to (\S+)', text)    # too slow, too much memory, or the process ended
    print(f'{name}: {runs[-1]} executions, {covered[-1]} places covered, {len(finds)} finds',
          *finds, sep='\n    ', flush=True)
    if code != 0 and len(finds) == 0:
        print(f'    ended with code {code}: {log}')
    return code == 0 and len(finds) == 0


def tried_histories(seconds: int) -> bool:
    """Run the state machine, and print what came of it; return whether it held."""
    from backend_machine import long_run  # noqa: PLC0415

    number, failure = long_run(seconds)
    print(f'{MACHINE}: {number} histories, {failure is not None:d} finds', flush=True)
    if failure is not None:
        print(failure)
    return failure is None


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        prog='fuzz', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('names', nargs='*', metavar='TARGET', help='these; all by default')
    parser.add_argument('--seconds', type=int, default=600, help='for each target')
    parser.add_argument('--inside', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.inside is not None:
        (name,) = options.names
        fuzz(name, [options.inside, str(HERE / 'corpus' / name)], options.seconds)
    from fuzz_targets import TARGETS  # noqa: PLC0415

    names = options.names or [*TARGETS, MACHINE]
    if unknown := sorted({*names} - {*TARGETS, MACHINE}):
        parser.error(f'no target {", ".join(unknown)}; there are {", ".join(TARGETS)}, {MACHINE}')
    logs, begin = Path(tempfile.mkdtemp(prefix='fuzz_logs_')), time.monotonic()
    held = [tried_histories(options.seconds) if name == MACHINE else
            tried(name, options.seconds, logs / f'{name}.txt') for name in names]
    print(f'{len(held)} targets, {held.count(False)} with finds, in '
          f'{time.monotonic() - begin:.0f} s; logs in {logs}')
    return 0 if all(held) else 1


if __name__ == '__main__':
    sys.exit(main())
