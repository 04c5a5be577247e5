# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""run.json: its form, its numbers, and what it says of runs whose faults are known."""

from dataclasses import replace
from functools import cache
import json
from typing import Any

from honest_drive import HonestDrive
import numpy as np
import pytest
from run_schema import problems

from pose_graph_ros.adapters.parameters import checked
from pose_graph_ros.adapters.sources import FIX, GLOBAL_POSE, GYRO, LOOP_CLOSURE, ODOMETRY
from pose_graph_ros.cli.drive import collect_drive, place_truth, Recorded
from pose_graph_ros.cli.replay import run
from pose_graph_ros.cli.run import MOST_UPDATES, Recorder, Run, thinned, Update
from pose_graph_ros.cli.run.document import document
from pose_graph_ros.cli.run.findings import MOST_SILENCES, silences, silent

WHITE = ('global_pose.correlation_time', 0.0)
SECOND = 10**9


@cache
def run_of(*settings: tuple[str, Any], **of_drive: Any) -> dict[str, Any]:
    """Return run.json of a drive of which all is known."""
    drive = HonestDrive(**{'seed': 1, 'seconds': 240.0, 'closures': 20} | of_drive)
    values = checked(dict(settings))
    backend, report, _, recorder, _ = run(drive.measurements(), values)
    compared = place_truth(replace(collect_drive(
        (Recorded(*each) for each in drive.measurements()), backend, 'odom', ()),
        truth=drive.truth))
    kinds = {'odom': ODOMETRY, 'global_pose': GLOBAL_POSE, 'loop_closure': LOOP_CLOSURE}
    # as it is read from the file
    return dict(json.loads(json.dumps(document(Run(
        'a drive', 'made up', compared, backend, recorder, values, kinds, backend.counts, report,
        1.0)), allow_nan=False)))


def texts(found: dict[str, Any], *levels: str) -> list[str]:
    """Return the findings of some levels, without the times of updates, which the machine has."""
    return [each['text'] for each in found['findings']
            if each['level'] in levels and each['anchor'] != 'updates']


def source(found: dict[str, Any], name: str) -> dict[str, Any]:
    return next(dict(each) for each in found['sources'] if each['name'] == name)


@pytest.mark.parametrize('of_drive', [
    {}, {'tau': 20.0, 'closures': 0}, {'fixes': False}, {'false_closures': 5}], ids=str)
def test_it_has_the_form_that_is_documented(of_drive) -> None:
    found = run_of(**of_drive)
    assert list(problems(found)) == []
    assert len(found['springs']) == 10
    for table in (*found['fixes'], *found['closures']):
        assert set(table['state']) <= set(range(len(found['states'])))
        assert all(-1 <= why < len(found['texts']) for why in table['why'])
    for each in found['sparsity']:
        assert sum(cell[2] for cell in each['cells']) == each['nonzeros']
    anchors = {'map', 'errors', 'updates', *(f'source-{each["name"]}' for each in
                                             found['sources'])}
    assert {each['anchor'] for each in found['findings']} <= anchors


def test_times_and_places_are_those_of_the_run() -> None:
    found, drive = run_of(), HonestDrive(seed=1, seconds=240.0, closures=20)
    assert int(found['start_ns']) == drive.truth.stamps_ns[0]
    assert found['start'] == '2023-11-14T22:13:20.000Z'
    assert found['duration'] == pytest.approx(240.0)
    path = found['lines']['corrected']
    at = int(found['start_ns']) + np.round(np.array(path['t']) * SECOND).astype(np.int64)
    places = np.column_stack((path['x'], path['y'])) + found['offset']
    truth = drive.truth.at(np.minimum(at, drive.truth.stamps_ns[-1]))
    assert np.max(np.hypot(*(places - truth[:, :2]).T)) < 1.0
    fixes = found['fixes'][0]
    np.testing.assert_allclose(
        np.column_stack((fixes['x'], fixes['y'])) + found['offset'], drive.positions, atol=0.006)
    nearest = np.array(path['t'])[fixes['at']]
    assert np.max(np.abs(nearest - fixes['t'])) < 1.0
    # the springs are where their nodes are
    for spring in found['springs']:
        if spring['from'] is not None:
            node = int(np.argmin(np.abs(np.array(path['t']) - spring['from']['t'])))
            assert path['x'][node] == pytest.approx(spring['from']['x'], abs=0.02)


