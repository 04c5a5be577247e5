// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// A chart: axes with units, lines, bands, dots, bars and rules, and what they are at the pointer.
// The plot is painted once; the pointer has a canvas of its own above it. Charts over time share
// the time that is marked with each other and with the map.

const FONT = '12px system-ui, -apple-system, "Segoe UI", Roboto, sans-serif';
const PAD = {left: 34, right: 14, top: 12, bottom: 40};

/**
 * Make a chart.
 *
 * host: element for it; title: text; x, y: axes {label, log, time, domain, format};
 * marks: what is drawn, each {kind, name, colour, ...}: `line` {x, y, dash, width},
 * `dots` {x, y, shape}, `band` {x, low, high}, `bars` {edges, y}, `stems` {x, y},
 * `rule` {at, of: 'x' | 'y', dash}. Those with a name are in the legend.
 */
function makeChart(host, {title, x, y, marks, height = 230, note = null}) {
  const readOut = make('div', {class: 'readout', hidden: true});
  const plot = make('div', {class: 'plot', style: {height: `${height}px`}});
  const key = make('ul', {class: 'key'});
  for (const mark of marks) if (mark.name) key.append(make('li', {}, legendOf(mark), mark.name));
  host.append(make('figure', {class: 'chart'}, make('figcaption', {}, title),
    key.childElementCount > 0 ? key : null, plot, note ? make('p', {class: 'note'}, note) : null));
  const chart = {
    x: axis(x, marks, 'x'), y: axis(y, marks, 'y'), marks, readOut, pointer: null, box: null};
  canvasIn(plot, {'aria-hidden': 'true'}, (surface) => paintPlot(chart, surface));
  const over = canvasIn(plot, {
    class: 'over', tabindex: '0', role: 'application', 'aria-roledescription': 'chart',
    'aria-label': `${title}; ${y.label} over ${x.label}. Arrow keys move the read-out.`,
  }, (surface) => paintPointer(chart, surface));
  plot.append(readOut);
  followPointer(chart, over);
  return chart;
}

function legendOf(mark) {
  if (mark.kind === 'band') return swatch({...mark, fill: 0.25});
  if (mark.kind === 'bars') return swatch({...mark, fill: 0.55});
  if (mark.kind === 'dots') return swatch({...mark, shape: mark.shape || SHAPES.disc, dash: null, solid: true});
  return swatch({...mark, dash: mark.dash || []});
}

// --- axes ---------------------------------------------------------------------------------------

/** Complete an axis: where it begins and ends, and how a value becomes a part of its length. */
function axis(given, marks, name) {
  const across = (mark) => (name === 'x' ? [mark.x, mark.edges]
    : [mark.y, mark.low, mark.high]);
  const columns = marks.flatMap((mark) => (mark.kind === 'rule'
    ? [mark.of === name ? [mark.at] : []] : across(mark)));
  let [low, high] = given.domain || extent(...columns) || [0, 1];
  if (given.log) {
    const positive = columns.map((column) => (column || []).filter((value) => value > 0));
    [low, high] = extent(...positive) || [0.1, 1];
    if (given.floor) low = Math.max(low, given.floor);
    high = Math.max(high, low * 10);
    [low, high] = [low / 1.2, high * 1.2];
  } else if (!given.domain) {
    if (name === 'y' && given.zero !== false) [low, high] = [Math.min(low, 0), Math.max(high, 0)];
    if (low === high) [low, high] = [low - 1, high + 1];
    if (name === 'y') {
      const room = 0.06 * (high - low);
      [low, high] = [low < 0 ? low - room : low, high + room];
    }
  }
  const part = given.log
    ? (value) => Math.log(Math.max(value, low * 1e-3) / low) / Math.log(high / low)
    : (value) => (value - low) / (high - low);
  const back = given.log ? (at) => low * (high / low) ** at : (at) => low + at * (high - low);
  const format = given.format || (given.time ? (value) => clock(value, 0) : (value) => number(value));
  return {...given, low, high, part, back, format};
}

function ticksOf(each, pixels, spacing) {
  const count = Math.max(2, Math.floor(pixels / spacing));
  if (each.log) return logTicks(each.low, each.high, count);
  return (each.time ? timeTicks : ticks)(each.low, each.high, count);
}

// --- the plot -----------------------------------------------------------------------------------

function paintPlot(chart, {context, width, height}) {
  context.font = FONT;
  const down = height - PAD.top - PAD.bottom;
  const widest = Math.max(0, ...ticksOf(chart.y, down, 40).map(
    (value) => context.measureText(chart.y.format(value)).width));
  const left = PAD.left + Math.ceil(widest);
  const box = {left, top: PAD.top, width: width - left - PAD.right, height: down};
  const toX = (value) => box.left + box.width * chart.x.part(value);
  const toY = (value) => box.top + box.height * (1 - chart.y.part(value));
  Object.assign(chart, {box, toX, toY});
  paintAxes(chart, context);
  context.save();
  context.beginPath();
  context.rect(box.left - 1, box.top - 1, box.width + 2, box.height + 2);
  context.clip();
  for (const mark of chart.marks) PAINTERS[mark.kind](mark, context, chart);
  context.restore();
}

