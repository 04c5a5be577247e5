// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// What is on the page, from top to bottom, but for the map.

const timeAxis = (values) => ({label: DATA.by_node ? 'node' : `time [${clockUnit()}]`, values, time: true,
  range: [0, DATA.duration || 1]});
const charts = (host, layout) => host.appendChild(make('div', {class: `charts ${layout}`}));

/** Title, facts and findings. */
function showHead() {
  const when = DATA.start ? `${DATA.start.slice(0, 10)} ${DATA.start.slice(11, 19)} UTC` : null;
  showTop('pose-graph report', [DATA.subtitle, when].filter((text) => text).join(' · '));
  showFindings();
  document.getElementById('contents').append(make('ul', {}, SHOWN.map(
    (id) => make('li', {}, linkTo(id, SECTIONS[id][0])))));
}

/** What a person must know; what is as it should be is folded away, unless there is nothing else. */
function showFindings() {
  const [good, others] = [true, false].map((which) => (DATA.findings || []).filter(
    ({level}) => (level === 'good') === which));
  const list = (found) => make('ul', {class: 'findings'}, found.map(({level, text, anchor, at}) => {
    const name = level in LEVELS ? level : 'notice';
    return make('li', {'data-level': name},
      sign(name),
      make('span', {}, make('b', {class: 'unseen'}, `${LEVELS[name][0]}: `), text),
      at && at.length > 0 ? make('a', {href: '#map', onclick: (event) => {
        event.preventDefault();
        onMap.zoomTo(at);
      }}, 'Show') : anchor ? linkTo(anchor, 'Show') : null);
  }));
  const count = `${counted(good.length, 'thing is as it', 'things are as they')} should be`;
  document.getElementById('main').append(
    make('div', {id: 'findings', role: 'region', 'aria-label': 'Findings'},
      others.length > 0 ? list(others) : null,
      good.length > 0 ? make('details', {class: 'good', open: others.length === 0},
        make('summary', {}, others.length > 0 ? count : 'All that was checked is as it should be'),
        list(good)) : null));
}

/** Position and heading errors over time with what was claimed of them, and the table of errors. */
function showErrors() {
  const {errors} = DATA;
  const isOfTwo = DATA.kind === 'comparison';
  const host = section('errors', isOfTwo ? 'Differences over time' : 'Errors over time', errors
    ? isOfTwo ? 'How far B is from A, at the poses of A.' : `Distance to ${errors.against === 'truth' ? 'the truth' : errors.against}. The band is what `
      + 'the covariances claim: 95 % of errors should be in it.' : null);
  if (errors) showErrorCharts(charts(host, 'wide'), errors);
  else host.append(nothing(isOfTwo ? 'The runs do not overlap in time.' : 'No errors over time: the run had no truth, and no fixes were held out '
    + '(--truth, --hold-out).'));
  const rows = DATA.error_table || [];
  if (rows.length > 0) {
    host.append(table('errors card', ['distance [m]', 'median', 'rms', '95 %', 'largest', 'of'],
      rows.map(({name, unit, median, rms, p95, maximum, count}) => [
        name, ...[median, rms, p95, maximum].map((size) => (
          known(size) ? size.toFixed(2) + (unit === 'deg' ? '°' : '') : '–')), number(count, 6)])));
  }
}

function showErrorCharts(host, {t, position, odometry, sigma, heading}) {
  const top = (column) => (extent(column) || [0, 0])[1];
  const log = top(odometry) > 5 * top(position);
  const floor = log ? Math.max(0.002, top(position) / 300) : 0;
  const claimed = (sigma || []).map((each) => (known(each) ? 2 * each : null));
  const [name, label] = DATA.kind === 'comparison' ? ['A to B', 'difference'] : ['corrected path', 'error'];
  const series = [{name, y: position, colour: 'path', width: 2}];
  if (odometry) series.push({name: 'odometry, aligned', y: odometry, colour: 'odometry', dash: [6, 4]});
  if (sigma) {
    series.push({name: 'claimed, 2 sigma', y: claimed, colour: 'path', width: 0.5},
      {y: claimed.map((each) => (each === null ? null : floor / 2)), colour: 'path', width: 0});
  }
  makeChart(host, {title: 'Position', x: timeAxis(t), series,
    band: sigma ? [series.length - 1, series.length] : null,
    y: {label: log ? `${label} [m], logarithmic` : `${label} [m]`, log, floor}});
  if ((heading || []).some(known)) {
    makeChart(host, {title: 'Heading', x: timeAxis(t), y: {label: `${label} [degrees]`},
      series: [{name, y: heading.map(degrees), colour: 'path'}]});
  }
}