def test_of_very_many_measurements_those_that_are_not_believed_stay(monkeypatch) -> None:
    whole = run_of(false_closures=5)
    monkeypatch.setattr('pose_graph_ros.cli.run.document.MOST_OF_SOURCE', 16)
    part = run_of(('frequency', 10.0), false_closures=5)
    assert list(problems(part)) == []
    for name in ('fixes', 'closures'):
        table, all_of_it = part[name][0], whole[name][0]
        assert all_of_it['left_out'] == 0
        assert len(table['state']) == 16
        assert table['left_out'] == len(all_of_it['state']) - 16 > 0
        rows = [list(zip(each['state'], each['why'], each['id'], each['d'], strict=True))
                for each in (table, all_of_it)]
        assert sum(row[0] > 0 for row in rows[0]) == sum(row[0] > 0 for row in rows[1])
        assert {row[2:] for row in rows[0]} <= {row[2:] for row in rows[1]}


@pytest.mark.parametrize('of_drive', [{}, {'seed': 0}], ids=str)
def test_nothing_is_wrong_with_an_honest_drive(of_drive) -> None:
    for settings in ((), (WHITE,)):
        assert texts(run_of(*settings, **of_drive), 'warning', 'notice') == []


def test_fixes_that_claim_too_much_are_found_with_their_factor() -> None:
    found = run_of(times=3.0)
    warning, = texts(found, 'warning')
    assert warning.startswith('global_pose: claims 0.5 m, found 1.')
    assert 'set global_pose.covariance_scale to' in warning
    assert float(warning.rpartition(' ')[2]) == pytest.approx(9.0, rel=0.3)
    assert source(found, 'global_pose')['ratio'] == pytest.approx(3.0, rel=0.15)
    assert 'times too small' in source(found, 'global_pose')['verdict']
    for other in ('odom', 'loop_closure'):
        assert 'times too' not in source(found, other)['verdict']


def test_odometry_that_drifts_more_than_it_claims_is_found() -> None:
    found = run_of(odometry_times=3.0, closures=0)
    assert source(found, 'odom')['ratio'] == pytest.approx(3.0, rel=0.25)
    notice, = texts(found, 'notice')
    assert notice.startswith('odom: claims')
    assert 'the estimate allows for it' in notice
    assert texts(found, 'warning') == []


def test_correlated_errors_taken_for_white_are_found() -> None:
    found = run_of(WHITE, tau=20.0, closures=0)
    assert 'set global_pose.correlation_time to -1' in ' '.join(texts(found, 'warning'))
    curve = source(found, 'global_pose')['autocorrelation']
    assert 1.0 < curve['time'] < 40.0     # at least, as the path follows the errors
    assert curve['in_use'] is None
    # left to itself, the engine finds them and allows for them
    found = run_of(tau=20.0, closures=0)
    assert texts(found, 'warning') == []
    assert any('found by itself and allowed for' in text for text in texts(found, 'good'))
    assert source(found, 'global_pose')['autocorrelation']['in_use'] > 10.0


def test_an_outage_is_found_with_its_time() -> None:
    warning, = texts(run_of(outage=(100.0, 130.0)), 'warning')
    assert warning.startswith('global_pose: no messages from 99.5 to 130.5 s (31 s at most)')


