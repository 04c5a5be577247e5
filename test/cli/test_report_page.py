# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page of a report in a real browser: what a reader sees, clicks and is told."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import itertools
import json
from pathlib import Path
import re
import time
from typing import Any

from browser_pages import NARROW, Opened, Opener, WIDE
from false_loops import laps
import numpy as np
import pytest
from report_data import example

import pose_graph_ros
from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.report import render
from pose_graph_ros.cli.run.comparison import compared
from pose_graph_ros.cli.run.graph_document import solved_document
from pose_graph_ros.core.geometry.se2 import FloatArray
from pose_graph_ros.core.io.g2o import write_g2o

HOSTILE = '</script><img src=x onerror="window.hacked=1"><!--\u2028{{data}}&amp;$&'
CSS = (Path(pose_graph_ros.__file__).parent / 'cli' / 'page' / 'page.css').read_text('utf-8')

# A hash of the pictures of the map.
HASH = """() => {
  let hash = 7;
  for (const canvas of document.querySelectorAll('#stage canvas')) {
    const copy = new OffscreenCanvas(canvas.width, canvas.height);
    const context = copy.getContext('2d', {willReadFrequently: true});
    context.drawImage(canvas, 0, 0);
    const {data} = context.getImageData(0, 0, canvas.width, canvas.height);
    for (const pixel of new Int32Array(data.buffer)) hash = (Math.imul(hash, 31) + pixel) | 0;
  }
  return hash;
}"""


class Report(Opened):
    """The page of a report that is open."""

    def view(self) -> tuple[float, float, float]:
        """Return the middle of the map [m] and its scale [pixels / m]."""
        text = self.page.get_attribute('#stage', 'data-view')
        x, y, scale = map(float, text.split())
        return x, y, scale

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Return where a point of the map is on the screen [pixels]."""
        box = self.page.locator('#stage').bounding_box()
        left, top, scale = self.view()
        return (box['x'] + box['width'] / 2 + (x - left) * scale,
                box['y'] + box['height'] / 2 - (y - top) * scale)

    def panel(self) -> str:
        return str(self.page.inner_text('#panel'))

    def painted(self) -> int:
        """Return a hash of the picture of the map."""
        self.settle()
        return int(self.page.evaluate(HASH))


@pytest.fixture(scope='module')
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return runs of a drive with false loop closures: `run`, and `all` that uses them."""
    folder = tmp_path_factory.mktemp('drive')
    assert main(['simulate', str(folder / 'bag'), '--world', 'grid', '--duration', '200',
                 '--fix-period', '4', '--false-rate', '0.15']) == 0
    for name, *words in (('run',), ('all', '-p', 'loop_closure.robust:=none')):
        assert main(['replay', str(folder / 'bag'), '-o', str(folder / name), '--odom', '/odom',
                     '--truth', '/ground_truth', '--hold-out', '5', *words]) == 0
    return folder


@pytest.fixture(scope='module')
def real(runs: Path) -> dict[str, Any]:
    """Data of a drive as replay writes them."""
    found: dict[str, Any] = json.loads((runs / 'run' / 'run.json').read_text(encoding='utf-8'))
    return found


@pytest.fixture(scope='module')
def two(runs: Path) -> dict[str, Any]:
    """Data of two runs, of which the second believes all closures."""
    return compared((runs / 'run' / 'run.json', runs / 'all' / 'run.json'))


