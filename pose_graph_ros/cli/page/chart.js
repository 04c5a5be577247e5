// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// Charts by uPlot. Those over time mark the time that the reader looks at, here and on the map.

/**
 * Make a chart of several columns over one.
 *
 * x: {label, values, time, log, range}; y: {label, log, range, format}; series: {name, y, colour,
 * kind: 'line' | 'dots' | 'bars' | 'stems', dash, width, format}; band: the numbers of two series
 * between which the area is filled; rules: lines at a value, {at, of: 'x' | 'y', colour, dash,
 * name}.
 */
function makeChart(host, {title, x, y, series, band, rules = [], note, height = 230}) {
  const plot = make('div', {class: 'plot', tabindex: '0', role: 'application',
    'aria-roledescription': 'chart', 'aria-label': described(title, x, y, series, rules)});
  host.append(make('figure', {class: 'chart'}, make('figcaption', {}, title), plot,
    note ? make('p', {class: 'note'}, note) : null));
  const chart = new uPlot({
    width: Math.max(plot.clientWidth, 200), height,
    scales: {x: scaleOf('x', x, [x.values], rules),
      y: scaleOf('y', y, series.map((each) => each.y), rules)},
    axes: [axisOf(x, 34, 70), axisOf(y, 52, 36)],
    series: [{label: x.label, value: (_, value) => (x.time ? clock(value) : number(value))},
      ...series.map((each) => seriesOf(each, y))],
    bands: band ? [{series: band, fill: () => `${colour('path')}33`}] : [],
    legend: {markers: {width: 2, stroke: (u, k) => `var(--${series[k - 1].colour})`,
      dash: (u, k) => (series[k - 1].dash ? 'dashed' : 'solid'),
      fill: (u, k) => (series[k - 1].kind ? `var(--${series[k - 1].colour})` : 'none')}},
    cursor: {y: false, drag: {x: false, y: false}, points: {size: 7}},
    hooks: {draw: [(u) => drawRules(u, rules)], setCursor: [(u) => {
      if (x.time && u.cursor.left >= 0) lookAtTime(u.posToVal(u.cursor.left, 'x'));
    }]},
  }, [x.values, ...series.map((each) => each.y)], plot);
  chart.root.querySelector('.u-legend').setAttribute('aria-live', 'polite');
  const resize = () => chart.setSize({width: Math.max(plot.clientWidth, 200), height});
  new ResizeObserver(resize).observe(plot);
  repaints.push(resize);
  plot.addEventListener('keydown', (event) => {
    const step = {ArrowLeft: -0.01, ArrowRight: 0.01, Home: -1, End: 1}[event.key];
    if (step === undefined) return;
    event.preventDefault();
    const wide = chart.over.clientWidth;
    const from = chart.cursor.left >= 0 ? chart.cursor.left : 0;
    chart.setCursor({left: Math.min(wide, Math.max(0, from + step * wide)), top: 9});
  });
  if (x.time) {
    followers.time.push((time) => chart.setCursor({left: chart.valToPos(time, 'x'), top: 9}, false));
  }
}

/** What a chart shows in words: the title, the axes, and between what its columns are. */
function described(title, x, y, series, rules) {
  const spans = series.filter(({name}) => name).map((each) => (
    `${each.name} from ${(extent(each.y) || []).map((value) => number(value)).join(' to ')}`));
  return [`${title}: ${y.label} over ${x.label}`, ...spans, ...rules.map(({name}) => name || ''),
    'arrow keys move the read-out'].filter((text) => text).join('; ');
}

/** A scale with all values and rules in it; a linear one of y has zero, a logarithmic one none. */
function scaleOf(name, {log, range, floor}, columns, rules) {
  const levels = rules.filter(({of}) => of === name).map(({at}) => at);
  if (range) return {time: false, range};
  if (!log) {
    return {time: false, range: (_, low, high) => uPlot.rangeNum(
      Math.min(low, 0, ...levels), Math.max(high, 0, ...levels), 0.06, true)};
  }
  const positive = [...columns, levels].map((each) => each.filter((value) => value > 0));
  const [low, high] = extent(...positive) || [0.1, 1];
  const first = Math.max(low, floor || 0);
  return {time: false, distr: 3, range: [first / 1.2, Math.max(high, 10 * first) * 1.2]};
}

const TIME_STEPS = [1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 18000, 36000, 86400];

function axisOf({label, time, format}, size, space) {
  const text = format || (time ? (value) => clock(value, 0).replace('node ', '') : (value) => number(value));
  return {
    label, size, space, labelSize: 18, labelGap: 0, font: '12px system-ui, sans-serif',
    labelFont: '12px system-ui, sans-serif', stroke: () => colour('muted'),
    grid: {stroke: () => colour('grid'), width: 1}, ticks: {show: false},
    border: {show: true, stroke: () => colour('axis'), width: 1},
    values: (_, splits) => splits.map((value) => (value === null ? '' : text(value))),
    ...(time && (DATA.duration || 0) >= 120 ? {incrs: TIME_STEPS} : {}),
  };
}

function seriesOf({name, colour: paint, kind = 'line', dash, width = 1.6, format}, y) {
  const stroke = () => colour(paint);
  const paths = {line: undefined, dots: () => null, bars: uPlot.paths.bars({size: [0.9]}),
    stems: uPlot.paths.bars({size: [0.5, 3, 1]})}[kind];
  return {
    label: name || '', class: name ? null : 'unnamed', stroke, dash, width: kind === 'bars' ? 0 : width,
    fill: kind === 'bars' || kind === 'stems' ? () => `${colour(paint)}a0` : undefined, paths,
    points: {show: kind === 'dots', size: 3.5, width: 0, fill: stroke},
    value: (_, value) => (format || y.format || number)(value)};
}

function drawRules({ctx, bbox, valToPos}, rules) {
  const {left, top, width, height} = bbox;
  const ratio = uPlot.pxRatio;
  ctx.save();
  ctx.beginPath();
  ctx.rect(left, top, width, height);
  ctx.clip();
  ctx.lineWidth = 1.4 * ratio;
  ctx.font = `${12 * ratio}px system-ui, sans-serif`;
  for (const [k, {at, of, colour: paint, dash = [], name = ''}] of rules.entries()) {
    const place = valToPos(at, of, true);
    const begin = of === 'x' ? [place, top] : [left, place];
    ctx.strokeStyle = ctx.fillStyle = colour(paint);
    ctx.setLineDash(dash.map((each) => each * ratio));
    ctx.beginPath();
    ctx.moveTo(...begin);
    ctx.lineTo(...(of === 'x' ? [place, top + height] : [left + width, place]));
    ctx.stroke();
    const right = of === 'x' && place > left + 0.6 * width;
    ctx.textAlign = right ? 'right' : 'left';
    ctx.fillText(name, begin[0] + (right ? -5 : 5) * ratio,
      begin[1] + (of === 'x' ? 14 * (k + 1) : (place < top + 20 * ratio ? 15 : -5)) * ratio);
  }
  ctx.restore();
}