function paintAxes({x, y, box, toX, toY}, context) {
  context.lineWidth = 1;
  context.strokeStyle = colour('grid');
  context.fillStyle = colour('muted');
  context.beginPath();
  context.textAlign = 'center';
  context.textBaseline = 'top';
  for (const value of ticksOf(x, box.width, 80)) {
    const at = Math.round(toX(value)) + 0.5;
    context.moveTo(at, box.top);
    context.lineTo(at, box.top + box.height);
    context.fillText(x.format(value), at, box.top + box.height + 6);
  }
  context.textAlign = 'right';
  context.textBaseline = 'middle';
  for (const value of ticksOf(y, box.height, 40)) {
    const at = Math.round(toY(value)) + 0.5;
    context.moveTo(box.left, at);
    context.lineTo(box.left + box.width, at);
    context.fillText(y.format(value), box.left - 7, at);
  }
  context.stroke();
  context.strokeStyle = colour('axis');
  context.beginPath();
  context.moveTo(box.left + 0.5, box.top);
  context.lineTo(box.left + 0.5, box.top + box.height + 0.5);
  context.lineTo(box.left + box.width, box.top + box.height + 0.5);
  context.stroke();
  context.textAlign = 'center';
  context.textBaseline = 'alphabetic';
  context.fillText(x.label, box.left + box.width / 2, box.top + box.height + 34);
  context.save();
  context.translate(12, box.top + box.height / 2);
  context.rotate(-Math.PI / 2);
  context.textBaseline = 'middle';
  context.fillText(y.label, 0, 0);
  context.restore();
}

const PAINTERS = {line: paintLine, dots: paintDots, band: paintBand, bars: paintBars,
  stems: paintStems, rule: paintRule};

function paintLine(mark, context, chart) {
  context.strokeStyle = colour(mark.colour);
  context.lineWidth = mark.width || 1.6;
  context.lineJoin = 'round';
  context.setLineDash(mark.dash || []);
  context.beginPath();
  tracePixels(mark.x, mark.y, context, chart);
  context.stroke();
  context.setLineDash([]);
}

/** Trace a column; of all values in one column of pixels the first, lowest, highest and last. */
function tracePixels(xs, ys, context, {toX, toY}) {
  let [pixel, pen] = [null, false];
  let [first, low, high, last] = [0, 0, 0, 0];
  const flush = () => {
    if (pixel === null) return;
    for (const value of [first, low, high, last]) {
      if (pen) context.lineTo(pixel, value); else context.moveTo(pixel, value);
      pen = true;
    }
    pixel = null;
  };
  for (let k = 0; k < xs.length; k += 1) {
    if (!known(ys[k])) { flush(); pen = false; continue; }
    const [at, value] = [Math.round(toX(xs[k]) * 2) / 2, toY(ys[k])];
    if (at !== pixel) {
      flush();
      [pixel, first, low, high] = [at, value, value, value];
    }
    [low, high, last] = [Math.min(low, value), Math.max(high, value), value];
  }
  flush();
}

function paintDots(mark, context, {toX, toY}) {
  context.fillStyle = colour(mark.colour);
  const size = mark.x.length > 600 ? 1.2 : 1.6;
  context.globalAlpha = 0.8;
  for (let k = 0; k < mark.x.length; k += 1) {
    if (!known(mark.y[k])) continue;
    const [at, value] = [toX(mark.x[k]), toY(mark.y[k])];
    if (mark.shape === SHAPES.square) {
      context.fillRect(at - size, value - size, 2 * size, 2 * size);
    } else {
      context.beginPath();
      context.arc(at, value, size, 0, 7);
      context.fill();
    }
  }
  context.globalAlpha = 1;
}

function paintBand(mark, context, {toX, toY}) {
  context.fillStyle = colour(mark.colour);
  context.globalAlpha = 0.2;
  context.beginPath();
  let open = [];
  const close = () => {
    open.forEach((k, place) => (place === 0 ? context.moveTo : context.lineTo).call(
      context, toX(mark.x[k]), toY(mark.high[k])));
    for (const k of open.reverse()) context.lineTo(toX(mark.x[k]), toY(mark.low[k]));
    open = [];
  };
  const every = Math.max(1, Math.floor(mark.x.length / 3000));
  for (let k = 0; k < mark.x.length; k += every) {
    if (known(mark.low[k]) && known(mark.high[k])) open.push(k); else close();
  }
  close();
  context.fill();
  context.globalAlpha = 1;
}