/** The residuals of each source: expected against found, and three charts. */
function showSources() {
  const host = section('sources', 'Residuals by source',
    'A residual divided by the sigma that its source claims should be 1 on average, less what the '
    + 'optimisation takes up. A ratio of 2 says that sigmas are half of what they should be; an '
    + 'interval with 1 in it, that nothing is wrong with them.');
  const sources = DATA.sources || [];
  sources.forEach((source) => showSource(host, source));
}

function showSource(host, source) {
  const {name, kind, count, used, verdict, energy, scale, unused, independent, rows, series} = source;
  const far = unused && unused.count > 0 && known(unused.median_distance)
    ? ` (of the others half are more than ${number(unused.median_distance)} sigma off)` : '';
  const numbers = [
    `${counted(count, 'measurement')}, ${number(used, 6)} used${far}`,
    known(independent) && counted(Math.round(independent), 'independent residual'),
    known(scale) && Math.abs(scale - 1) > 0.005 && `sigmas multiplied by ${number(scale)} in the graph`,
    energy && known(energy.found)
      && `mean energy ${number(energy.found)}, expected ${number(energy.expected)}`,
    energy && known(energy.quantile95_share)
      && `${number(100 * energy.quantile95_share)} % within their 95 % bound`];
  const card = make('article', {
    class: 'card source', id: `source-${name}`, 'aria-label': `Source ${name}`},
  make('h3', {}, name, ' ', make('span', {class: 'kind'}, String(kind || '').replace(/_/g, ' '))),
  make('p', {class: 'verdict'}, verdict || ''),
  make('p', {class: 'numbers'}, numbers.filter((text) => text).join(' · ')));
  host.append(card);
  if (rows.length === 0) card.append(nothing('None of them is in the graph, so there are no residuals.'));
  else card.append(table('ratios', ['component', 'expected', 'found', 'ratio', '95 % interval'],
    rows.map((row) => [[row.name, make('small', {}, ` ${counted(row.count, 'residual')}`)],
      number(row.expected), number(row.found), make('b', {class: signOf(row)}, number(row.ratio)),
      known(row.low) ? `${number(row.low, 2)} – ${number(row.high, 2)}` : '–'])));
  if (!series || series.t.length === 0) return;
  const row = charts(card, '');
  showHistogram(row, source);
  makeChart(row, {title: 'Over time', x: timeAxis(series.t), y: {label: 'residual / expected'},
    rules: [-2, 2].map((at) => ({of: 'y', at, colour: 'muted', dash: [5, 4]})),
    series: series.rows.map((y, k) => ({kind: 'dots', y, name: (rows[k] || {name: `component ${k}`}).name,
      colour: ['path', 'odometry', 'held-out'][k % 3]})),
    note: 'Dashed: 2 sigma, where 95 % should be within.'});
  if (!DATA.by_node) showAutocorrelation(row, source);
}

/** Whether the interval of a ratio has 1 in it, or says that sigmas are too small or too large. */
const signOf = ({low, high}) => (!known(low) || (low <= 1 && high >= 1) ? ''
  : (low > 1 ? 'too-small' : 'too-large'));

function noChart(host, title, why) {
  host.append(make('figure', {class: 'chart'}, make('figcaption', {}, title), nothing(why)));
}

function showHistogram(host, {histogram}) {
  const title = 'How large they are';
  if (!histogram) {
    return noChart(host, title, 'The optimum follows this source wherever it leads, so that its '
      + 'residuals say nothing.');
  }
  const {edges, count} = histogram;
  const wide = edges[1] - edges[0];
  const total = count.reduce((sum, value) => sum + value, 0);
  const values = count.map((_, k) => edges[k] + wide / 2);
  const normal = values.map((value) => (
    total * wide * Math.exp(-0.5 * value * value)) / Math.sqrt(2 * Math.PI));
  return makeChart(host, {title, note: 'Larger ones are counted in the outermost bars.',
    x: {label: 'residual / expected', values, range: [edges[0], edges[edges.length - 1]]},
    y: {label: 'count'}, series: [{kind: 'bars', name: 'found', y: count, colour: 'path'},
      {name: 'normal, as claimed', y: normal, colour: 'odometry'}]});
}

