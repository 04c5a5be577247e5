// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// The residuals of each source: expected against found, their histogram, over time, and how long
// they keep their direction.

/** Put the sources on the page, each with its table and its charts. */
function showSources() {
  const host = section('sources', 'Residuals by source',
    'A residual divided by the sigma that its source claims should be 1 on average, less what the '
    + 'optimisation takes up. A ratio of 2 says that sigmas are half of what they should be; an '
    + 'interval with 1 in it, that nothing is wrong with them.');
  const sources = DATA.sources || [];
  if (sources.length === 0) host.append(nothing('No residuals: nothing was measured.'));
  for (const source of sources) host.append(showSource(source));
}

function showSource(source) {
  const {name, kind, count, used, verdict, energy, scale, unused, independent} = source;
  const numbers = [`${counted(count, 'measurement')}, ${number(used, 6)} used`];
  if (unused && unused.count > 0 && known(unused.median_distance)) {
    numbers[0] += ` (of the others half are more than ${number(unused.median_distance)} sigma off)`;
  }
  if (known(independent)) numbers.push(`${counted(Math.round(independent), 'independent residual')}`);
  if (known(scale) && Math.abs(scale - 1) > 0.005) numbers.push(`sigmas multiplied by ${number(scale)} in the graph`);
  if (energy && known(energy.found)) {
    numbers.push(`mean energy ${number(energy.found)}, expected ${number(energy.expected)}`);
  }
  if (energy && known(energy.quantile95_share)) {
    numbers.push(`${number(100 * energy.quantile95_share)} % within their 95 % bound`);
  }
  const card = make('article', {
    class: 'card source', id: `source-${name}`, tabindex: '-1', 'aria-label': `Source ${name}`},
  make('h3', {}, name, ' ', make('span', {class: 'kind'}, String(kind || '').replace(/_/g, ' '))),
  verdict ? make('p', {class: 'verdict'}, verdict) : null,
  make('p', {class: 'numbers'}, numbers.join(' · ')));
  if ((source.rows || []).length > 0) card.append(ratioTable(source));
  else card.append(nothing('None of them is in the graph, so there are no residuals.'));
  if (!source.series || source.series.t.length === 0) return card;
  const charts = make('div', {class: 'charts'});
  showHistogram(charts, source);
  showSeries(charts, source);
  showAutocorrelation(charts, source);
  card.append(charts);
  return card;
}

/** A table of what was expected and found, with a picture of the ratio and its interval. */
function ratioTable({name, rows}) {
  const head = ['component', 'expected', 'found', 'ratio', '95 % interval'];
  return make('div', {class: 'scrolls'}, make('table', {class: 'ratios'},
    make('caption', {class: 'unseen'}, `Residuals of ${name}, in units of their claimed sigma`),
    make('thead', {}, make('tr', {}, head.map((text) => make('th', {scope: 'col'}, text)))),
    make('tbody', {}, rows.map((row) => make('tr', {},
      make('th', {scope: 'row'}, row.name, make('small', {}, ` ${counted(row.count, 'residual')}`)),
      make('td', {}, number(row.expected)), make('td', {}, number(row.found)),
      make('td', {class: 'ratio'}, make('b', {}, number(row.ratio)), ratioPicture(row)),
      make('td', {}, known(row.low) ? `${number(row.low, 2)} – ${number(row.high, 2)}` : '–'))))));
}

/** The ratio on a logarithmic axis from 1/5 to 5: a dot, its interval, and 1. */
function ratioPicture({ratio, low, high}) {
  const at = (value) => 4 + 112 * Math.min(1, Math.max(0, 0.5 + Math.log(value) / Math.log(25)));
  const picture = draw('svg', {class: 'ratio-picture', viewBox: '0 0 120 18', 'aria-hidden': 'true'},
    draw('line', {x1: 4, x2: 116, y1: 9, y2: 9, stroke: 'var(--line)', 'stroke-width': 2}),
    draw('line', {x1: 60, x2: 60, y1: 2, y2: 16, stroke: 'var(--muted)', 'stroke-width': 1.5}));
  if (known(low) && known(high) && low > 0) {
    picture.append(draw('rect', {x: at(low), width: Math.max(at(high) - at(low), 2), y: 4,
      height: 10, rx: 2, fill: 'var(--believed)', 'fill-opacity': 0.4}));
  }
  if (known(ratio) && ratio > 0) {
    const sign = !known(low) || (low <= 1 && high >= 1) ? 'believed'
      : (low > 1 ? 'doubted' : 'waiting');
    picture.append(draw('circle', {cx: at(ratio), cy: 9, r: 5, stroke: 'var(--surface)',
      fill: `var(--${sign})`}));
  }
  return picture;
}

