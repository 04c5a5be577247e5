# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
Command line of the soak.

    .venv/bin/python -m benchmark.soak engine --days 30 -o soak
    .venv/bin/python -m benchmark.soak node --minutes 60 -o soak
    .venv/bin/python -m benchmark.soak page -o soak

What is found is written as it comes, a line of JSON for each hour of the robot's work and for each
minute with the node, so that a run that is cut leaves figures, too.
"""

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
import json
import logging
from pathlib import Path
import signal
import sys
import tempfile
import time

from benchmark.section import say
from benchmark.soak.page import ENGINE, NODE, write


class CountedLog(logging.Handler):
    """Counts what the engine logs, and shows one of each kind."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.counts = Counter[str]()
        logging.getLogger().addHandler(self)
        logging.getLogger().setLevel(logging.INFO)

    def emit(self, record: logging.LogRecord) -> None:
        """Count a record."""
        kind = f'{record.levelname.lower()} {record.module}:{record.lineno}'
        self.counts[kind] += 1
        if self.counts[kind] == 1:
            say(f'{kind}: {self.format(record)}')


def engine_part(options: argparse.Namespace) -> None:
    """Run a life through the engine."""
    # so that the page can be made without the kernels
    from benchmark.soak import engine, life  # noqa: PLC0415
    from pose_graph_ros.adapters.conversions import Datum  # noqa: PLC0415
    from pose_graph_ros.core.warm_up import warm_up  # noqa: PLC0415

    warm_up()
    log, begin, cpu = CountedLog(), time.monotonic(), time.process_time()
    lived = life.Life(options.days, options.hours, Datum(engine.DATUM))
    with tempfile.TemporaryDirectory(dir=options.out) as folder, \
            (options.out / ENGINE).open('w', encoding='utf-8') as file:
        for hour in engine.run(lived, Path(folder), min(1.0, options.hours)):
            row = asdict(hour) | {
                'seconds': time.monotonic() - begin, 'cpu': time.process_time() - cpu,
                'logged': dict(log.counts)}
            print(json.dumps(row), file=file, flush=True)
            say(f'{row["seconds"]:.0f} s: {hour}')


def node_part(options: argparse.Namespace) -> None:
    """Run the node over DDS."""
    # all other parts work without ROS
    from benchmark.soak import node  # noqa: PLC0415

    with tempfile.TemporaryDirectory(dir=options.out) as folder, \
            (options.out / NODE).open('w', encoding='utf-8') as file:
        for minute in node.run(options.minutes, Path(folder)):
            print(json.dumps(asdict(minute)), file=file, flush=True)
            say(str(minute))


def page_part(options: argparse.Namespace) -> None:
    """Print tables and draw a picture of what was found."""
    print(write(options.out))


PARTS = {'engine': engine_part, 'node': node_part, 'page': page_part}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a part; return the exit code."""
    parser = argparse.ArgumentParser(prog='python -m benchmark.soak', description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('part', choices=PARTS)
    parser.add_argument('--days', type=int, default=30)
    parser.add_argument('--hours', type=float, default=5.0, help='of work in a day')
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('-o', '--out', type=Path, default=Path('build/soak'))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, signal.default_int_handler)   # also end the node on SIGTERM
    PARTS[options.part](options)
    return 0


if __name__ == '__main__':
    sys.exit(main())
