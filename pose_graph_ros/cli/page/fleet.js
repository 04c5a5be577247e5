// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// The page of a fleet: a table of its drives, to sort and to filter, the worst first.

const PORTION = 200; // rows that are put into the table at once
const whole = (value) => number(value, 6);
const metres = (value) => (known(value) ? value.toFixed(2) : '–');

// --- columns ------------------------------------------------------------------------------------

/** The map and the name, which lead to the report if there is one. */
const driveOf = ({name = '', bag, link, map, size}) => make(link ? 'a' : 'div', {
  class: 'drive', href: link},
  draw('svg', {viewBox: '-3 -3 106 70', 'aria-hidden': 'true'}, map ? [
    draw('title', {}, `${length(size[0])} wide, ${length(size[1])} high`),
    draw('polyline', {points: map})] : null),
  make('span', {}, make('b', {}, name.split(/(?<=[_/.-])/).flatMap((part) => [part, make('wbr')])),
    make('small', {title: bag}, bag)));

/** The worst that was found, and how much more. */
function findingOf({status, level, why, warnings, notices}) {
  const more = warnings + notices > 1 ? [warnings && counted(warnings, 'warning'),
    notices && counted(notices, 'notice')].filter((text) => text).join(', ') : null;
  const [name, look] = status === 'converged' ? [LEVELS[level][0], 'unseen']
    : [status[0].toUpperCase() + status.slice(1), 'status'];
  return make('div', {class: 'finding', 'data-level': level}, sign(level), make('div', {},
    make('b', {class: look}, `${name}: `), why, more ? make('small', {}, more) : null));
}

const parametersOf = ({parameters}) => Object.entries(JSON.parse(parameters || '{}')).map(
  ([name, value]) => make('div', {}, `${name} ${typeof value === 'string' ? value : JSON.stringify(value)}`));

/** Key, head, what a cell shows, and what the head says more. */
const COLUMNS = [
  ['name', 'drive', driveOf],
  ['rank', 'finding', findingOf, 'Failed, not converged, then by warnings, notices and error'],
  ['parameters', 'parameters', parametersOf],
  ['start', 'start [UTC]', ({start}) => start || '–'],
  ['duration_s', `duration [${clockUnit()}]`, (row) => clock(row.duration_s, 0)],
  ['length_m', 'length [m]', number],
  ['truth_rms_m', 'error, rms [m]', metres, 'Distance to the truth'],
  ['truth_p95_m', 'error, 95\u00a0%\u00a0[m]', metres, 'Distance to the truth that 95 % are below'],
  ['truth_heading_rms_deg', 'heading, rms [°]', metres, 'Difference to the heading of the truth'],
  ['held_out_rms_m', 'held out, rms [m]', metres, 'Distance to the fixes held out'],
  ['held_out_p95_m', 'held out, 95\u00a0%\u00a0[m]', metres,
    'Distance to the fixes held out that 95 % are below'],
  ['fixes_believed', 'fixes believed', whole],
  ['fixes_doubted', 'fixes doubted', whole],
  ['closures_believed', 'closures believed', whole],
  ['closures_doubted', 'closures doubted', whole],
  ['chi2_per_degree', 'chi2 / degree', number, 'chi2 per degree of freedom; 1 if all covariances are right'],
  ['nees_position', 'NEES position', number, '2 if the covariances of positions are right'],
  ['nees_pose', 'NEES pose', number, '3 if the covariances of poses are right'],
  ['total_s', 'time to run [s]', number],
  ['peak_memory_mb', 'memory [MB]', number],
].filter(([key]) => DATA.rows.some((row) => key === 'rank' || row[key] !== undefined)).map(
  ([key, head, show, hint]) => ({key, head, hint, cell: show === number || show === whole
    || show === metres ? (row) => show(row[key]) : show}));

// --- which drives, in which order -----------------------------------------------------------------

const LEVEL_NAMES = Object.keys(LEVELS);
const {compare} = new Intl.Collator('en', {numeric: true});
DATA.rows.forEach((row, rank) => Object.assign(row, {
  rank, searched: [row.name, row.bag, row.why, row.parameters].join('\n').toLowerCase()}));

/** What the address of the page asks for. */
function readHash() {
  const asked = new URLSearchParams(location.hash.slice(1));
  const sort = asked.get('sort');
  return {text: asked.get('text') || '', down: asked.has('down'),
    levels: LEVEL_NAMES.filter((level) => !asked.has('show')
      || asked.get('show').split(',').includes(level)),
    key: COLUMNS.some(({key}) => key === sort) ? sort : 'rank'};
}

function writeHash({text, levels, key, down}) {
  const asked = new URLSearchParams({...(text ? {text} : {}),
    ...(levels.length < LEVEL_NAMES.length ? {show: levels.join(',')} : {}),
    ...(key !== 'rank' ? {sort: key} : {}), ...(down ? {down: ''} : {})}).toString();
  history.replaceState(null, '', location.href.split('#')[0] + (asked ? `#${asked}` : ''));
}

