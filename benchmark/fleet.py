# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
What `pose-graph fleet` costs beside the replays themselves; the figures of docs/fleet.md.

    .venv/bin/python -m benchmark.fleet [--bags 200] [--seconds 120]

A scheduler of its own is given tasks, to see what it holds in memory of each; and rows are added
as a call holds them. Then simulated drives are replayed with one and with two processes, and with
one worker while this process replays the same, and writes the same files but for the reports.
"""

import argparse
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import redirect_stdout
import io
import json
from pathlib import Path
import secrets
import subprocess
import sys
import tempfile
import time
from typing import Any

from distributed import Client
import psutil

from benchmark.parts import resident_bytes
from pose_graph_ros.cli.fleet import table
from pose_graph_ros.cli.fleet.call import Results
from pose_graph_ros.cli.fleet.recordings import find_recordings, Recording
from pose_graph_ros.cli.fleet.settings import OF_BAGS, Settings
from pose_graph_ros.cli.fleet.task import do, Task
from pose_graph_ros.cli.main import main as tool
from pose_graph_ros.cli.replay import replayed
from pose_graph_ros.cli.run import document

COUNTS = (0, 10_000, 20_000, 40_000)
"""Tasks that a scheduler holds, and rows that a call holds."""
USUAL = {**dict.fromkeys(OF_BAGS), 'hold_out': 0}


def write_bags(folder: Path, count: int, seconds: int) -> None:
    """Simulate drives, each another one."""
    with redirect_stdout(io.StringIO()):
        for k in range(count):
            assert tool(['simulate', str(folder / f'{k:04}'), '--seed', str(k),
                         '--duration', str(seconds)]) == 0


def replay_alone(bags: Path, out: Path, until: Future[Any]) -> list[float]:
    """Replay bags in this process until something else is done; return the time of each [s]."""
    settings, times = Settings({}, USUAL), []
    for each in find_recordings([str(bags)], out):
        if until.done():
            break
        begin = time.perf_counter()
        done = replayed(settings.replay_options(Path(each.path), None), {})
        document.write_files(done.run, out / each.name, done.facts)
        times.append(time.perf_counter() - begin)
    return times


def overhead(bags: Path, folder: Path) -> tuple[float, float]:
    """
    Return the time that a drive takes of one worker, and of this process at the same time [s].

    What else the machine does changes both alike, by more than they differ.
    """
    out = folder / 'worker'
    with ThreadPoolExecutor() as pool:
        call = pool.submit(fleet, bags, out, 1)
        while len([*out.glob('drives/*')]) < 2:
            time.sleep(0.1)
        begin = time.time()
        times = replay_alone(bags, folder / 'alone', call)
        end = time.time()
        call.result()
    ends = sorted(at for path in out.glob('drives/*/drive.json')
                  if begin <= (at := path.stat().st_mtime) <= end)
    return (ends[-1] - ends[0]) / (len(ends) - 1), sum(times[1:]) / (len(times) - 1)


def fleet(bags: Path, out: Path, workers: int) -> dict[str, float]:
    """Return the time of a call, and that from its first result to its last one [s]."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, '-m', 'pose_graph_ros.cli.main', 'fleet', str(bags), '-o',
                    str(out), '--workers', str(workers)], check=True, stdout=subprocess.DEVNULL)
    whole = time.perf_counter() - begin
    files = [*out.glob('drives/*/drive.json')]
    ends = sorted(path.stat().st_mtime for path in files)
    rows = [json.loads(path.read_text())['row'] for path in files]
    return {'whole': whole, 'replaying': (ends[-1] - ends[0]) * len(ends) / (len(ends) - 1),
            'peak_memory_mb': max(row['peak_memory_mb'] for row in rows)}


def scheduler_memory(folder: Path) -> list[float]:
    """Return the megabytes that a scheduler without workers has, by `COUNTS` of its tasks."""
    process = subprocess.Popen(
        [sys.executable, '-c', 'import asyncio, distributed\n'
         'async def run():\n'
         "    async with distributed.Scheduler(host='127.0.0.1', port=0) as one:\n"
         '        print(one.address, flush=True)\n        await one.finished()\n'
         'asyncio.run(run())'], stdout=subprocess.PIPE, text=True,
        stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    found = []
    try:
        with Client(process.stdout.readline().strip(), set_as_default=False) as client:
            held = list[Any]()
            for count in COUNTS:
                held += client.map(do, [_task(folder, k) for k in range(len(held), count)])
                while client.run_on_scheduler(_tasks) < count:
                    time.sleep(0.1)
                found.append(1e-6 * psutil.Process(process.pid).memory_info().rss)
    finally:
        process.kill()
        process.wait()
    return found


def _tasks(dask_scheduler: Any) -> int:
    return len(dask_scheduler.tasks)


def _task(folder: Path, k: int) -> Task:
    name = f'robot{k % 20:02}-2026-07-{k % 31:02}-{k:07}'
    return Task(str(folder / 'july'), 'a1b2c3d4', '0123456789abcdef', Recording(
        name, f'/fleet/july/robot{k % 20:02}/{name}.mcap', (), secrets.token_hex(32)))


def call_memory(folder: Path) -> list[float]:
    """Return the megabytes of a call that holds rows, by `COUNTS`, with the table made of them."""
    settings, found = Settings({}, USUAL), []
    for count in COUNTS:
        held = Results(folder, [_task(folder, k).recording for k in range(count)],
                       [({}, settings)])
        for k, each in enumerate(held.recordings):
            held.add(0, each, table.failed_row('a reason ' * 5) | {
                column.name: float(k) for column in table.COLUMNS if column.type == 'double'})
        table.write_table(held.rows, folder)
        found.append(1e-6 * resident_bytes())
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0])
    parser.add_argument('--bags', type=int, default=200)
    parser.add_argument('--seconds', type=int, default=120, help='of each drive')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print('tasks or drives:', *COUNTS)
        print('scheduler [MB]:', *(f'{each:.0f}' for each in scheduler_memory(folder)))
        print('call [MB]:', *(f'{each:.0f}' for each in call_memory(folder)))
        write_bags(folder / 'bags', options.bags, options.seconds)
        size = sum(path.stat().st_size for path in (folder / 'bags').rglob('*'))
        print(f'{options.bags} bags of {options.seconds} s, {1e-6 * size / options.bags:.2f} MB')
        found = {n: fleet(folder / 'bags', folder / f'out{n}', n) for n in (1, 2)}
        for n, each in found.items():
            print(f'fleet --workers {n}:', ', '.join(
                f'{key} {value:.1f}' for key, value in each.items()))
        print(f'speed-up of two: {found[1]["whole"] / found[2]["whole"]:.2f} of the call, '
              f'{found[1]["replaying"] / found[2]["replaying"]:.2f} of the replays')
        worker, alone = overhead(folder / 'bags', folder)
        print(f'a drive: {1e3 * worker:.0f} ms of a worker, {1e3 * alone:.0f} ms of a process '
              f'that replays beside it, {1e3 * (worker - alone):.0f} ms more')


if __name__ == '__main__':
    main()