function paintBars(mark, context, {toX, toY, box}) {
  context.fillStyle = colour(mark.colour);
  context.globalAlpha = 0.55;
  const floor = box.top + box.height;
  mark.y.forEach((value, k) => {
    const [left, right] = [toX(mark.edges[k]), toX(mark.edges[k + 1])];
    context.fillRect(left + 0.5, toY(value), Math.max(right - left - 1, 1), floor - toY(value));
  });
  context.globalAlpha = 1;
}

function paintStems(mark, context, {toX, toY}) {
  context.strokeStyle = colour(mark.colour);
  context.lineWidth = mark.x.length > 80 ? 1.5 : 2.5;
  context.beginPath();
  mark.x.forEach((at, k) => {
    if (!known(mark.y[k])) return;
    context.moveTo(toX(at), toY(0));
    context.lineTo(toX(at), toY(mark.y[k]));
  });
  context.stroke();
}

function paintRule(mark, context, {toX, toY, box}) {
  context.strokeStyle = colour(mark.colour);
  context.lineWidth = mark.width || 1.4;
  context.setLineDash(mark.dash || []);
  context.beginPath();
  if (mark.of === 'x') {
    context.moveTo(toX(mark.at), box.top);
    context.lineTo(toX(mark.at), box.top + box.height);
  } else {
    context.moveTo(box.left, toY(mark.at));
    context.lineTo(box.left + box.width, toY(mark.at));
  }
  context.stroke();
  context.setLineDash([]);
}

// --- the pointer --------------------------------------------------------------------------------

function followPointer(chart, over) {
  const {canvas} = over;
  const say = (value) => {
    chart.pointer = value;
    over.later();
    // the time stays when the pointer leaves, so that its place on the map can be looked at
    if (chart.x.time && value !== null) lookAtTime(value);
  };
  const move = (event) => {
    const at = (event.offsetX - chart.box.left) / chart.box.width;
    say(at < -0.02 || at > 1.02 ? null : chart.x.back(Math.min(1, Math.max(0, at))));
  };
  canvas.addEventListener('pointermove', move);
  canvas.addEventListener('pointerdown', move);
  canvas.addEventListener('pointerleave', (event) => {
    if (event.pointerType === 'mouse') say(null);
  });
  canvas.addEventListener('blur', () => say(null));
  canvas.addEventListener('keydown', (event) => {
    const step = {ArrowLeft: -0.01, ArrowRight: 0.01, Home: -1, End: 1}[event.key];
    if (step === undefined) return;
    event.preventDefault();
    const from = chart.pointer === null ? (step > 0 ? 0 : 1) : chart.x.part(chart.pointer);
    say(chart.x.back(Math.min(1, Math.max(0, from + step))));
  });
  if (chart.x.time) {
    followers.time.push((time) => {
      if (chart.pointer !== time && document.activeElement !== canvas) chart.pointer = null;
      over.later();
    });
  }
}

function paintPointer(chart, {context}) {
  const {box, x, readOut} = chart;
  const value = chart.pointer === null && x.time ? focus.time : chart.pointer;
  readOut.hidden = chart.pointer === null;
  if (!known(value) || !box || value < x.low || value > x.high) return;
  const at = Math.round(chart.toX(value)) + 0.5;
  context.strokeStyle = colour('ink');
  context.lineWidth = 1;
  context.globalAlpha = 0.6;
  context.beginPath();
  context.moveTo(at, box.top);
  context.lineTo(at, box.top + box.height);
  context.stroke();
  context.globalAlpha = 1;
  if (chart.pointer === null) return;
  const rows = readings(chart, value, context);
  const when = x.time ? clock(value) : `${x.short || x.label}: ${x.format(value)}`;
  readOut.replaceChildren(make('b', {}, when), ...rows.map(
    ([mark, text]) => make('span', {}, legendOf(mark), `${mark.short || mark.name}: ${text}`)));
  const left = at > box.left + box.width / 2;
  Object.assign(readOut.style, {
    left: left ? 'auto' : `${at + 10}px`,
    right: left ? `calc(100% - ${at - 10}px)` : 'auto', top: `${box.top + 4}px`});
}

/** What the marks of a chart are at a place of its x axis; puts dots there. */
function readings(chart, value, context) {
  const found = [];
  for (const mark of chart.marks) {
    if (!mark.name || mark.kind === 'rule') continue;
    const format = mark.format || chart.y.readOut || chart.y.format;
    if (mark.kind === 'bars') {
      const bin = mark.edges.findIndex((edge, k) => value >= edge && value <= mark.edges[k + 1]);
      if (bin >= 0) found.push([mark, format(mark.y[bin])]);
      continue;
    }
    if (mark.x.length === 0) continue;
    const k = nearest(mark.x, value);
    const height = mark.kind === 'band' ? mark.high[k] : mark.y[k];
    if (!known(height)) continue;
    found.push([mark, format(height)]);
    if (mark.kind === 'band') continue;
    context.fillStyle = colour(mark.colour);
    context.beginPath();
    context.arc(chart.toX(mark.x[k]), chart.toY(height), 3.5, 0, 7);
    context.fill();
  }
  return found;
}
