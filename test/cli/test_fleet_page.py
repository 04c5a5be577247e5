# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page of a fleet in a real browser: which drives are first, and where a click leads."""

from collections.abc import Callable, Iterator
from pathlib import Path
import random
import time
from typing import Any

from browser_pages import NARROW, Opened, Opener, WIDE
from fleet_data import drive, failed, fleet
import pytest
from report_data import example

from pose_graph_ros.cli.fleet.overview import in_order, write_overview
from pose_graph_ros.cli.report import render

HOSTILE = '</script><img src=x onerror="window.hacked=1"><!--\u2028{{data}}&amp;$&'
# the worst first
ROWS = [
    failed('lost', 'the worker was lost twice'),
    drive('stuck', 1, 0, status='not converged'),
    drive('bad', 3, 0, truth_rms_m=0.1),
    drive('odd_10', 1, 2, truth_rms_m=0.1),
    drive('odd_9', 1, 1, truth_rms_m=0.1),
    drive('far', 0, 1, truth_rms_m=7.0, held_out_rms_m=1.0),
    drive('near', 0, 1, truth_rms_m=0.3, held_out_rms_m=9.0),
    drive('unknown', 0, 1),
    drive('held', held_out_rms_m=2.0),
    drive('fine', truth_rms_m=0.2, duration_s=95.0)]
NAMES = [row['name'] for row in ROWS]


class Fleet(Opened):
    """The page of a fleet that is open."""

    def names(self) -> list[str]:
        return list(self.page.locator('.drives tbody .drive b').all_inner_texts())

    def click_head(self, text: str) -> None:
        self.page.get_by_role('button', name=text, exact=True).click()

    def sorted_by(self) -> list[tuple[str, str]]:
        return [(head.inner_text().replace('\n', ' '), head.get_attribute('aria-sort'))
                for head in self.page.locator('th[aria-sort]').all()]


