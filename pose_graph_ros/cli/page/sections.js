// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// The other sections: the head, errors over time, springs, updates, and the matrices.

const LEVELS = {warning: 'Warning', notice: 'Notice', good: 'Good'};
const LEVEL_SIGNS = {
  warning: 'M8,1.5L15,14H1Z M8,6V10 M8,11.6V12.4', notice: 'M8,2a6,6 0 1,0 0.01,0Z M8,7V11.4 M8,4.6V5.4',
  good: 'M8,2a6,6 0 1,0 0.01,0Z M5,8.2L7.2,10.4L11.2,5.8'};

/** Title, facts and findings. */
function showHead() {
  const head = document.getElementById('head');
  const when = DATA.start ? `${DATA.start.slice(0, 10)} ${DATA.start.slice(11, 19)} UTC` : null;
  const toggle = make('button', {type: 'button', id: 'scheme', class: 'plain'});
  const wide = matchMedia('(prefers-color-scheme: dark)');
  const use = (dark) => {
    setScheme(dark ? 'dark' : 'light');
    toggle.textContent = dark ? 'Light' : 'Dark';
    toggle.setAttribute('aria-label', `Show the page ${dark ? 'light' : 'dark'}`);
  };
  let chosen = false;
  toggle.addEventListener('click', () => {
    chosen = true;
    use(document.documentElement.dataset.scheme !== 'dark');
  });
  wide.addEventListener('change', () => { if (!chosen) use(wide.matches); });
  use(wide.matches);
  head.append(
    make('div', {class: 'title'}, make('p', {class: 'brand'}, 'pose-graph report'),
      make('h1', {}, DATA.title || 'report'),
      make('p', {class: 'subtitle'}, [DATA.subtitle, when].filter((text) => text).join(' · '))),
    toggle);
  const facts = DATA.facts || [];
  // as many columns as leave the fewest places empty
  const empty = (count) => (count - (facts.length % count)) % count;
  const columns = [7, 6, 5, 4].reduce((one, other) => (empty(other) < empty(one) ? other : one));
  document.getElementById('main').append(
    make('dl', {class: 'facts', style: {'--columns': columns}}, facts.map(({label, value, note}) => make(
      'div', {class: 'card'}, make('dt', {}, label), make('dd', {}, value),
      note ? make('dd', {class: 'note'}, note) : null))));
  showFindings();
}

/** What a person must know; what is as it should be is folded away, unless there is nothing else. */
function showFindings() {
  const all = DATA.findings || [];
  const isGood = ({level}) => level === 'good';
  const [good, others] = [all.filter(isGood), all.filter((each) => !isGood(each))];
  const host = make('div', {id: 'findings', role: 'region', 'aria-label': 'Findings'});
  if (others.length > 0) host.append(make('ul', {class: 'findings'}, others.map(findingOf)));
  if (good.length > 0) {
    host.append(make('details', {class: 'good', open: others.length === 0},
      make('summary', {}, others.length > 0
        ? `${counted(good.length, 'thing')} ${good.length === 1 ? 'is as it' : 'are as they'} should be`
        : 'All that was checked is as it should be'),
      make('ul', {class: 'findings'}, good.map(findingOf))));
  }
  if (all.length > 0) document.getElementById('main').append(host);
}

function findingOf({level, text, anchor}) {
  const body = make('span', {}, make('b', {class: 'unseen'}, `${LEVELS[level] || 'Notice'}: `), text);
  const sign = draw('svg', {viewBox: '0 0 16 16', 'aria-hidden': 'true'}, draw('path', {
    d: LEVEL_SIGNS[level] || LEVEL_SIGNS.notice, fill: 'none', stroke: 'currentColor',
    'stroke-width': 1.6, 'stroke-linejoin': 'round', 'stroke-linecap': 'round'}));
  const link = anchor ? make('a', {href: `#${encodeURIComponent(anchor)}`, onclick: (event) => {
    event.preventDefault();
    goTo(document.getElementById(anchor));
  }}, 'Show') : null;
  return make('li', {'data-level': level in LEVELS ? level : 'notice'}, sign, body, link);
}

/** Links to the sections of the page. */
function showContents() {
  const names = {map: 'Map', errors: 'Errors', sources: 'Residuals', springs: 'Springs',
    updates: 'Updates', sparsity: 'Matrices'};
  document.getElementById('contents').append(make('ul', {}, Object.entries(names).map(
    ([id, name]) => make('li', {}, make('a', {href: `#${id}`, onclick: (event) => {
      event.preventDefault();
      goTo(document.getElementById(id));
    }}, name)))));
}

// --- errors -------------------------------------------------------------------------------------

