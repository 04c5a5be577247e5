# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""`pose-graph fleet` with real workers: what it keeps, and what it does about what goes wrong."""

from collections.abc import Iterator
from contextlib import suppress
import json
import os
from pathlib import Path
import random
import shutil
import signal
import subprocess
import time
from typing import Any

from distributed import LocalCluster
from fleet_bags import call, FLEET, rows_in, write_drives
import numpy as np
import psutil
import pytest

from pose_graph_ros.cli.fleet import table

KILLS = 5
DEADLINE = 200.0  # of a call [s]
GIVEN = '--truth', '/ground_truth', '--hold-out', '5'
TIMES = ('total_s', 'peak_memory_mb', 'run_s')  # columns that differ from run to run

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module')
def cluster() -> Iterator[LocalCluster]:
    """One worker, which many calls share."""
    with LocalCluster(n_workers=1, threads_per_worker=1, host='127.0.0.1',
                      dashboard_address='127.0.0.1:0', silence_logs=50) as cluster:
        yield cluster


@pytest.fixture
def fleet(cluster: LocalCluster) -> Any:
    """Call the tool with the shared worker."""
    return lambda *words: call('fleet', *words, '--scheduler', cluster.scheduler_address)


@pytest.fixture(scope='module')
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives."""
    folder = tmp_path_factory.mktemp('bags')
    write_drives(folder, 3)
    return folder


def workers_of(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """Return the workers that are alive, by the process that has started them."""
    found = []
    for each in psutil.Process(process.pid).children():
        with suppress(psutil.Error):    # it has just ended
            found += [each] * any('spawn_main' in word for word in each.cmdline())
    return found


def finished(out: Path) -> int:
    """Return how many drives have been replayed."""
    return len([*out.glob('drives/*')])


def wait_until(is_so: Any, process: subprocess.Popen[str]) -> None:
    end = time.monotonic() + DEADLINE
    while not is_so():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)


def test_forty_drives_are_as_single_runs_whatever_workers_die(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    bags = write_drives(tmp_path / 'bags', 40)
    out, rng = tmp_path / 'out', random.Random(7)
    words = [*FLEET, str(tmp_path / 'bags'), '-o', str(out), '--workers', '2', *GIVEN]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for count in sorted(rng.sample(range(1, 34), KILLS)):
        wait_until(lambda count=count: finished(out) >= count, process)
        time.sleep(rng.uniform(0.0, 0.2))
        wait_until(lambda: len(workers_of(process)) > 0, process)
        rng.choice(workers_of(process)).kill()
    text, errors = process.communicate(timeout=DEADLINE)
    assert (process.returncode, errors) == (0, ''), text
    assert '40 drives: 40 replayed, 0 kept, 0 failed' in text
    assert text.startswith('dashboard: http://127.0.0.1:')
    assert not (out / 'unfinished').exists()
    rows = rows_in(out)
    assert [*rows] == [bag.name for bag in bags]
    monkeypatch.setattr('pose_graph_ros.cli.picture.draw_drive', lambda *_: None)  # takes long
    for bag in bags:
        alone, row = tmp_path / 'alone' / bag.name, rows[bag.name]
        assert call('replay', bag, '-o', alone, *GIVEN, '--json').code == 0
        paths = [np.loadtxt(folder / 'path.tum') for folder in (alone, out / row['folder'])]
        np.testing.assert_allclose(paths[1], paths[0], rtol=0.0, atol=1e-12)
        summary = json.loads((alone / 'summary.json').read_text())
        truth = next(each for each in summary['errors']
                     if each['name'] == 'corrected path to truth')
        assert row['truth_rms_m'] == pytest.approx(truth['rms'], rel=1e-12)
        assert row['chi2'] == pytest.approx(summary['chi2'], rel=1e-12)
        assert row['nees_pose'] == pytest.approx(summary['nees_pose']['mean'], rel=1e-12)
        assert row['fixes_held_out'] == summary['fixes_held_out'] > 0
        assert (out / row['folder'] / 'report.html').stat().st_size > 100_000
    # everything is there: nothing is computed, and no worker started
    before = {path: path.stat().st_mtime_ns for path in (out / 'drives').rglob('*')}
    again = subprocess.run(words, capture_output=True, text=True, check=True, timeout=DEADLINE)
    assert '40 drives: 0 replayed, 40 kept, 0 failed' in again.stdout
    assert 'dashboard' not in again.stdout
    assert {path: path.stat().st_mtime_ns for path in (out / 'drives').rglob('*')} == before
    kept = rows_in(out)
    assert not any(row.pop('is_new') for row in kept.values())
    assert all(row.pop('is_new') for row in rows.values())
    assert kept == rows


def test_only_what_has_changed_is_done_again(fleet: Any, bags: Path, tmp_path: Path) -> None:
    folder, out = shutil.copytree(bags, tmp_path / 'bags'), tmp_path / 'out'
    first = fleet(folder, '-o', out)
    assert (first.code, first.counts) == (0, '3 drives: 3 replayed, 0 kept, 0 failed')
    # the same content under another name and time
    (folder / 'day00').rename(folder / 'monday')
    for path in (folder / 'day01').iterdir():
        os.utime(path)
    same = fleet(folder, '-o', out)
    assert same.counts == '3 drives: 0 replayed, 3 kept, 0 failed'
    assert {*rows_in(out)} == {'day01', 'day02', 'monday'}
    # another drive under the same name
    shutil.rmtree(folder / 'day02')
    other = write_drives(tmp_path / 'other', 1, '--fix-sigma', '0.7')[0]
    other.rename(folder / 'day02')
    assert fleet(folder, '-o', out).counts == '3 drives: 1 replayed, 2 kept, 0 failed'
    # other parameters, and back
    noisy = '--set', 'odom.sigma_distance:=0.2'
    assert fleet(folder, '-o', out, *noisy).counts == '3 drives: 3 replayed, 0 kept, 0 failed'
    assert fleet(folder, '-o', out).counts == '3 drives: 0 replayed, 3 kept, 0 failed'
    file = tmp_path / 'robot.yaml'
    file.write_text('/**: {ros__parameters: {odom: {sigma_distance: 0.2}}}\n')
    assert fleet(folder, '-o', out, '--parameters', file).counts == (
        '3 drives: 0 replayed, 3 kept, 0 failed')


def test_half_of_a_result_is_none(fleet: Any, bags: Path, tmp_path: Path) -> None:
    out = tmp_path / 'out'
    fleet(bags, '-o', out)
    one, two, _ = (out / row['folder'] for row in rows_in(out).values())
    (one / 'drive.json').unlink()
    (two / 'path.tum').write_text('')
    (out / 'contents.json').write_text('{"half')
    (out / 'unfinished' / 'killed' / 'some').mkdir(parents=True)
    assert fleet(bags, '-o', out).counts == '3 drives: 2 replayed, 1 kept, 0 failed'
    assert (two / 'path.tum').stat().st_size > 0
    assert not (out / 'unfinished').exists()
    # what another call has cleared away while a worker was still at it
    told = json.loads((one / 'drive.json').read_text())
    del told['sizes']['path.tum']
    (one / 'path.tum').unlink()
    (one / 'drive.json').write_text(json.dumps(told))
    assert fleet(bags, '-o', out).counts == '3 drives: 1 replayed, 2 kept, 0 failed'
    assert (one / 'path.tum').exists()


def test_what_cannot_be_read_is_told_in_a_line_each(
    fleet: Any, bags: Path, tmp_path: Path,
) -> None:
    folder, out = shutil.copytree(bags, tmp_path / 'bags'), tmp_path / 'out'
    storage = next((folder / 'day01').glob('day01*'))
    storage.write_bytes(b'no bag')
    (tmp_path / 'list.txt').write_text(f'# of July\n{folder}\n\n{folder}/none.mcap\n')
    done = fleet(tmp_path / 'list.txt', '-o', out)
    assert (done.code, done.counts) == (1, '4 drives: 2 replayed, 0 kept, 2 failed')
    lines = sorted(done.errors.splitlines())
    assert len(lines) == 2
    assert lines[0].startswith(f'failed: {folder}/day01: damaged')
    assert lines[1] == f'failed: {folder}/none.mcap: does not exist'
    rows = rows_in(out)
    assert [rows[name]['status'] for name in ('day00', 'day01', 'none')] == [
        'converged', 'failed', 'failed']
    assert rows['day01']['reason'] in lines[0]
    # what failed is tried again, as it may have been mended
    assert fleet(tmp_path / 'list.txt', '-o', out).counts == (
        '4 drives: 0 replayed, 2 kept, 2 failed')


# The tool, with something that a worker does first for each drive. A job in the background, as the
# tests may be, ignores SIGINT.
TOOL = """
import os, signal, sys, time
from pose_graph_ros.cli.fleet import cluster
from pose_graph_ros.cli.main import main
do = cluster.do
def do_after(task):
    {first}
    return do(task)