const COMPONENTS = ['path', 'odometry', 'held-out'];

function noChart(host, title, why) {
  host.append(make('figure', {class: 'chart'}, make('figcaption', {}, title), nothing(why)));
}

function showHistogram(host, {histogram}) {
  if (!histogram || histogram.count.length === 0) {
    noChart(host, 'How large they are', 'The optimum follows this source wherever it leads, so that '
      + 'its residuals say nothing.');
    return;
  }
  const {edges, count} = histogram;
  const total = count.reduce((sum, value) => sum + value, 0);
  const [x, y] = [[], []];
  for (let k = 0; k <= 120 && total > 0; k += 1) {
    const value = edges[0] + (k / 120) * (edges[edges.length - 1] - edges[0]);
    x.push(value);
    y.push((total * (edges[1] - edges[0]) * Math.exp(-0.5 * value * value)) / Math.sqrt(2 * Math.PI));
  }
  makeChart(host, {
    title: 'How large they are',
    note: 'Larger ones are counted in the outermost bars.', x: {label: 'residual / expected', domain: [edges[0],
      edges[edges.length - 1]]}, y: {label: 'count', format: (value) => number(value, 4)},
    marks: [
      {kind: 'bars', edges, y: count, colour: 'path', name: 'found', x: []},
      {kind: 'line', x, y, colour: 'odometry', name: 'normal, as claimed',
        format: (value) => number(value, 2)}]});
}

function showSeries(host, {series, rows}) {
  const named = (rows || []).length === series.rows.length;
  const marks = series.rows.map((y, k) => ({
    kind: 'dots', x: series.t, y, colour: COMPONENTS[k % COMPONENTS.length],
    shape: [SHAPES.disc, SHAPES.square, SHAPES.diamond][k % 3],
    name: named ? rows[k].name : `component ${k + 1}`}));
  const rules = [-2, 2].map((at) => ({
    kind: 'rule', of: 'y', at, colour: 'muted', dash: [5, 4]}));
  makeChart(host, {title: 'Over time', marks: [...rules, ...marks],
    x: {label: `time [${clockUnit()}]`, time: true, domain: [0, DATA.duration || 1]},
    y: {label: 'residual / expected', zero: true},
    note: 'Dashed: 2 sigma, where 95 % should be within.'});
}

function showAutocorrelation(host, {autocorrelation: found}) {
  if (!found || found.lag.length === 0) {
    noChart(host, 'How long they keep their direction', 'There are too few residuals, or they say '
      + 'nothing.');
    return;
  }
  const {lag, value, band, fitted} = found;
  const marks = [];
  if (known(band)) {
    marks.push({kind: 'band', x: [lag[0], lag[lag.length - 1]], low: [-band, -band],
      high: [band, band], colour: 'muted', name: 'as of white noise, 95 %'});
  }
  marks.push({kind: 'stems', x: lag, y: value, colour: 'path', name: 'found'});
  if (fitted) {
    marks.push({kind: 'line', x: lag, y: fitted, colour: 'odometry', dash: [6, 3], name: 'fitted'});
  }
  const rule = (at, name, dash, colourName) => {
    if (known(at) && at > 0) marks.push({kind: 'rule', of: 'x', at, name, dash, colour: colourName});
  };
  rule(found.time, `suggests ${number(found.time)} s`, [], 'doubted');
  rule(found.in_use, `in use ${number(found.in_use)} s`, [2, 3], 'held-out');
  // lags that grow by a factor are told apart on an axis that does so as well
  const log = lag[0] > 0 && lag[lag.length - 1] > 20 * lag[0];
  const farthest = Math.max(lag[lag.length - 1], found.time || 0, found.in_use || 0);
  makeChart(host, {title: 'How long they keep their direction', marks,
    x: log ? {label: 'lag [s], logarithmic', short: 'lag [s]', log}
      : {label: 'lag [s]', domain: [0, Math.min(farthest, 2 * lag[lag.length - 1])]},
    y: {label: 'autocorrelation'},
    note: known(found.time) ? null : 'No correlation time is suggested: within the band, '
      + 'residuals say nothing of each other.'});
}