@pytest.fixture(scope='module')
def graph(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Data of a solved graph with wrong closures."""
    file = tmp_path_factory.mktemp('graph') / 'laps.g2o'
    write_g2o(laps(4, n_wrong=3).graph, file)
    return solved_document(file, None, 'selection')


@pytest.fixture(scope='module')
def made() -> dict[str, Any]:
    """Data with marks of all states and all sections."""
    return example()


@pytest.fixture
def show(browser: Any, tmp_path: Path) -> Iterator[Callable[..., Opened]]:
    opener = Opener(browser, Report)

    def shown(data: dict[str, Any], width: int = WIDE, **options: Any) -> Opened:
        file = tmp_path / f'page{len(opener.opened)}.html'
        file.write_text(render(data), encoding='utf-8')
        return opener(file.as_uri(), width, **options)

    yield shown
    opener.close()


@dataclass(frozen=True)
class Closure:
    """A doubted closure and where it can be clicked."""

    name: str
    reason: str
    distance: str
    middle: FloatArray
    place: FloatArray


def doubted(data: dict[str, Any]) -> Closure:
    """Return the closure that can be clicked farthest from all other marks."""
    table, far = data['closures'][0], []
    others = [np.stack((fixes['x'], fixes['y']), axis=1) for fixes in data['fixes']]
    begin, end = (np.stack((table[f'x{k}'], table[f'y{k}']), axis=1) for k in (0, 1))
    along = np.linspace(0.05, 0.95, 91)[:, None, None]
    lines = begin + along * (end - begin)           # places on each closure
    for k in np.flatnonzero(np.array(table['state']) == 3):
        rest = np.concatenate((*others, np.delete(lines, k, axis=1).reshape(-1, 2)))
        away = np.min(np.linalg.norm(lines[:, k, None] - rest, axis=2), axis=1)
        far.append((np.max(away), k, lines[np.argmax(away), k]))
    _, k, place = max(far, key=lambda each: each[0])
    return Closure(table['id'][k], data['texts'][table['why'][k]], f'{table["d"][k]:.3g} sigma',
                   0.5 * (begin[k] + end[k]), place)


@pytest.mark.parametrize('width', [WIDE, NARROW])
def test_a_click_on_a_doubted_closure_tells_its_reason(show, real, width) -> None:
    opened = show(real, width)
    page, closure = opened.page, doubted(real)
    page.locator('#stage').scroll_into_view_if_needed()
    tap = page.mouse.click if width == WIDE else page.touchscreen.tap
    assert closure.reason not in opened.panel()
    tap(*opened.place(*closure.place))
    for text in (closure.name, closure.reason, closure.distance, 'doubted'):
        assert text in opened.panel()
    # again after the map has moved
    page.click('#panel button[aria-label=Close]')
    before = opened.view()
    page.focus('#stage')
    for key in ('+', 'ArrowUp', 'ArrowLeft'):
        page.keyboard.press(key)
    after = opened.view()
    assert after[0] < before[0]
    assert after[1] > before[1]
    assert after[2] == pytest.approx(2.0 * before[2])
    page.keyboard.press('0')
    page.click('[aria-label="Zoom in"]')
    assert opened.view()[:2] == pytest.approx(before[:2], abs=1.0)
    assert opened.view()[2] == pytest.approx(2.0 * before[2])
    assert closure.reason not in opened.panel()
    tap(*opened.place(*closure.place))
    assert closure.reason in opened.panel()
    assert opened.overflow() <= 0


def test_the_wheel_zooms_at_the_pointer_and_a_drag_takes_the_map_along(show, real) -> None:
    opened = show(real)
    page, closure = opened.page, doubted(real)
    page.locator('#stage').scroll_into_view_if_needed()
    at = opened.place(*closure.place)
    page.mouse.move(*at)
    scale = opened.view()[2]
    page.mouse.wheel(0, -300)
    opened.until(f'document.getElementById("stage").dataset.view.split(" ")[2] > {scale}')
    assert opened.place(*closure.place) == pytest.approx(at, abs=2.0)
    page.mouse.down()
    page.mouse.move(at[0] + 90, at[1] - 60, steps=3)
    page.mouse.up()
    assert opened.place(*closure.place) == pytest.approx((at[0] + 90, at[1] - 60), abs=2.5)
    assert closure.name not in opened.panel()       # a drag is no click
    page.mouse.click(*opened.place(*closure.place))
    assert closure.name in opened.panel()
    scale = opened.view()[2]
    page.mouse.dblclick(*opened.place(*closure.place))
    assert opened.view()[2] > 1.9 * scale
    page.click('[aria-label="Show all"]')
    assert opened.view()[2] < scale


@pytest.mark.parametrize('width', [WIDE, NARROW])
def test_entries_of_lists_centre_the_map(show, real, width) -> None:
    opened = show(real, width)
    page, closure = opened.page, doubted(real)
    page.locator('.entry').filter(has=page.get_by_text(closure.name, exact=True)).first.click()
    assert opened.view()[:2] == pytest.approx(closure.middle, abs=0.01)
    assert closure.reason in opened.panel()
    assert page.inner_text('.entry[aria-current=true] .entry-name') == closure.name
    # a spring, with its layer, by keyboard
    box = page.locator('[data-layer=springs] input')
    assert not box.is_checked()
    spring = next(each for each in real['springs'] if each['from'] and each['to'])
    page.locator('.springs .entry').nth(spring['rank'] - 1).focus()
    page.keyboard.press('Enter')
    assert box.is_checked()
    middle = [0.5 * (spring['from'][axis] + spring['to'][axis]) for axis in ('x', 'y')]
    assert opened.view()[:2] == pytest.approx(middle, abs=0.01)
    assert spring['name'] in opened.panel()
    assert page.locator('.springs .entry:disabled').count() == 0
    assert opened.overflow() <= 0


def test_each_layer_and_state_can_be_hidden_and_shown(show, made) -> None:
    opened = show(made, NARROW)
    boxes = opened.page.locator('.layers input')
    assert boxes.count() == 7 + 5 + 4           # layers, states of fixes and of closures
    full = opened.painted()
    boxes.first.tap()
    assert opened.painted() != full
    boxes.first.tap()
    for box in boxes.element_handles():
        box.evaluate('(box) => box.click()')
        assert opened.painted() != full
        box.evaluate('(box) => box.click()')
        assert opened.painted() == full
    # and what is hidden is not clicked
    opened.page.locator('#stage').scroll_into_view_if_needed()
    opened.page.tap('[data-layer="closure/loop_closure"] [data-state="3"] input')
    opened.page.touchscreen.tap(*opened.place(*doubted(made).place))
    assert 'doubted' not in opened.panel()


def test_time_links_charts_and_map(show, made) -> None:
    opened = show(made)
    page = opened.page
    before = opened.painted()
    page.focus('#time')
    page.keyboard.press('PageUp')
    told = page.inner_text('#where')
    assert 'UTC' in told
    assert 'm' in told
    assert opened.painted() != before
    chart = page.locator('#errors .plot').first
    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    page.mouse.move(box['x'] + 0.5 * box['width'], box['y'] + 0.5 * box['height'])
    opened.settle()
    assert page.inner_text('#where') != told
    numbers = r'corrected path\s*\d.*odometry, aligned\s*\d'
    assert re.search(numbers, page.inner_text('#errors .u-legend >> nth=0'), re.S)
    # by keyboard as well
    told = page.inner_text('#where')
    chart.focus()
    page.keyboard.press('ArrowRight')
    assert page.inner_text('#where') != told
    # and in words, for those who see no charts
    assert 'corrected path from 0.' in chart.get_attribute('aria-label')


def test_the_scheme_is_that_of_the_reader_until_it_is_chosen(show, made) -> None:
    opened = show(made, color_scheme='dark')
    page = opened.page

    def background() -> str:
        return str(page.evaluate('getComputedStyle(document.body).backgroundColor'))

    dark, picture = background(), opened.painted()
    page.emulate_media(color_scheme='light')
    opened.until('document.documentElement.dataset.scheme === "light"')
    assert background() != dark
    assert opened.painted() != picture
    page.click('#scheme')
    assert background() == dark
    page.emulate_media(media='print')
    assert page.locator('nav').is_hidden()


def test_a_printed_page_has_its_charts_and_the_whole_map(show, made) -> None:
    opened = show(made)
    page, before = opened.page, opened.view()
    # at once, as nothing is painted any more while the browser prints
    painted = page.evaluate("""(async () => {
        window.dispatchEvent(new Event('beforeprint'));
        await null;
        return [...document.querySelectorAll('.plot canvas, #stage canvas:first-child')].map(
          (canvas) => [canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height)
            .data.some((value) => value > 0), canvas.width - 2 * canvas.clientWidth,
          canvas.clientWidth]);
    })()""")
    assert all(some and abs(apart) <= 2 and width < 700 for some, apart, width in painted)
    page.emulate_media(media='print')
    # no canvas hides another, and headings stay with what follows them
    assert page.locator('#stage canvas:visible').count() == 1
    assert page.evaluate('getComputedStyle(document.querySelector("h2")).breakAfter') == 'avoid'
    page.emulate_media(media='screen')
    page.evaluate('window.dispatchEvent(new Event("afterprint"))')
    opened.settle()
    opened.settle()
    assert opened.view()[:2] == pytest.approx(before[:2], abs=0.2)     # half a pixel
    assert opened.view()[2] == pytest.approx(before[2])


@pytest.mark.parametrize('width', [WIDE, NARROW])
def test_hostile_texts_are_shown_as_texts(show, width) -> None:
    data = example(poses=60, fixes=40, closures=12, title=HOSTILE + '\ud800')
    data['subtitle'] = HOSTILE
    data['texts'] = [HOSTILE * 4] * 4
    data['facts'][0] = {'label': HOSTILE, 'value': HOSTILE, 'note': HOSTILE}
    data['findings'][0] |= {'text': HOSTILE, 'anchor': f'source-{HOSTILE}', 'level': HOSTILE}
    for table in (*data['fixes'], *data['closures']):
        table['id'] = [HOSTILE] * len(table['id'])
        table['source'] = HOSTILE
    for each in data['sources']:
        each |= {'name': HOSTILE, 'kind': HOSTILE, 'verdict': HOSTILE}
    for each in data['springs']:
        each |= {'name': HOSTILE, 'kind': HOSTILE, 'text': HOSTILE}
    opened = show(data, width)
    page = opened.page
    page.locator('details[data-kind=closure] .entry').first.click()
    assert '</script><img src=x onerror="window.hacked=1"><!--' in opened.panel()
    page.locator('#findings a').first.click()
    assert page.locator('img').count() == 0
    assert page.evaluate('window.hacked') is None
    assert page.inner_text('h1').startswith('</script><img src=x')
    assert opened.overflow() <= 0


def test_a_page_without_data_says_why_in_each_section(show) -> None:
    path = {'t': [0.0], 'x': [0.0], 'y': [0.0], 'theta': [0.0]}
    opened = show({'title': 'nothing', 'states': [], 'axes': ['x', 'y'],
                   'lines': {'corrected': path}})
    assert opened.page.locator('.nothing').count() == 3


def test_an_hour_of_driving_is_below_5_mb_and_can_be_panned(show) -> None:
    # as many poses as a report has at most, and fixes at 5 Hz
    data = example(poses=10_000, fixes=18_000, closures=2000, others=2000)
    assert len(render(data).encode()) < 5e6
    opened = show(data)
    opened.page.locator('#stage').scroll_into_view_if_needed()
    before, began = opened.view(), time.process_time()
    opened.page.mouse.move(*opened.place(*before[:2]))
    opened.page.mouse.down()
    opened.page.mouse.move(500, 400, steps=40)
    opened.page.mouse.up()
    assert opened.view()[0] != before[0]
    assert time.process_time() - began < 5.0


def slide(opened: Opened, slider: str, value: float) -> None:
    opened.page.evaluate('''([id, value]) => {
      const slider = document.getElementById(id);
      slider.value = value;
      slider.dispatchEvent(new Event('input'));
    }''', [slider, value])


def test_what_is_outside_of_the_window_of_time_is_not_on_the_map(show, real) -> None:
    opened, table = show(real), real['closures'][0]
    closure, whole = doubted(real), opened.painted()
    at = table['id'].index(closure.name)
    slide(opened, 'to', table['t0'][at] - 5.0)
    assert opened.page.inner_text('#span') != 'Map: the whole path'
    part = opened.painted()
    assert part != whole
    opened.page.locator('#stage').scroll_into_view_if_needed()
    opened.page.mouse.click(*opened.place(*closure.place))
    assert closure.name not in opened.panel()
    # all that is shown fits the map
    before = opened.view()[2]
    slide(opened, 'to', 0.15 * real['duration'])
    opened.page.click('[aria-label="Show all"]')
    assert opened.view()[2] > 1.2 * before
    # who asks for something outside gets it
    opened.page.locator('.entry').filter(
        has=opened.page.get_by_text(closure.name, exact=True)).first.click()
    assert opened.page.inner_text('#span') == 'Map: the whole path'
    assert closure.name in opened.panel()


def test_the_path_is_coloured_by_error_by_sigma_or_by_time(show, real) -> None:
    opened = show(real, color_scheme='dark')
    select = opened.page.locator('[data-layer=corrected] select')
    names = select.locator('option').all_inner_texts()
    assert names == ['in one colour', 'by error', 'by sigma', 'by time']
    pictures = []
    for name in names:
        select.select_option(name)
        pictures.append(opened.painted())
        legend = opened.page.inner_text('[data-layer=corrected] .legend').split('\n')
        # from the least to the largest of them
        assert legend == ([''] if name == names[0] else sorted(legend, key=lambda text: float(
            text.split()[0].replace(':', ''))))
    assert len(set(pictures)) == 4
    opened.page.click('#scheme')
    assert opened.painted() not in pictures


def test_show_zooms_to_what_a_finding_speaks_of(show, real) -> None:
    opened = show(real)
    found = next(each for each in real['findings'] if len(each['at']) > 0)
    before, whole = opened.view(), opened.painted()
    opened.page.locator('#findings li', has_text=found['text']).locator('a').click()
    assert opened.painted() != whole
    path, (x, y, scale) = real['lines']['corrected'], opened.view()
    assert scale != before[2]
    box = opened.page.locator('#stage').bounding_box()
    for at in itertools.chain(*found['at']):
        place = [np.interp(at, path['t'], path[name]) for name in 'xy']
        assert abs(place[0] - x) * scale < box['width'] / 2
        assert abs(place[1] - y) * scale < box['height'] / 2
    # one place alone is shown near
    data = {**real, 'findings': [found | {'at': [[100.0, 100.0]]}]}
    opened = show(data)
    opened.page.click('#findings a')
    assert opened.view()[2] > 2.0 * before[2]
    assert opened.view()[:2] == pytest.approx(
        [np.interp(100.0, path['t'], path[name]) for name in 'xy'], abs=0.01)


def test_the_scheme_that_was_chosen_is_remembered(show, made) -> None:
    opened = show(made, color_scheme='light')
    opened.page.click('#scheme')
    opened.page.reload()
    assert opened.page.evaluate('document.documentElement.dataset.scheme') == 'dark'
    del opened.requests[2:]     # it was asked for twice
    # where nothing may be kept, the page is as it was before
    opened = show(made, color_scheme='light')
    opened.page.add_init_script('''Object.defineProperty(window, 'localStorage', {
      get() { throw new Error('not allowed'); }})''')
    opened.page.reload()
    opened.page.click('#scheme')
    assert opened.page.evaluate('document.documentElement.dataset.scheme') == 'dark'
    opened.page.reload()
    assert opened.page.evaluate('document.documentElement.dataset.scheme') == 'light'
    del opened.requests[2:]


@pytest.mark.parametrize('width', [WIDE, NARROW])
def test_of_two_runs_it_shows_what_changed_and_where(show, two, width) -> None:
    opened = show(two, width)
    page = opened.page
    assert [page.inner_text(f'nav li:nth-child({k}) a') for k in (1, 2, 3, 4)] == [
        'Figures', 'Map', 'Differences', 'Places']
    row = page.locator('#figures tr', has_text='loop_closure.robust')
    assert row.locator('td').all_inner_texts() == ['by default', 'none', '']
    # closures that only B believes, with what A says of them
    entries = page.locator('details[data-kind=closure] .entry')
    assert entries.count() == len(two['closures'][0]['state']) > 0
    entries.first.click()
    assert 'A: Doubted and not used' in opened.panel()
    assert 'B: believed' in opened.panel()
    # where the paths differ most
    spring = two['springs'][0]
    page.locator('.springs .entry').first.click()
    assert 'Difference' in opened.panel()
    assert opened.view()[:2] == pytest.approx(
        [0.5 * (spring['from'][axis] + spring['to'][axis]) for axis in 'xy'], abs=0.01)
    shown = opened.painted()
    page.locator('[data-layer=other] input').click()
    assert opened.painted() != shown
    assert page.locator('#errors canvas').count() == 2
    assert opened.overflow() <= 0


@pytest.mark.parametrize('width', [WIDE, NARROW])
def test_of_a_graph_it_shows_nodes_and_closures_by_their_error(show, graph, width) -> None:
    opened = show(graph, width)
    page = opened.page
    assert 'sigma' in page.inner_text('[data-layer="closure/closures"] .legend')
    by_error = opened.painted()
    page.select_option('[data-layer="closure/closures"] select', 'by state')
    assert opened.painted() != by_error
    page.locator('details[data-kind=closure] .entry').first.click()
    assert 'Doubted and not used' in opened.panel()
    assert 'node' in opened.panel()
    assert re.match(r'node \d+ · ', page.inner_text('#where'))
    assert page.locator('#sources article').count() == 2
    assert page.locator('.springs .entry').count() == 10
    assert opened.overflow() <= 0


# --- colours ------------------------------------------------------------------------------------

def scheme(which: int) -> dict[str, np.ndarray]:
    """Return name -> (R, G, B) in 0..1 of the light (0) or the dark scheme (1)."""
    return {name: np.array([int(codes[which][k:k + 2], 16) for k in (0, 2, 4)]) / 255.0
            for name, *codes in re.findall(r'--([\w-]+): light-dark\(#(\w{6}), #(\w{6})\);', CSS)}


SCHEMES = {'light': scheme(0), 'dark': scheme(1)}
MARKS = ('path', 'odometry', 'truth', 'believed', 'waiting', 'doubted', 'refused', 'held-out',
         'spring', 'axis')


def linear(colour: np.ndarray) -> np.ndarray:
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


def contrast(one: np.ndarray, other: np.ndarray) -> float:
    """Return the contrast ratio of WCAG 2.2."""
    light = sorted(float(linear(colour) @ [0.2126, 0.7152, 0.0722]) for colour in (one, other))
    return (light[1] + 0.05) / (light[0] + 0.05)


@pytest.mark.parametrize('name', SCHEMES)
def test_texts_and_marks_have_enough_contrast(name) -> None:
    colours = SCHEMES[name]
    assert len(colours) > 20
    for ground, text in itertools.product(
            ('page', 'surface', 'raised'),
            ('ink', 'muted', 'accent', 'warning', 'notice', 'good')):
        assert contrast(colours[ground], colours[text]) >= 4.5, (ground, text)
    for mark in (*MARKS, *(f'ramp{k}' for k in range(5))):
        assert contrast(colours['surface'], colours[mark]) >= 3.0, mark


# How colours look to people without cones for red and for green, in linear RGB (Viénot, Brettel
# and Mollon: Digital video colourmaps for checking the legibility of displays by dichromats, 1999)
DICHROMATS = {
    'protanopia': [[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]],
    'deuteranopia': [[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]]}


def lab(rgb: np.ndarray) -> np.ndarray:
    """Return CIELAB of linear RGB, for the white of sRGB."""
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    scaled = xyz @ np.clip(rgb, 0.0, 1.0) / (xyz @ np.ones(3))
    f = np.where(scaled > 0.008856, np.cbrt(scaled), 7.787 * scaled + 16.0 / 116.0)
    return np.array([116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])])


@pytest.mark.parametrize('name', SCHEMES)
@pytest.mark.parametrize('eyes', DICHROMATS)
def test_marks_differ_for_the_colour_blind(name, eyes) -> None:
    seen = {mark: lab(np.array(DICHROMATS[eyes]) @ linear(SCHEMES[name][mark]))
            for mark in MARKS if mark not in ('truth', 'axis')}
    for one, other in itertools.combinations(seen, 2):
        assert np.linalg.norm(seen[one] - seen[other]) > 15.0, (one, other)