cluster.do = do_after
if __name__ == '__main__':
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main(sys.argv[1:]))
"""


def test_a_bag_that_kills_its_workers_fails_and_the_others_go_on(
    fleet: Any, bags: Path, tmp_path: Path,
) -> None:
    # as if it needed more memory than there is
    out, file = tmp_path / 'out', tmp_path / 'deadly.py'
    file.write_text(TOOL.format(first=(
        "if task.recording.name == 'day01': os.kill(os.getpid(), signal.SIGKILL)")))
    done = subprocess.run([FLEET[0], file, 'fleet', bags, '-o', out, '--workers', '2'],
                          capture_output=True, text=True, check=False, timeout=DEADLINE)
    assert done.returncode == 1, done.stderr
    assert '3 drives: 2 replayed, 0 kept, 1 failed' in done.stdout
    assert done.stderr == (f'failed: {bags}/day01: its worker died 4 times; if it had too little '
                           'memory, fewer workers have more each\n')
    # on a machine that has more, it is done
    assert fleet(bags, '-o', out).counts == '3 drives: 1 replayed, 2 kept, 0 failed'


def test_ctrl_c_keeps_what_is_done(tmp_path: Path) -> None:
    write_drives(tmp_path / 'bags', 12)
    out, file = tmp_path / 'out', tmp_path / 'slow.py'
    # without a pause all may be done before the signal comes
    file.write_text(TOOL.format(first="time.sleep(float(os.environ['PAUSE']))"))
    words = [FLEET[0], str(file), 'fleet', str(tmp_path / 'bags'), '-o', str(out),
             '--workers', '2']
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               start_new_session=True, env=dict(os.environ, PAUSE='2'))
    wait_until(lambda: finished(out) >= 3, process)
    workers = workers_of(process)
    os.killpg(process.pid, signal.SIGINT)   # all processes, as a terminal does
    text, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == 130
    done = len(rows_in(out))
    assert 1 <= done < 12
    assert errors == f'stopped with {12 - done} to do; the same call goes on with these\n'
    assert f'{done} drives: {done} replayed' in text
    assert (out / 'index.html').is_file()
    assert len(psutil.wait_procs(workers, timeout=10.0)[1]) == 0
    again = subprocess.run(words, capture_output=True, text=True, check=True, timeout=DEADLINE,
                           env=dict(os.environ, PAUSE='0'))
    assert int(again.stdout.rpartition(' drives: ')[2].split()[0]) <= 9


def test_a_scheduler_that_is_lost_keeps_what_is_done(
    fleet: Any, bags: Path, tmp_path: Path,
) -> None:
    script = tmp_path / 'scheduler.py'
    script.write_text(
        'import time\nfrom distributed import LocalCluster\n'
        "if __name__ == '__main__':\n"
        "    made = LocalCluster(n_workers=1, threads_per_worker=1, host='127.0.0.1',\n"
        "                        dashboard_address='127.0.0.1:0')\n"
        '    print(made.scheduler_address, flush=True)\n    time.sleep(600)\n')
    scheduler = subprocess.Popen([FLEET[0], script], stdout=subprocess.PIPE, text=True,
                                 stderr=subprocess.DEVNULL)
    assert scheduler.stdout is not None
    address, out = scheduler.stdout.readline().strip(), tmp_path / 'out'
    process = subprocess.Popen(
        [*FLEET, str(bags), '-o', str(out), '--scheduler', address], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True)
    wait_until(lambda: finished(out) >= 1, process)
    scheduler.kill()
    scheduler.communicate()
    text, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == 2
    assert errors.splitlines()[-1] == 'error: the scheduler is lost', errors
    assert 'Traceback' not in errors
    assert (out / 'index.html').is_file(), text
    assert '3 drives: 3 ' not in fleet(bags, '-o', out).counts


def test_wrong_words_are_told_before_anything_is_done(
    fleet: Any, bags: Path, tmp_path: Path,
) -> None:
    out = tmp_path / 'out'
    (tmp_path / 'empty').mkdir()
    for words, expected in (
            ([bags, '--set', 'odom.sigma_distanc:=1'], 'error: parameter odom.sigma_distanc '),
            ([bags, '--set', 'odom.sigma_distance:=-1.0'],
             'error: parameter odom.sigma_distance: '),
            ([tmp_path / 'empty'], f'error: {tmp_path}/empty: no bag'),
            ([f'{tmp_path}/*.mcap'], f'error: {tmp_path}/*.mcap: no bag'),
            (['nothing://bags/*'], 'error: nothing://bags/*: '),
            ([bags, '--hold-out', '1'], 'error: --hold-out: expected 0 or at least 2, got 1'),
            ([bags, '--set', 'sources:=[fix]'],
             'error: parameter sources: expected at least one of type odometry'),
            ([bags, '--truth', 'truth/{}.tum'],
             'error: --truth truth/{}.tum: expected {} at its begin'),
            ([bags, '--trials', '3'], 'error: --trials: expected --sweep'),
            ([bags, '--sweep', 'odom.sigma_distance'], 'error: --sweep: expected NAME=VALUE'),
            ([bags, '--sweep', 'odom.sigma_distance=0.1', '--score', 'truth'],
             'error: --score truth: expected --truth')):
        done = fleet(*words, '-o', out)
        assert done.code == 2, words
        assert done.errors.startswith(expected), done.errors
        assert done.errors.count('\n') == 1
    assert not (out / 'drives').exists()


def test_an_unknown_scheduler_and_a_folder_in_use(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr('pose_graph_ros.cli.fleet.cluster.PATIENCE', 0.5)
    done = call('fleet', bags, '-o', tmp_path / 'out', '--scheduler', 'tpc://127.0.0.1:1')
    assert done.code == 2
    assert done.errors.startswith('stopped with 3 to do')
    assert done.errors.splitlines()[-1].startswith('error: --scheduler tpc://127.0.0.1:1: ')
    process = subprocess.Popen(
        [*FLEET, str(bags), '-o', str(tmp_path / 'out'), '--workers', '1'],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_until(lambda: finished(tmp_path / 'out') >= 1, process)
    done = call('fleet', bags, '-o', tmp_path / 'out')
    assert (done.code, done.errors) == (
        2, f'error: {tmp_path}/out: another pose-graph fleet is at work here\n')
    process.communicate(timeout=DEADLINE)
    assert process.returncode == 0
    # a call that did nothing leaves the table of the last one
    done = call('fleet', bags, '-o', tmp_path / 'out', '--set', 'frequency:=5.0', '--scheduler',
                'tpc://127.0.0.1:1')
    assert (done.code, len(rows_in(tmp_path / 'out'))) == (2, 3)


def test_a_sweep_scores_its_points_and_writes_the_best(
    fleet: Any, bags: Path, tmp_path: Path,
) -> None:
    out = tmp_path / 'out'
    words = (bags, '-o', out, *GIVEN, '--set', 'frequency:=5.0',
             '--sweep', 'fix.covariance_scale=1.0,10000.0,-1.0')
    done = fleet(*words)
    assert done.code == 1   # a point is wrong
    assert done.errors.startswith('left out: parameter fix.covariance_scale: ')
    assert done.errors.count('\n') == 1
    assert done.counts == '6 drives: 6 replayed, 0 kept, 0 failed'
    lines = (out / 'sweep.csv').read_text().splitlines()
    assert lines[0] == ('fix.covariance_scale,drives,failed,mean_m,spread_m,worst_m,worse_by_m,'
                        'standard_error_m')
    assert [line.split(',')[:3] for line in lines[1:]] == [
        ['1.0', '3', '0'], ['10000.0', '3', '0']]
    table = pyarrow_rows(out)
    errors = [row['held_out_rms_m'] for row in table if row['parameters'] == json.dumps(
        {'fix.covariance_scale': 1.0})]
    assert float(lines[1].split(',')[3]) == pytest.approx(np.mean(errors))
    assert float(lines[1].split(',')[4]) == pytest.approx(np.std(errors, ddof=1))
    # the file is one of the node's, and what it says has been done already
    again = fleet(bags, '-o', out, *GIVEN, '--parameters', out / 'best.yaml')
    assert (again.code, again.counts) == (0, '3 drives: 0 replayed, 3 kept, 0 failed')
    by_truth = fleet(*words, '--score', 'truth')
    assert '2 drives' not in by_truth.out
    assert by_truth.counts == '6 drives: 0 replayed, 6 kept, 0 failed'


def pyarrow_rows(out: Path) -> list[dict[str, Any]]:
    import pyarrow.parquet  # noqa: PLC0415

    rows: list[dict[str, Any]] = pyarrow.parquet.read_table(out / 'drives.parquet').to_pylist()
    return rows


def test_the_truth_may_be_a_file_beside_each_bag(fleet: Any, bags: Path, tmp_path: Path) -> None:
    folder, out = shutil.copytree(bags, tmp_path / 'bags'), tmp_path / 'out'
    for k in range(3):
        assert call('replay', folder / f'day{k:02d}', '-o', tmp_path / 'one', '--json').code == 0
        shutil.copy(tmp_path / 'one' / 'path.tum', folder / f'day{k:02d}.tum')
    done = fleet(folder, '-o', out, '--truth', '{}.tum')
    assert done.code == 0, done.errors
    assert all(row['truth_max_m'] < 1e-6 for row in rows_in(out).values())
    # the truth of day00 is not that of a folder whose name only begins so
    shutil.copytree(folder / 'day00', folder / 'day00.5')
    done = fleet(folder, '-o', out, '--truth', '{}.tum')
    assert (done.code, rows_in(out)['day00.5']['status']) == (1, 'failed')
    shutil.rmtree(folder / 'day00.5')
    (folder / 'day01.tum').write_text((folder / 'day00.tum').read_text())
    assert fleet(folder, '-o', out, '--truth', '{}.tum').counts.startswith('3 drives: ')
    assert rows_in(out)['day01']['is_new'] or rows_in(out)['day01']['status'] == 'failed'


def test_columns_have_types_and_units(fleet: Any, bags: Path, tmp_path: Path) -> None:
    import pyarrow.parquet  # noqa: PLC0415

    out = tmp_path / 'out'
    fleet(bags, '-o', out, *GIVEN)
    schema = pyarrow.parquet.read_schema(out / 'drives.parquet')
    assert schema.names == [each.name for each in table.COLUMNS]
    assert schema.field('length_m').metadata[b'unit'] == b'm'
    for row in rows_in(out).values():
        assert {*row} == {*schema.names}
        assert [name for name, value in row.items() if value is None] == []
        assert row['duration_s'] == pytest.approx(15.0, abs=0.5)
        assert row['fixes'] == row['fixes_believed'] + row['fixes_doubted'] + row[
            'fixes_refused'] + row['fixes_held_out']
        assert 10.0 < row['peak_memory_mb'] < 2000.0
    docs = Path(__file__).resolve().parents[2] / 'docs' / 'fleet.md'
    assert table.markdown() in docs.read_text(encoding='utf-8')