/** Position and heading errors over time with what was claimed of them. */
function showErrors() {
  const {errors} = DATA;
  const host = section('errors', 'Errors over time');
  if (!errors || errors.t.length === 0) {
    host.append(nothing('No errors over time: the run had no truth, and no fixes were held out '
      + '(--truth, --hold-out).'), ...errorTable(DATA.error_table));
    return;
  }
  host.append(make('p', {class: 'lead'}, `Distance to ${errors.against === 'truth' ? 'the truth'
    : String(errors.against)}. The band is what the covariances claim: 95 % of errors should be `
    + 'in it.'));
  const marks = [];
  if (errors.sigma) {
    const high = errors.sigma.map((sigma) => (known(sigma) ? 2 * sigma : null));
    marks.push({kind: 'band', x: errors.t, high, low: high.map((value) => known(value) ? 1e-9 : null),
      colour: 'path', name: 'claimed, 2 sigma'});
  }
  if (errors.odometry) {
    marks.push({kind: 'line', x: errors.t, y: errors.odometry, colour: 'odometry', dash: [6, 4],
      name: 'odometry, aligned'});
  }
  marks.push({kind: 'line', x: errors.t, y: errors.position, colour: 'path', width: 1.9,
    name: 'corrected path'});
  const top = (column) => (extent(column || []) || [0, 0])[1];
  const log = top(errors.odometry) > 5 * top(errors.position);
  const time = {label: `time [${clockUnit()}]`, time: true, domain: [0, DATA.duration || 1]};
  const charts = make('div', {class: 'charts wide'});
  host.append(charts);
  makeChart(charts, {title: 'Position', marks, x: time, height: 260,
    y: {label: log ? 'error [m], logarithmic' : 'error [m]', log,
      floor: Math.max(0.002, top(errors.position) / 300), readOut: (value) => length(value)}});
  if (errors.heading && errors.heading.some(known)) {
    makeChart(charts, {title: 'Heading', height: 260, x: time, y: {label: 'error [degrees]',
      readOut: (value) => `${number(value)}°`}, marks: [{kind: 'line', x: errors.t, width: 1.6,
      y: errors.heading.map((value) => (known(value) ? degrees(value) : null)), colour: 'path',
      name: 'corrected path'}]});
  }
  host.append(...errorTable(DATA.error_table));
}

const ERROR_COLUMNS = {median: 'median', rms: 'rms', p95: '95 %', maximum: 'largest', count: 'of'};

/** The table of distances between paths and what they are compared with, if there is one. */
function errorTable(rows) {
  if (!rows || rows.length === 0) return [];
  const shown = Object.keys(ERROR_COLUMNS).filter((name) => rows.some((row) => known(row[name])));
  const cell = (row, name) => {
    if (name === 'count' || !known(row[name])) return number(row[name], 6);
    return row[name].toFixed(2) + (row.unit === 'deg' ? '°' : '');
  };
  return [make('div', {class: 'card table scrolls'}, make('table', {class: 'errors'},
    make('thead', {}, make('tr', {}, make('th', {scope: 'col'}, 'distance [m]'), shown.map(
      (name) => make('th', {scope: 'col'}, ERROR_COLUMNS[name])))),
    make('tbody', {}, rows.map((row) => make('tr', {}, make('th', {scope: 'row'}, row.name),
      shown.map((name) => make('td', {}, cell(row, name))))))))];
}

// --- springs ------------------------------------------------------------------------------------

/** The constraints under most tension; a click shows them on the map. */
function showSprings(map) {
  const host = section('springs', 'Springs under most tension',
    'Constraints as springs between poses: the energy is what each adds to chi2, and the mark in '
    + 'its bar is what it adds on average if its covariance is right.');
  const springs = DATA.springs || [];
  if (springs.length === 0) {
    host.append(nothing('None: the graph has no constraints with a residual.'));
    return;
  }
  const most = Math.max(...springs.map(({energy, expected}) => Math.max(energy || 0, expected || 0)));
  host.append(make('ol', {class: 'springs'}, springs.map((spring) => {
    const {rank, name, kind, energy, expected, text} = spring;
    const item = itemOfSpring(spring);
    const bar = draw('svg', {class: 'bar', viewBox: '0 0 100 10', preserveAspectRatio: 'none',
      'aria-hidden': 'true'},
    draw('rect', {x: 0, y: 1, width: 100, height: 8, fill: 'var(--line)'}),
    draw('rect', {x: 0, y: 1, width: 100 * ((energy || 0) / most), height: 8, fill: 'var(--spring)'}),
    draw('rect', {x: 100 * ((expected || 0) / most) - 0.2, y: 0, width: 0.4, height: 10,
      fill: 'var(--ink)'}));
    const button = make('button', {type: 'button', class: 'entry', disabled: item.ends.length === 0,
      onclick: () => map.choose(item)},
    make('span', {class: 'rank'}, rank), make('span', {class: 'entry-name'}, name),
    make('span', {class: 'kind'}, kind), bar,
    make('span', {class: 'energy'}, make('b', {}, number(energy)), ` / ${number(expected)}`),
    text && text !== name ? make('span', {class: 'entry-why'},
      text.startsWith(name) ? text.slice(name.length).replace(/^[:,]? /, '') : text) : null);
    followers.item.push((chosen) => button.classList.toggle('chosen', sameItem(chosen, item)));
    return make('li', {}, button);
  })));
}

