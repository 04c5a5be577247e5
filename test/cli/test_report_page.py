# Copyright 2026 The pose_graph_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The page of a report in a real browser: what a reader sees, clicks and is told."""

from collections.abc import Iterator
from dataclasses import dataclass, field
import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import time
from typing import Any

import numpy as np
import pytest
from report_data import example

from pose_graph_ros.cli.main import main
from pose_graph_ros.cli.report import render
from pose_graph_ros.core.geometry.se2 import FloatArray

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable')
WIDE, NARROW = 1400, 400
HOSTILE = '</script><img src=x onerror="window.hacked=1"><!--\u2028{{data}}&amp;$&'


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


@dataclass
class Opened:
    """A page, and what went wrong or left the machine while it was open."""

    page: Any
    troubles: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

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

    def until(self, expression: str) -> None:
        """Wait until an expression is true; what playwright has for this needs eval()."""
        for _ in range(200):
            if self.page.evaluate(expression):
                return
            self.page.wait_for_timeout(20)
        pytest.fail(f'never: {expression}')

    def settle(self) -> None:
        """Wait until what was asked for has been painted."""
        self.page.evaluate('new Promise((done) => requestAnimationFrame('
                           '() => requestAnimationFrame(done)))')

    def overflow(self) -> int:
        return int(self.page.evaluate('document.scrollingElement.scrollWidth - innerWidth'))


def executable() -> str:
    # (Ubuntu's chromium-browser only says that there is a snap)
    found = next((path for path in filter(None, map(shutil.which, BROWSERS)) if subprocess.run(
        [path, '--version'], capture_output=True, check=False).returncode == 0), None)
    if found is None:
        missing('no browser; do: apt install chromium (on Ubuntu, google-chrome from its maker)')
    return str(found)


def missing(reason: str) -> None:
    """Skip, or fail where continuous integration should have installed it."""
    if os.environ.get('CI'):
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope='module')
def browser() -> Iterator[Any]:
    try:
        from playwright.sync_api import sync_playwright  # noqa: PLC0415
    except ImportError:
        missing('no playwright: pip install playwright')
    with sync_playwright() as tool:
        options = ['--no-sandbox'] if os.geteuid() == 0 else []
        chromium = tool.chromium.launch(executable_path=executable(), args=options)
        yield chromium
        chromium.close()


@pytest.fixture(scope='module')
def real(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Data of a simulated drive with false loop closures, as replay writes them."""
    folder = tmp_path_factory.mktemp('drive')
    bag, run = str(folder / 'bag'), folder / 'run'
    assert main(['simulate', bag, '--world', 'grid', '--duration', '200', '--fix-period', '4',
                 '--false-rate', '0.15']) == 0
    assert main(['replay', bag, '-o', str(run), '--odom', '/odom', '--truth', '/ground_truth',
                 '--hold-out', '5']) == 0
    found: dict[str, Any] = json.loads((run / 'run.json').read_text(encoding='utf-8'))
    return found


@pytest.fixture(scope='module')
def made() -> dict[str, Any]:
    """Data with marks of all states and all sections."""
    return example()


class Opener:
    """Opens pages, and looks at the end whether they had troubles."""

    def __init__(self, browser: Any, folder: Path) -> None:
        self.browser, self.folder, self.opened = browser, folder, []

    def __call__(self, data: dict[str, Any], width: int = WIDE, **options: Any) -> Opened:
        file = self.folder / f'page{len(self.opened)}.html'
        file.write_text(render(data), encoding='utf-8')
        touch = {'has_touch': True, 'is_mobile': True} if width == NARROW else {}
        context = self.browser.new_context(
            viewport={'width': width, 'height': 900}, reduced_motion='reduce', **touch, **options)
        opened = Opened(context.new_page())
        opened.page.set_default_timeout(10_000)
        opened.page.on('pageerror', lambda error: opened.troubles.append(str(error)))
        opened.page.on('console', lambda message: opened.troubles.append(message.text))
        opened.page.on('request', lambda request: opened.requests.append(request.url))
        opened.page.goto(file.as_uri())
        opened.settle()
        self.opened.append(opened)
        return opened

    def close(self) -> None:
        for opened in self.opened:
            opened.page.context.close()
            assert opened.troubles == []
            assert [url for url in opened.requests if not url.startswith(('file:', 'data:'))] == []
            assert len(opened.requests) <= 2        # itself, and its icon, which is empty


@pytest.fixture
def show(browser: Any, tmp_path: Path) -> Iterator[Opener]:
    opener = Opener(browser, tmp_path)
    yield opener
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