def test_false_closures_are_found() -> None:
    found = run_of(false_closures=5)
    warning, = texts(found, 'warning')
    assert warning.startswith('loop_closure: 5 of 20 closures contradict the others')
    drive = HonestDrive(seed=1, seconds=240.0, closures=20, false_closures=5)
    doubted = np.array(found['closures'][0]['state']) == found['states'].index('doubted')
    assert np.array_equal(doubted, drive.is_false)
    reasons = [found['texts'][why] for why in np.array(found['closures'][0]['why'])[doubted]]
    assert all(reason.startswith('Doubted and not used') for reason in reasons)
    unused = source(found, 'loop_closure')['unused']
    assert (unused['count'], unused['median_distance'] > 10.0) == (5, True)


def test_without_anything_in_the_map_that_is_said() -> None:
    found = run_of(fixes=False)
    notice, = texts(found, 'notice')
    assert notice.startswith('nothing was measured in the map')
    # path and odometry are compared alike, each where it fits the truth best
    text, = (text for text in texts(found, 'good') if 'rms from the truth' in text)
    assert 'odometry alone' in text
    assert max(found['errors']['position']) < 10.0


def test_a_path_that_is_worse_than_odometry_alone_is_not_called_good() -> None:
    found = run_of(WHITE, ('odom.sigma_scale', 5.0), times=4.0, odometry_times=0.01, closures=0)
    assert any('rms from the truth' in text for text in texts(found, 'warning'))
    assert not any('rms from the truth' in text for text in texts(found, 'good', 'notice'))


def test_of_many_updates_the_slowest_are_kept() -> None:
    recorder, count = Recorder(), 9 * MOST_UPDATES + 7
    for k in range(count):
        recorder.add_update(Update(k, k, 500.0 if k == 12_345 else 1.0, 0.0))
    kept = thinned(recorder.updates)
    assert recorder.n_updates == count
    assert MOST_UPDATES // 2 <= len(kept) <= MOST_UPDATES
    assert kept[-1].nodes == count - 1
    assert abs(max(kept, key=lambda each: each.milliseconds).nodes - 12_345) < 16


def test_the_longest_silences_are_told_but_not_that_before_a_late_message() -> None:
    stamps = np.cumsum([SECOND // 10 + (k % 100 == 50) * (k + 100) * SECOND // 10
                        for k in range(5000)]).tolist()
    # one without a stamp does not count
    gaps = silent([*stamps, stamps[-1] - SECOND, 0], 1.0)
    assert len(gaps) == MOST_SILENCES
    assert np.all(np.diff(gaps[:, 0]) > 0.0)
    assert np.ptp(gaps[-1]) == pytest.approx((4950 + 100) * 0.1 + 0.1)


def test_a_silence_of_one_of_two_odometries_does_not_hide_the_motion() -> None:
    tenths = (np.arange(1, 101) * SECOND // 10).tolist()
    interrupted = [*tenths[:41], *tenths[80:]]
    arrived = {'wheels': tenths, 'visual': interrupted, 'gyro': interrupted}
    kinds = {'wheels': ODOMETRY, 'visual': ODOMETRY, 'gyro': GYRO}
    told = {each.text.partition(':')[0]: each.text.rpartition('; ')[2]
            for each in silences(arrived, kinds, 0)}
    assert told == {
        'visual': 'the motion there is that of other odometry, as far as it goes on',
        'gyro': 'the heading there is that of other sources'}
    del kinds['wheels'], arrived['wheels']
    visual, _ = silences(arrived, kinds, 0)
    assert visual.text.endswith('the motion there is not known')


@pytest.mark.parametrize('source', ['odom', 'fix'])
def test_a_silence_is_a_warning_from_20_s_on_as_the_docs_say(source) -> None:
    for length, level in ((7, 'notice'), (25, 'warning')):
        stamps = [tenth * SECOND // 10 for tenth in (
            *range(10, 110), *range(109 + 10 * length, 210 + 10 * length))]
        found, = silences({source: stamps}, {'odom': ODOMETRY, 'fix': FIX}, SECOND)
        assert found.level == level
        assert f'({length} s at most)' in found.text
        # where it is, for the map
        assert found.at == [(pytest.approx(9.9), pytest.approx(9.9 + length))]