def shuffled(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return random.Random(3).sample(rows, len(rows))


@pytest.fixture
def show(browser: Any, tmp_path: Path) -> Iterator[Callable[..., Fleet]]:
    opener = Opener(browser, Fleet)

    def shown(rows: list[dict[str, Any]], width: int = WIDE, *, at: str = '', title: str = 'fleet',
              subtitle: str = '12 bags', points: Any = (), **options: Any) -> Opened:
        page = write_overview(shuffled(rows), tmp_path, lambda row: row['map'] or [],
                              title=title, subtitle=subtitle,
                              points=points)
        assert page == tmp_path / 'index.html'
        assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ['index.html']
        return opener(page.as_uri() + at, width, **options)

    yield shown
    opener.close()


def test_the_worst_are_first() -> None:
    assert [row['name'] for row in in_order(shuffled(ROWS))] == NAMES
    # what a table on a disk has for an unknown number
    lost, = in_order([drive('a', truth_rms_m=float('nan'))])
    assert lost['truth_rms_m'] is None


def test_it_shows_the_worst_first_and_why(show) -> None:
    opened = show(ROWS)
    assert opened.names() == NAMES
    assert opened.sorted_by() == [('finding', 'ascending')]
    texts = opened.page.locator('.finding').all_inner_texts()
    assert texts[0] == 'Failed: the worker was lost twice'
    assert texts[1].startswith('Not converged: gps: errors are 2.1 times')
    assert texts[3].endswith('\n1 warning, 2 notices')
    facts = opened.page.inner_text('.facts').split('\n')
    assert facts[:2] == ['drives', '10']
    assert facts[facts.index('failed'):][:3] == ['failed', '1', '1 not converged']
    assert facts[facts.index('with warnings'):][:2] == ['with warnings', '4']
    assert '1 h 42 min' in facts
    assert '10.83 km' in facts
    assert '0.15 m rms' in facts        # median of 6
    # no column without a value
    heads = opened.page.locator('.drives thead button').all_inner_texts()
    assert not {'parameters', 'NEES pose', 'heading, rms [°]'} & set(heads)
    row = opened.page.locator('.drives tbody tr').nth(9).locator('td').all_inner_texts()
    assert dict(zip(heads[2:], row[1:], strict=True)) == {
        'start [UTC]': '2015-02-26 10:11', 'duration [min:s]': '1:35', 'length [m]': '1\u202f203',
        'error, rms [m]': '0.20', 'held out, rms [m]': '\u2013', 'fixes believed': '1\u202f201',
        'fixes doubted': '12', 'closures believed': '30', 'closures doubted': '2',
        'chi2 / degree': '1.04', 'time to run [s]': '21.5', 'memory [MB]': '291'}


def test_small_maps_show_the_path_with_up_up_and_how_large_it_is(show) -> None:
    opened = show([drive('map'), drive('still', map=[[3.0, 4.0]]), drive(
        'unknown', map=[[float('nan'), 1.0]])])
    # 40 m by 10 m in the middle of 100 by 64
    assert opened.page.locator('.drive polyline').first.get_attribute('points') == (
        '0,44 100,44 100,20' if opened.names()[0] == 'map' else '50,32')
    assert '40 m wide, 10 m high' in opened.page.locator('.drive title').all_text_contents()


def test_heads_sort_by_mouse_and_by_keyboard(show) -> None:
    opened = show(ROWS)
    opened.click_head('error, rms [m]')
    assert opened.sorted_by() == [('error, rms [m]', 'descending')]
    largest = opened.names()
    assert largest == ['far', 'near', 'fine', 'bad', 'odd_10', 'odd_9', 'lost', 'stuck', 'unknown',
                       'held']
    opened.page.keyboard.press('Enter')     # the head keeps the focus
    assert opened.sorted_by() == [('error, rms [m]', 'ascending')]
    # what is unknown is last either way
    assert opened.names() == ['bad', 'odd_10', 'odd_9', 'fine', 'near', 'far', *largest[6:]]
    opened.page.keyboard.press('Shift+Tab')
    for _ in range(4):
        opened.page.keyboard.press('Shift+Tab')
    assert opened.page.evaluate('document.activeElement.textContent') == 'drive'
    opened.page.keyboard.press('Space')
    assert opened.names() == ['bad', 'far', 'fine', 'held', 'lost', 'near', 'odd_9', 'odd_10',
                              'stuck', 'unknown']
    opened.click_head('finding')
    assert opened.names() == NAMES


def test_filters_choose_drives_and_the_address_keeps_them(show) -> None:
    opened = show(ROWS)
    page, told = opened.page, opened.page.locator('.filters output')
    labels = [' '.join(text.split()) for text in page.locator('.filters label').all_inner_texts()]
    assert labels == ['Failed 1', 'Warning 4', 'Notice 3', 'Good 2']
    page.get_by_role('checkbox', name='Failed').uncheck()
    page.get_by_role('checkbox', name='Good').uncheck()
    assert opened.names() == NAMES[1:8]
    assert told.inner_text() == '7 of 10 drives'
    page.fill('input[type=search]', 'GPS /bags/odd')
    opened.until('document.querySelectorAll(".drives tbody tr").length === 2')
    assert opened.names() == ['odd_10', 'odd_9']
    opened.click_head('length [m]')
    opened.click_head('drive')
    assert opened.names() == ['odd_9', 'odd_10']
    address = page.url
    assert address.endswith('#text=GPS+%2Fbags%2Fodd&show=warning%2Cnotice&sort=name')
    # the address is a view that can be sent
    other = show(ROWS, at=address.partition('index.html')[2])
    assert other.names() == ['odd_9', 'odd_10']
    assert other.page.input_value('input[type=search]') == 'GPS /bags/odd'
    assert not other.page.get_by_role('checkbox', name='Good').is_checked()
    other.page.evaluate('location.hash = "#show=good&sort=nothing&down"')
    opened.settle()
    assert other.names() == ['fine', 'held']
    other.page.fill('input[type=search]', 'no such drive')
    other.until('!document.querySelector(".drives").checkVisibility()')
    assert 'No drive is as asked for' in other.page.inner_text('#drives')
    other.page.evaluate('location.hash = ""')
    other.until('document.querySelectorAll(".drives tbody tr").length === 10')
    assert other.names() == NAMES


def test_a_click_opens_the_report_of_the_drive(show, tmp_path) -> None:
    folder = 'drives/50 % of #3?é'
    (tmp_path / folder).mkdir(parents=True)
    (tmp_path / folder / 'report.html').write_text(render(example(title='its report')), 'utf-8')
    opened = show([drive('one', folder=folder), failed('none', 'it is empty'), *(
        drive(f'outside{k}', folder=where) for k, where in enumerate(
            ('..', '../other', '/etc', 'drives//x', 'javascript:alert(1)')))])
    page = opened.page
    assert page.locator('.drive[href]').count() == 2
    # a folder of this name, not a script
    assert page.locator('.drive[href^="javascript%3A"]').count() == 1
    page.get_by_role('link', name='one').click()
    page.wait_for_url('**/report.html')
    assert page.inner_text('h1') == 'its report'
    page.go_back()
    assert len(opened.names()) == 7
    opened.requests.clear()


@pytest.mark.parametrize('width', [WIDE, NARROW])
def test_hostile_texts_are_shown_as_texts(show, width) -> None:
    points = [{'parameters': {HOSTILE: HOSTILE}, 'drives': 1, 'failed': 0, 'mean': 1.0,
               'spread': None, 'worst': 1.0, 'worse_by': None, 'standard_error': None}]
    opened = show([
        drive(HOSTILE + '\udcff', 1, bag=HOSTILE, finding=HOSTILE, parameters='{"</p>": "<b>"}'),
        failed(HOSTILE, HOSTILE, bag=HOSTILE * 9)], width, title=HOSTILE, subtitle=HOSTILE,
        points=points)
    page = opened.page
    assert page.locator('img').count() == 0
    assert page.evaluate('window.hacked') is None
    assert page.inner_text('h1').startswith('</script><img src=x')
    assert all(name.startswith('</script><img src=x') for name in opened.names())
    assert '</p> <b>' in page.inner_text('.drives')
    assert opened.overflow() <= 0


def test_ten_thousand_drives_open_at_once_and_the_best_are_left_out(show) -> None:
    rows = fleet(10_003)
    opened = show(rows)
    page = opened.page
    assert page.inner_text('#drives .lead') == (
        'The worst 10\u202f000 of 10\u202f003 drives; drives.parquet has them all.')
    opening = page.evaluate('performance.getEntriesByType("navigation")[0].domComplete')
    assert opening < 4000.0     # [ms]; a second on a machine that does nothing else
    assert page.locator('tbody tr').count() == 200
    assert opened.names()[0] == in_order(rows)[0]['name']
    page.locator('.drives').scroll_into_view_if_needed()
    page.evaluate('document.querySelector(".drives").scrollTo(0, 1e6)')
    opened.until('document.querySelectorAll("tbody tr").length === 400')
    began = time.monotonic()
    opened.click_head('drive')
    page.fill('input[type=search]', 'drive_77')
    opened.until('document.querySelector("output").textContent.startsWith("111 of")')
    assert time.monotonic() - began < 4.0
    assert opened.names()[:2] == ['drive_77', 'drive_770']
    assert page.locator('.more').is_hidden()


@pytest.mark.parametrize('scheme', ['light', 'dark'])
def test_on_a_phone_nothing_but_the_table_scrolls_sideways(show, scheme) -> None:
    opened = show(fleet(30), NARROW, color_scheme=scheme)
    assert opened.overflow() <= 0
    assert opened.page.evaluate('document.documentElement.dataset.scheme') == scheme
    wide = opened.page.evaluate('''[...document.querySelectorAll('body, main, section, .scrolls')]
        .filter((each) => each.scrollWidth > each.clientWidth + 1)
        .map((each) => each.className)''')
    assert wide == ['scrolls drives card']


def test_it_is_printed_light_and_whole(show) -> None:
    opened = show(fleet(30), color_scheme='dark')
    page = opened.page
    page.evaluate('window.dispatchEvent(new Event("beforeprint"))')
    page.emulate_media(media='print')
    assert page.evaluate('document.documentElement.dataset.scheme') == 'light'
    assert page.evaluate('''(() => { const all = document.querySelector('.drives');
        return [all.scrollHeight - all.clientHeight, getComputedStyle(all).overflow]; })()''') == [
        0, 'visible']
    assert page.locator('.printed').first.is_visible()
    assert page.locator('.filters input').first.is_hidden()


def test_points_of_a_sweep_are_above_the_drives(show) -> None:
    point = {'drives': 12, 'failed': 1, 'mean': 0.4321, 'spread': 0.1, 'worst': 2.0,
             'worse_by': 0.05, 'standard_error': 0.012}
    points = [{'parameters': {'gps.sigma_scale': scale}, **point} for scale in (2.0, 1.0)]
    opened = show([drive('one', parameters='{"gps.sigma_scale": 2.0}')], points=points,
                  subtitle='score: rms to the truth [m]')
    page = opened.page
    assert page.inner_text('#points caption') == 'score: rms to the truth [m]'
    assert page.locator('#points tbody tr').all_inner_texts() == [
        f'{scale}\t12\t1\t0.432\t0.1\t2\t0.05\t0.012' for scale in (2, 1)]
    assert page.locator('main > section').evaluate_all('(all) => all.map((each) => each.id)') == [
        'points', 'drives']
    assert 'gps.sigma_scale 2' in page.inner_text('.drives')


def test_without_drives_it_says_so_and_it_holds_no_library(show, tmp_path) -> None:
    opened = show([])
    assert opened.page.inner_text('#drives .nothing') == 'There are no drives.'
    text = (tmp_path / 'index.html').read_text('utf-8')
    assert 'uPlot' not in text
    assert len(text) < 60_000