/** The drives that are asked for; what is unknown is last either way. */
function listOf({text, levels, key, down}) {
  const words = text.toLowerCase().split(/\s+/);
  return DATA.rows.filter(({level, searched}) => levels.includes(level)
    && words.every((word) => searched.includes(word))).sort((one, other) => {
    const [a, b] = [one[key], other[key]];
    if (a === undefined || b === undefined) return (a === undefined) - (b === undefined);
    return (down ? -1 : 1) * (typeof a === 'string' ? compare(a, b) : a - b);
  });
}

// --- the page -----------------------------------------------------------------------------------

/** The points of a sweep. */
function showPoints() {
  const names = [...new Set(DATA.points.flatMap(({parameters}) => Object.keys(parameters)))];
  const host = section('points', 'Settings, best first');
  host.append(table('errors card', [...names, 'drives', 'failed', 'mean', 'spread', 'worst',
    'worse than the best by', 'standard error'], DATA.points.map((point) => [
    ...names.map((name) => String(point.parameters[name] ?? '–')), whole(point.drives),
    whole(point.failed), ...[point.mean, point.spread, point.worst, point.worse_by,
      point.standard_error].map((value) => number(value))])));
  host.querySelector('table').prepend(make('caption', {}, DATA.subtitle));
}

function showDrives() {
  const cut = DATA.all - DATA.rows.length;
  const host = section('drives', 'Drives', cut > 0 ? `The worst ${whole(DATA.rows.length)} of ${
    whole(DATA.all)} drives; drives.parquet has them all.` : null);
  if (DATA.rows.length === 0) return host.append(nothing('There are no drives.'));
  let [view, listed, shown, waiting] = [readHash(), [], 0, null];
  const change = (changes) => {
    view = {...view, text: text.value.trim(), ...changes};
    update();
    writeHash(view);
  };
  const text = make('input', {type: 'search', placeholder: 'Filter: words of name, path or finding',
    'aria-label': 'Filter by words of name, path or finding', oninput: () => {
      clearTimeout(waiting);
      waiting = setTimeout(() => change({}), 100);
    }});
  const boxes = LEVEL_NAMES.map((level) => make('input', {type: 'checkbox', value: level,
    onchange: () => change({levels: boxes.filter((box) => box.checked).map((box) => box.value)})}));
  const told = make('output', {});
  const frame = table('drives card', COLUMNS.map(({key, head, hint}) => [make('button', {
    type: 'button', class: 'plain', title: hint, onclick: () => change({key, down: key === view.key
      ? !view.down : key !== 'rank' && DATA.rows.some((row) => typeof row[key] === 'number')})}, head),
  // Chromium repeats the heads on each sheet without their buttons
  make('span', {class: 'printed'}, head)]), []);
  const more = make('button', {type: 'button', class: 'more', onclick: add});
  const none = nothing('No drive is as asked for.');
  frame.append(more);
  host.append(make('div', {class: 'filters', role: 'search'}, text, boxes.map((box) => make('label', {
    'data-level': box.value}, box, sign(box.value), `${LEVELS[box.value][0]} `, make('b', {}, whole(
    DATA.rows.filter(({level}) => level === box.value).length)))), told), none, frame);
  const heads = [...frame.querySelectorAll('thead th')];
  const body = frame.querySelector('tbody');

  function add() {
    body.append(...listed.slice(shown, shown + PORTION).map((row) => tableRow(COLUMNS.map(
      ({cell}) => cell(row)))));
    shown = Math.min(shown + PORTION, listed.length);
    more.hidden = shown === listed.length;
    more.textContent = `Show more of the other ${whole(listed.length - shown)}`;
  }

  function update() {
    if (text.value.trim() !== view.text) text.value = view.text;
    for (const box of boxes) box.checked = view.levels.includes(box.value);
    heads.forEach((head, k) => (COLUMNS[k].key === view.key
      ? head.setAttribute('aria-sort', view.down ? 'descending' : 'ascending')
      : head.removeAttribute('aria-sort')));
    [listed, shown] = [listOf(view), 0];
    body.replaceChildren();
    frame.scrollTop = 0;
    [frame.hidden, none.hidden] = [listed.length === 0, listed.length > 0];
    told.textContent = `${whole(listed.length)} of ${counted(DATA.rows.length, 'drive')}`;
    add();
  }

  update();
  new IntersectionObserver((seen) => seen.some(({isIntersecting}) => isIntersecting) && add())
    .observe(more);
  // not of the link that skips the head, which is a place and no view
  return window.addEventListener('hashchange', () => {
    if (location.hash === '' || location.hash.includes('=')) {
      view = readHash();
      update();
    }
  });
}

showTop('pose-graph fleet', DATA.subtitle);
if (DATA.points.length > 0) showPoints();
showDrives();
