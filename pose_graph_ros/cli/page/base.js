// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// What all parts of the pages use: elements, colours, numbers as people read them, the looks of
// states, and the one place that knows which time and which measurement the reader looks at.

const DATA = JSON.parse(document.getElementById('data').textContent);
const STATES = DATA.states;
const isPaper = () => document.documentElement.classList.contains('paper');
const CALM = matchMedia('(prefers-reduced-motion: reduce)');

// --- elements -----------------------------------------------------------------------------------

/** Make an element. Children are nodes or texts; a text never becomes HTML. */
function make(tag, properties, ...children) {
  return fill(document.createElement(tag), properties, children);
}

/** Make an element of an SVG picture. */
function draw(tag, properties, ...children) {
  return fill(document.createElementNS('http://www.w3.org/2000/svg', tag), properties, children);
}

function fill(node, properties, children) {
  for (const [name, value] of Object.entries(properties || {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith('on')) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? '' : value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return node;
}

/** Make a section of the page with a heading, and put it on the page. */
function section(id, title, lead) {
  const node = make('section', {id, 'aria-labelledby': `${id}-title`},
    make('h2', {id: `${id}-title`}, title), lead ? make('p', {class: 'lead'}, lead) : null);
  document.getElementById('main').append(node);
  return node;
}

/** A line that says why there is nothing to see. */
const nothing = (why) => make('p', {class: 'nothing'}, why);

/** A link to a place of the page. */
const linkTo = (id, text) => make('a', {href: `#${encodeURIComponent(id)}`}, text);

/** A table; the first cell of each row is its heading. */
function table(look, heads, rows) {
  return make('div', {class: `scrolls ${look}`}, make('table', {},
    make('thead', {}, make('tr', {}, heads.map((text) => make('th', {scope: 'col'}, text)))),
    make('tbody', {}, rows.map(tableRow))));
}

const tableRow = ([first, ...cells]) => make('tr', {},
  make('th', {scope: 'row'}, first), cells.map((cell) => make('td', {}, cell)));

// --- colours ------------------------------------------------------------------------------------

/** How to paint again what does not follow the colours and the size of the page by itself. */
const repaints = [];
let palette = {};

/** The value of a colour of page.css in the scheme that is shown. */
function colour(name) {
  if (name.startsWith('#')) return name;
  if (!(name in palette)) {
    const both = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);
    palette[name] = both.match(/#\w+/g)[Number(document.documentElement.dataset.scheme === 'dark')];
  }
  return palette[name];
}

/** Show the page light or dark. */
function setScheme(name) {
  document.documentElement.dataset.scheme = name;
  palette = {};
  for (const repaint of repaints) repaint();
}

/** How values become colours: from the least one to that which 98 % are below; null without any. */
function rampOf(values, text) {
  const sorted = (values || []).filter(known).sort((one, other) => one - other);
  const [low, high] = [sorted[0], sorted[Math.floor(0.98 * (sorted.length - 1))]];
  return sorted.length === 0 ? null : {values, low: text(low), high: text(high), colourOf: (value) => {
    if (!known(value)) return colour('refused');
    // in few steps, as each colour is painted at once
    const at = Math.round(32 * Math.min(1, Math.max(0, (value - low) / (high - low || 1)))) / 8;
    const k = Math.min(3, Math.floor(at));
    const [one, other] = [k, k + 1].map((step) => colour(`ramp${step}`).match(/\w\w/g).map(
      (part) => parseInt(part, 16)));
    return `#${one.map((part, c) => Math.round(part + (at - k) * (other[c] - part)).toString(16)
      .padStart(2, '0')).join('')}`;
  }};
}

// --- numbers ------------------------------------------------------------------------------------

const known = (value) => value !== null && value !== undefined && Number.isFinite(value);

/** A number with some significant digits, without useless zeros. */
function number(value, digits = 3) {
  if (!known(value)) return '–';
  const size = Math.abs(value);
  if (size >= 1e6 || (size < 1e-4 && size > 0)) {
    return value.toExponential(digits - 1).replace(/\.?0+e/, 'e').replace('e+', 'e');
  }
  if (size >= 1000) return Math.round(value).toLocaleString('en-US').replace(/,/g, '\u202f');
  return String(Number(value.toPrecision(digits)));
}

const length = (metres) => `${number(metres)} m`;
const degrees = (radians) => (known(radians) ? (radians * 180) / Math.PI : null);

/** Seconds since the start, as `12.3 s` or `2:03.4` or `1:02:03`. */
function clock(seconds, digits = 1) {
  if (!known(seconds)) return '–';
  if (DATA.by_node) return `node ${Math.round(seconds + Number(DATA.start_ns) * 1e-9)}`;
  if ((DATA.duration || 0) < 120) return `${seconds.toFixed(digits)} s`;
  const ticks = Math.round(Math.abs(seconds) * 10 ** digits);
  const rest = ((ticks / 10 ** digits) % 60).toFixed(digits);
  const minutes = Math.floor(ticks / 10 ** digits / 60);
  const head = minutes < 60 ? `${minutes}`
    : `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, '0')}`;
  return `${seconds < 0 ? '-' : ''}${head}:${rest.padStart(digits > 0 ? digits + 3 : 2, '0')}`;
}

const clockUnit = () => (DATA.by_node ? 'node' : (DATA.duration || 0) < 120 ? 's'
  : (DATA.duration < 3600 ? 'min:s' : 'h:min:s'));

/** The time of day of a time since the start, if the stamps are of this epoch. */
function timeOfDay(seconds) {
  const start = DATA.start ? Date.parse(DATA.start) : NaN;
  if (!Number.isFinite(start) || !known(seconds)) return null;
  return `${new Date(start + seconds * 1000).toISOString().slice(11, 21)} UTC`;
}

/** `1 closure`, `2 closures`. */
const counted = (count, one, many = `${one}s`) => `${number(count, 6)} ${count === 1 ? one : many}`;

/** The smallest and the largest of all known values. */
function extent(...columns) {
  const all = columns.flatMap((column) => (column || []).filter(known));
  return all.length === 0 ? null : [Math.min, Math.max].map((most) => all.reduce((one, other) => most(one, other)));
}

// --- looks --------------------------------------------------------------------------------------

// States differ by colour, shape and dashes, so that no one needs the colours. Shapes are paths
// of SVG around (0, 0), in pixels; `open` ones are not filled.
const CIRCLE = 'M-3.6,0a3.6,3.6 0 1,0 7.2,0a3.6,3.6 0 1,0 -7.2,0Z';
const LOOKS = [
  {colour: 'believed', shape: CIRCLE, dash: []},
  {colour: 'believed', shape: CIRCLE, open: true, dash: [9, 4]},
  {colour: 'waiting', shape: 'M0,-4.6L4.3,3.2H-4.3Z', open: true, dash: [2, 4]},
  {colour: 'doubted', shape: 'M-3.8,-3.8L3.8,3.8M-3.8,3.8L3.8,-3.8', open: true, dash: [7, 3, 2, 3]},
  {colour: 'refused', shape: 'M-3.6,-3.6H3.6V3.6H-3.6Z', open: true, dash: [3, 3]},
  {colour: 'held-out', shape: 'M0,-5L4.2,0L0,5L-4.2,0Z', dash: [12, 3]},
];
const [BELIEVED, WEAK, WAITING, DOUBTED, REFUSED, HELD_OUT] = LOOKS.keys();
const lookOf = (state) => LOOKS[state] || LOOKS[0];

const LEVELS = {
  failed: ['Failed', 'M8,2a6,6 0 1,0 0.01,0Z M5.6,5.6L10.4,10.4M5.6,10.4L10.4,5.6'],
  warning: ['Warning', 'M8,1.5L15,14H1Z M8,6V10 M8,11.6V12.4'],
  notice: ['Notice', 'M8,2a6,6 0 1,0 0.01,0Z M8,7V11.4 M8,4.6V5.4'],
  good: ['Good', 'M8,2a6,6 0 1,0 0.01,0Z M5,8.2L7.2,10.4L11.2,5.8']};

/** The sign of a level. */
const sign = (level) => draw('svg', {class: 'sign', viewBox: '0 0 16 16', 'aria-hidden': 'true'},
  draw('path', {d: LEVELS[level][1]}));

/** A small picture of a mark or of a line, for lists. */
function swatch({colour: name, shape, dash, width, area, open}) {
  const stroke = `var(--${name})`;
  return draw('svg', {class: 'swatch', viewBox: '-13 -7 26 14', 'aria-hidden': 'true'},
    area ? draw('rect', {x: -11, y: -5, width: 22, height: 10, rx: 2, fill: stroke,
      'fill-opacity': area}) : null,
    dash ? draw('line', {x1: -12, x2: 12, y1: 0, y2: 0, stroke, 'stroke-width': width || 1.6,
      'stroke-dasharray': dash.join(' ')}) : null,
    shape ? draw('path', {d: shape, stroke, 'stroke-width': 1.7,
      fill: open ? 'var(--surface)' : stroke}) : null);
}

// --- what the reader looks at -------------------------------------------------------------------

const focus = {time: null, item: null, spans: []};
// the part of the drive that the map shows [s]
const shownTime = {from: -Infinity, to: Infinity};
const isShownTime = (time) => !known(time) || (time >= shownTime.from && time <= shownTime.to);
const followers = {time: [], item: [], print: []};

/** Let all charts and the map mark a time [s]. */
function lookAtTime(time) {
  if (focus.time === time || !known(time)) return;
  focus.time = time;
  for (const follow of followers.time) follow(time);
}

/** Let the map and the panel show a measurement, or none. */
function lookAtItem(item) {
  focus.item = item;
  focus.spans = [];
  for (const follow of followers.item) follow(item);
}

// --- head, foot and paper -----------------------------------------------------------------------

/** Which tool made the page, its title and what is below it, a button for the scheme, and facts. */
function showTop(maker, subtitle) {
  const root = document.documentElement;
  const dark = matchMedia('(prefers-color-scheme: dark)');
  const toggle = make('button', {type: 'button', id: 'scheme'});
  const use = (name) => {
    setScheme(name);
    toggle.textContent = name === 'dark' ? 'Light' : 'Dark';
    toggle.setAttribute('aria-label', `Show the page ${name === 'dark' ? 'light' : 'dark'}`);
  };
  const follow = () => use(dark.matches ? 'dark' : 'light');
  toggle.addEventListener('click', () => {
    dark.removeEventListener('change', follow);
    use(root.dataset.scheme === 'dark' ? 'light' : 'dark');
    remembered((store) => store.setItem('pose-graph-scheme', root.dataset.scheme));
  });
  const chosen = remembered((store) => store.getItem('pose-graph-scheme'));
  if (chosen === 'dark' || chosen === 'light') use(chosen);
  else {
    dark.addEventListener('change', follow);
    follow();
  }
  document.getElementById('head').append(
    make('div', {class: 'title'}, make('p', {class: 'subtitle'}, maker),
      make('h1', {}, DATA.title || 'report'), make('p', {class: 'subtitle'}, subtitle)), toggle);
  document.getElementById('main').append(make('dl', {class: 'facts'}, (DATA.facts || []).map(
    ({label, value, note}) => make('div', {class: 'card'}, make('dt', {}, label),
      make('dd', {}, value), make('dd', {class: 'note'}, note || '')))));
  document.getElementById('foot').append(make('p', {},
    `Made by ${maker}. This file holds all its data, and loads nothing.`));
}

/** Ask what the browser keeps for the reader; some keep nothing for files, and raise an error. */
function remembered(ask) {
  try {
    return ask(window.localStorage);
  } catch {
    return null;
  }
}

// on paper a page is light and has all findings, whatever it is on the screen
let [onScreen, folded] = [null, []];
const print = (begins) => {
  document.documentElement.classList.toggle('paper', begins);
  if (begins) {
    onScreen = document.documentElement.dataset.scheme;
    folded = [...document.querySelectorAll('details.good:not([open])')];
  }
  for (const each of folded) each.open = begins;
  for (const follow of followers.print) follow(begins);
  setScheme(begins ? 'light' : onScreen);
};
window.addEventListener('beforeprint', () => print(true));
window.addEventListener('afterprint', () => print(false));