// --- updates ------------------------------------------------------------------------------------

/** How long updates took, chi2 and the size of the graph over the drive. */
function showUpdates() {
  const {updates} = DATA;
  const host = section('updates', 'Updates');
  if (!updates || updates.t.length === 0) {
    host.append(nothing('No updates were recorded in this run.'));
    return;
  }
  const times = updates.ms.filter(known).sort((one, other) => one - other);
  const share = (part) => times[Math.min(times.length - 1, Math.floor(part * times.length))];
  if (times.length > 0) {
    host.append(make('p', {class: 'lead'}, `${counted(updates.count || updates.t.length, 'update')}`
      + `: half took less `
      + `than ${number(share(0.5))} ms, 95 % less than ${number(share(0.95))} ms, the longest `
      + `${number(share(1))} ms.`));
  }
  const charts = make('div', {class: 'charts wide'});
  host.append(charts);
  const x = {label: `time of the drive [${clockUnit()}]`, time: true, domain: [0, DATA.duration || 1]};
  const wide = (column) => {
    const found = extent((column || []).filter((value) => value > 0));
    return found !== null && found[1] > 20 * found[0];
  };
  const period = known(updates.period) && updates.period < 20 * share(1)
    ? [{kind: 'rule', of: 'y', at: updates.period, colour: 'doubted', dash: [6, 4],
      name: `period of the node, ${number(updates.period)} ms`}] : [];
  makeChart(charts, {title: 'Time of an update', x, marks: [...period,
    {kind: 'dots', x: updates.t, y: updates.ms, colour: 'path', name: 'update',
      format: (value) => `${number(value)} ms`}],
  y: {label: wide(updates.ms) ? 'time [ms], logarithmic' : 'time [ms]', log: wide(updates.ms)}});
  const log = wide(updates.chi2);
  makeChart(charts, {title: 'chi2 of the graph', x, marks: [
    {kind: 'line', x: updates.t, y: updates.chi2, colour: 'odometry', name: 'chi2'},
    {kind: 'line', x: updates.t, y: updates.nodes, colour: 'path', dash: [6, 4],
      name: 'hidden nodes', format: (value) => number(value, 6)}],
  y: {label: log ? 'chi2, nodes, logarithmic' : 'chi2, nodes', log}});
}

// --- matrices -----------------------------------------------------------------------------------

/** Where H and its factor have blocks that are not zero. */
function showSparsity() {
  const host = section('sparsity', 'Sparsity of H and of its factor',
    'Each node is a row and a column. What the order of elimination leaves empty costs no time.');
  const matrices = DATA.sparsity || [];
  if (matrices.length === 0) {
    host.append(nothing('No matrices: the graph of this run is not there any more.'));
    return;
  }
  const row = make('div', {class: 'charts wide'});
  host.append(row);
  for (const matrix of matrices) showMatrix(row, matrix);
}

function showMatrix(host, {title, size, nonzeros, fill: filledIn, bins, cells}) {
  const share = size > 0 ? `${number((100 * nonzeros) / size ** 2, 2)} %` : '–';
  const text = [`${number(size, 6)} × ${number(size, 6)} blocks`, `${number(nonzeros, 6)} not zero `
    + `(${share})`, known(filledIn) && filledIn > 0 ? `${number(filledIn, 6)} of them fill` : null];
  const caption = text.filter((each) => each).join(' · ');
  const plot = make('div', {class: 'matrix'});
  host.append(make('figure', {class: 'chart'}, make('figcaption', {}, title), plot,
    make('p', {class: 'note'}, caption)));
  const most = Math.max(1, ...cells.map((cell) => cell[2]));
  canvasIn(plot, {role: 'img', 'aria-label': `${title}: ${caption}`}, ({context, width}) => {
    const side = width / bins;
    context.fillStyle = colour('path');
    for (const [down, right, count] of cells) {
      context.globalAlpha = 0.4 + 0.6 * (Math.log1p(count) / Math.log1p(most));
      const [left, top] = [Math.floor(right * side), Math.floor(down * side)];
      context.fillRect(left, top, Math.max(Math.ceil((right + 1) * side) - left, 1.5),
        Math.max(Math.ceil((down + 1) * side) - top, 1.5));
    }
    context.globalAlpha = 1;
  });
}
