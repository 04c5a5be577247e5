// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// What all parts of the page use: elements, numbers as people read them, ticks, colours, and the
// one place that knows which time and which measurement the reader looks at.

const DATA = JSON.parse(document.getElementById('data').textContent);
const STATES = DATA.states ||
  ['believed', 'believed weakly', 'waiting', 'doubted', 'refused', 'held out'];
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
    else if (name === 'style') styleOf(node, value);
    else node.setAttribute(name, value === true ? '' : value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return node;
}

function styleOf(node, values) {
  for (const [name, value] of Object.entries(values)) node.style.setProperty(name, value);
}

/** Make a section of the page with a heading, and put it on the page. */
function section(id, title, lead) {
  const node = make('section', {id, 'aria-labelledby': `${id}-title`, tabindex: '-1'},
    make('h2', {id: `${id}-title`}, title), lead ? make('p', {class: 'lead'}, lead) : null);
  document.getElementById('main').append(node);
  return node;
}

/** A line that says why there is nothing to see. */
function nothing(why) {
  return make('p', {class: 'nothing'}, why);
}

/** Scroll to an element of the page and let the keyboard go on from there. */
function goTo(node) {
  if (!node) return;
  node.scrollIntoView({behavior: CALM.matches ? 'auto' : 'smooth', block: 'start'});
  node.focus({preventScroll: true});
}

/** An element for a canvas that follows its size and the resolution of the screen. */
function canvasIn(host, properties, paint) {
  const canvas = make('canvas', properties);
  host.append(canvas);
  const context = canvas.getContext('2d');
  const surface = {canvas, context, width: 0, height: 0, due: false};
  surface.paint = (ratio = window.devicePixelRatio || 1) => {
    surface.due = false;
    surface.width = canvas.clientWidth;
    surface.height = canvas.clientHeight;
    const [width, height] = [surface.width, surface.height].map((size) => Math.round(size * ratio));
    if (width === 0 || height === 0) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width, height});
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, surface.width, surface.height);
    paint(surface);
  };
  surface.later = () => {
    if (!surface.due) requestAnimationFrame(() => surface.paint());
    surface.due = true;
  };
  new ResizeObserver(surface.later).observe(canvas);
  surfaces.push(surface);
  return surface;
}

const surfaces = [];

// --- colours ------------------------------------------------------------------------------------

let palette = {};

/** The value of a colour of report.css in the scheme that is shown. */
function colour(name) {
  if (!(name in palette)) {
    palette[name] = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
  }
  return palette[name];
}

/** Show the page light or dark. */
function setScheme(name) {
  document.documentElement.dataset.scheme = name;
  palette = {};
  for (const surface of surfaces) {
    if (surface.reset) surface.reset();
    surface.paint();
  }
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

/** A length in the unit in which it is easily read. */
function length(metres, digits = 3) {
  if (!known(metres)) return '–';
  const size = Math.abs(metres);
  if (size >= 1000) return `${number(metres / 1000, digits)} km`;
  if (size < 0.01 && size > 0) return `${number(metres * 1000, digits)} mm`;
  if (size < 1 && size > 0) return `${number(metres * 100, digits)} cm`;
  return `${number(metres, digits)} m`;
}

const degrees = (radians) => (radians * 180) / Math.PI;

/** Seconds since the start, as `12.3 s` or `2:03.4` or `1:02:03`. */
function clock(seconds, digits = 1) {
  if (!known(seconds)) return '–';
  if ((DATA.duration || 0) < 120) return `${seconds.toFixed(digits)} s`;
  const ticks = Math.round(Math.abs(seconds) * 10 ** digits);
  const rest = (ticks / 10 ** digits) % 60;
  const minutes = Math.floor(ticks / 10 ** digits / 60);
  const tail = rest.toFixed(digits).padStart(digits > 0 ? digits + 3 : 2, '0');
  const head = minutes < 60 ? `${minutes}`
    : `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, '0')}`;
  return `${seconds < 0 ? '-' : ''}${head}:${tail}`;
}

const clockUnit = () => ((DATA.duration || 0) < 120 ? 's'
  : (DATA.duration < 3600 ? 'min:s' : 'h:min:s'));

/** The time of day of a time since the start, if the stamps are of this epoch. */
function timeOfDay(seconds) {
  const start = DATA.start ? Date.parse(DATA.start) : NaN;
  if (!Number.isFinite(start) || !known(seconds)) return null;
  return `${new Date(start + seconds * 1000).toISOString().slice(11, 21)} UTC`;
}

/** `1 closure`, `2 closures`. */
const counted = (count, one, many = `${one}s`) => `${number(count, 6)} ${count === 1 ? one : many}`;

// --- ticks --------------------------------------------------------------------------------------

/** The step of 1, 2 or 5 times a power of ten that is at least this large. */
function niceStep(step) {
  const power = 10 ** Math.floor(Math.log10(step));
  return [1, 2, 5, 10].map((each) => each * power).find((each) => each >= step * 0.9999);
}

/** Values for about `count` ticks on an axis from low to high. */
function ticks(low, high, count) {
  const step = niceStep((high - low) / Math.max(count, 1));
  return multiples(step, low, high);
}

function multiples(step, low, high) {
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k <= high / step + 1e-9; k += 1) {
    found.push(Number((k * step).toPrecision(12)));
  }
  return found;
}

/** The same for seconds, in steps of minutes where these are many. */
function timeTicks(low, high, count) {
  const span = (high - low) / Math.max(count, 1);
  const steps = [60, 120, 300, 600, 900, 1800, 3600, 7200, 18000, 36000, 86400];
  if ((DATA.duration || 0) < 120 || span < 5) return ticks(low, high, count);
  return multiples([5, 10, 20, 30, ...steps].find((each) => each >= span) || span, low, high);
}

/** The same for an axis that is logarithmic: powers of ten, and 2 and 5 of each if they are few. */
function logTicks(low, high, count) {
  const [first, last] = [Math.floor(Math.log10(low)), Math.ceil(Math.log10(high))];
  const every = Math.max(1, Math.ceil((last - first) / Math.max(count, 1)));
  const factors = last - first <= count / 2.5 ? [1, 2, 5] : [1];
  const found = [];
  for (let power = first; power <= last; power += every) {
    for (const factor of factors) {
      const value = Number((factor * 10 ** power).toPrecision(3));
      if (value >= low * 0.999 && value <= high * 1.001) found.push(value);
    }
  }
  return found;
}

/** The smallest and the largest of all known values. */
function extent(...columns) {
  let [low, high] = [Infinity, -Infinity];
  for (const column of columns) {
    for (const value of column || []) {
      if (known(value) && value < low) low = value;
      if (known(value) && value > high) high = value;
    }
  }
  return low <= high ? [low, high] : null;
}

/** The place in an ascending column of the value nearest to one. */
function nearest(column, value) {
  let [low, high] = [0, column.length - 1];
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (column[middle] <= value) low = middle; else high = middle;
  }
  return value - column[low] <= column[high] - value ? low : high;
}

// --- what the reader looks at -------------------------------------------------------------------

const focus = {time: null, item: null};
const followers = {time: [], item: []};

/** Let all charts and the map mark a time [s], or none. */
function lookAtTime(time) {
  if (focus.time === time) return;
  focus.time = time;
  for (const follow of followers.time) follow(time);
}

/** Let the map and the panel show a measurement, or none. */
function lookAtItem(item) {
  focus.item = item;
  for (const follow of followers.item) follow(item);
}