function showAutocorrelation(host, {autocorrelation}) {
  const title = 'How long they keep their direction';
  if (!autocorrelation) {
    return noChart(host, title, 'There are too few residuals, or they say nothing.');
  }
  const {lag, value, band, fitted, time, in_use: inUse} = autocorrelation;
  const last = lag[lag.length - 1];
  // lags that grow by a factor are told apart on an axis that does so as well
  const log = lag[0] > 0 && last > 20 * lag[0];
  const farthest = Math.max(last, Math.min(Math.max(time || 0, inUse || 0), 2 * last));
  const series = [{kind: 'stems', name: 'found', y: value, colour: 'path'}];
  if (fitted) series.push({name: 'fitted', y: fitted, colour: 'odometry', dash: [6, 3]});
  if (known(band)) {
    series.push({name: 'as of white noise, 95 %', y: lag.map(() => band), colour: 'muted', width: 0.5},
      {y: lag.map(() => -band), colour: 'muted', width: 0.5});
  }
  const rules = [{at: time, name: `suggests ${number(time)} s`, colour: 'doubted'},
    {at: inUse, name: `in use ${number(inUse)} s`, dash: [2, 3], colour: 'held-out'}]
    .filter(({at}) => known(at) && at > 0).map((rule) => ({of: 'x', ...rule}));
  return makeChart(host, {title, series, rules, y: {label: 'autocorrelation'},
    band: known(band) ? [series.length - 1, series.length] : null,
    x: {label: log ? 'lag [s], logarithmic' : 'lag [s]', values: lag, log,
      range: log ? null : [0, farthest]},
    note: known(time) ? null : 'No correlation time is suggested: within the band, residuals say '
      + 'nothing of each other.'});
}

/** The constraints under most tension; a click shows them on the map. */
function showSprings() {
  const isOfTwo = DATA.kind === 'comparison';
  const host = isOfTwo ? section('springs', 'Where the paths differ most') : section('springs', 'Springs under most tension',
    'Constraints as springs between poses: the energy is what each adds to chi2, and the mark in '
    + 'its bar is what it adds on average if its covariance is right.');
  if (springItems.length === 0) {
    return host.append(nothing(isOfTwo ? 'Nowhere by more than 2 cm.' : 'None: the graph has no constraints with a residual.'));
  }
  const [, most] = extent(...springItems.map(({spring}) => [spring.energy, spring.expected, 1e-9]));
  return host.append(make('ol', {class: 'springs card'}, springItems.map((item) => {
    const {rank, name, kind, energy, expected, text} = item.spring;
    const bar = (height, x, width, fillName) => draw('rect', {
      x: `${(100 * x) / most}%`, width, height, y: (10 - height) / 2, fill: `var(--${fillName})`});
    return entry(item, onMap.choose, [
      make('span', {class: 'rank'}, rank),
      make('span', {class: 'entry-name'}, item.id),
      make('span', {class: 'kind'}, isOfTwo ? '' : kind),
      draw('svg', {class: 'bar', 'aria-hidden': 'true'}, bar(8, 0, '100%', 'line'),
        bar(8, 0, `${(100 * (energy || 0)) / most}%`, 'spring'), isOfTwo ? null : bar(10, expected || 0, 2, 'ink')),
      make('span', {class: 'energy'}, make('b', {}, number(energy)), isOfTwo ? ' m' : ` / ${number(expected)}`),
      make('span', {class: 'entry-why'}, (text || '').replace(name, '').replace(/^[:,]? /, ''))]);
  })));
}

/** What both of two runs tell, beside each other. */
function showFigures() {
  const host = section('figures', 'Figures');
  const listed = (rows) => table('errors figures', ['', 'A', 'B', 'change'], rows);
  for (const {title, rows} of DATA.figures) {
    const [same, others] = [true, false].map((which) => rows.filter(
      ([, one, other]) => (one === other) === which));
    host.append(make('article', {class: 'card source'}, make('h3', {}, title),
      others.length > 0 ? listed(others) : nothing('Nothing changed.'),
      same.length > 0 ? make('details', {}, make('summary', {}, `${same.length} the same in both`),
        listed(same)) : null));
  }
}

/** How long updates took, chi2 and the size of the graph over the drive. */
function showUpdates() {
  const {updates} = DATA;
  const times = updates ? updates.ms.filter(known).sort((one, other) => one - other) : [];
  const share = (part) => times[Math.min(times.length - 1, Math.floor(part * times.length))];
  const host = section('updates', 'Updates', times.length > 0
    ? `${counted(updates.count || updates.t.length, 'update')}: half took less than ${
      number(share(0.5))} ms, 95 % less than ${number(share(0.95))} ms, the longest ${
      number(share(1))} ms.` : null);
  if (!updates) return host.append(nothing('No updates were recorded in this run.'));
  const axis = (label, column) => {
    const found = extent((column || []).filter((value) => value > 0));
    const log = found !== null && found[1] > 20 * found[0];
    return {label: log ? `${label}, logarithmic` : label, log};
  };
  const row = charts(host, 'wide');
  makeChart(row, {title: 'Time of an update', x: timeAxis(updates.t), y: axis('time [ms]', updates.ms),
    series: [{kind: 'dots', y: updates.ms, colour: 'path', name: 'update [ms]'}],
    rules: known(updates.period) && updates.period < 20 * share(1) ? [{of: 'y', at: updates.period,
      colour: 'doubted', dash: [6, 4], name: `period of the node, ${number(updates.period)} ms`}] : []});
  return makeChart(row, {title: 'chi2 of the graph', x: timeAxis(updates.t),
    y: axis('chi2, nodes', updates.chi2), series: [
      {y: updates.chi2, colour: 'odometry', name: 'chi2'},
      {y: updates.nodes, colour: 'path', dash: [6, 4], name: 'hidden nodes',
        format: (value) => number(value, 6)}]});
}

/** Where H and its factor have blocks that are not zero, darker where there are many. */
function showSparsity() {
  const host = section('sparsity', 'Sparsity of H and of its factor',
    'Each node is a row and a column. What the order of elimination leaves empty costs no time.');
  const matrices = DATA.sparsity || [];
  const row = charts(host, 'wide');
  for (const {title, size, nonzeros, fill: filled, bins, cells} of matrices) {
    const caption = [`${number(size, 6)} × ${number(size, 6)} blocks`,
      `${number(nonzeros, 6)} not zero (${number((100 * nonzeros) / size ** 2, 2)} %)`,
      ...(filled > 0 ? [`${number(filled, 6)} of them fill`] : [])].join(' · ');
    const most = Math.max(...cells.map((cell) => cell[2]), 1);
    const shade = ([, , count]) => Math.ceil((4 * Math.log1p(count)) / Math.log1p(most));
    const square = Math.max(1, bins / 250);
    row.append(make('figure', {class: 'chart'}, make('figcaption', {}, title),
      draw('svg', {class: 'matrix', viewBox: `0 0 ${bins} ${bins}`, role: 'img',
        'aria-label': `${title}: ${caption}`}, [1, 2, 3, 4].map((level) => draw('path', {
        fill: 'var(--path)', 'fill-opacity': 0.4 + 0.15 * level, d: cells.filter(
          (cell) => shade(cell) === level).map(([down, right]) => (
          `M${right},${down}h${square}v${square}h-${square}Z`)).join('')}))),
      make('p', {class: 'note'}, caption)));
  }
}

let onMap = null;
const SECTIONS = {
  map: ['Map', () => { onMap = showMap(); }], figures: ['Figures', showFigures],
  errors: [DATA.kind === 'comparison' ? 'Differences' : 'Errors', showErrors],
  sources: ['Residuals', showSources],
  springs: [DATA.kind === 'comparison' ? 'Places' : 'Springs', showSprings],
  updates: ['Updates', showUpdates], sparsity: ['Matrices', showSparsity]};
const SHOWN = {graph: ['map', 'sources', 'springs', 'sparsity'],
  comparison: ['figures', 'map', 'errors', 'springs']}[DATA.kind]
  || ['map', 'errors', 'sources', 'springs', 'updates', 'sparsity'];
showHead();
SHOWN.forEach((id) => SECTIONS[id][1]());
