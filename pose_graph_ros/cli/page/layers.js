// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// The layers of the map: how they are painted, and which of their marks is at a place. Paths skip
// points that are less than a pixel apart and fixes those that are hidden by others, so that the
// work for a picture follows the pixels and not the length of the drive.

/** The measurements and springs as items: what a click finds and the panel shows. */
function itemOf(kind, table, k) {
  const column = (name) => (table[name] ? table[name][k] : null);
  const why = column('why');
  const item = {
    kind, table, k, source: table.source, state: column('state'), id: column('id'),
    distance: column('d'), reason: why === null || why < 0 ? null : DATA.texts[why]};
  if (kind === 'closure') {
    const [t0, t1, x0, y0, x1, y1] = ['t0', 't1', 'x0', 'y0', 'x1', 'y1'].map(column);
    return {...item, times: [t0, t1], ends: [[x0, y0], [x1, y1]]};
  }
  const at = column('at');
  const lines = DATA.lines || {};
  const tie = known(at) && at >= 0 && lines.corrected
    ? [lines.corrected.x[at], lines.corrected.y[at]] : null;
  return {...item, times: [column('t')], ends: [[column('x'), column('y')]], tie,
    heldOut: Boolean(column('held_out'))};
}

function itemOfSpring(spring) {
  const ends = [spring.from, spring.to].filter((end) => end && known(end.x));
  return {kind: 'spring', spring, source: spring.source, id: spring.name, reason: spring.text,
    times: ends.map((end) => end.t), ends: ends.map((end) => [end.x, end.y])};
}

const sameItem = (one, other) => Boolean(one && other) && one.kind === other.kind
  && (one.spring ? one.spring === other.spring : one.table === other.table && one.k === other.k);

/** How a fix is shown: one that was held out for judging looks so, whatever its state. */
const shownState = (table, k) => (table.held_out && table.held_out[k] ? HELD_OUT
  : table.state[k]);

/** All layers in the order in which they are painted; those without marks are left out. */
function makeLayers() {
  const lines = DATA.lines || {};
  const layers = [];
  const add = (layer) => { if (layer.count > 0) layers.push({shown: true, states: null, ...layer}); };
  const e = DATA.ellipses || {x: []};
  add({id: 'ellipses', name: 'covariances, 2 sigma', count: e.x.length,
    swatch: {colour: 'path', fill: 0.25}, factor: 1, paint: paintEllipses, ellipses: e});
  for (const id of ['odometry', 'truth', 'corrected']) {
    if (!lines[id]) continue;
    add({id, name: LINES[id].name, count: lines[id].x.length, swatch: LINES[id],
      paint: paintPath, line: lines[id], look: LINES[id]});
  }
  const closures = DATA.closures || [];
  for (const table of closures) {
    add(measurements('closure', table, `closures ${closures.length > 1 ? table.source : ''}`));
  }
  const fixes = DATA.fixes || [];
  for (const table of fixes) {
    add(measurements('fix', table, `fixes ${fixes.length > 1 ? table.source : ''}`));
  }
  const springs = (DATA.springs || []).map(itemOfSpring).filter((item) => item.ends.length > 0);
  add({id: 'springs', name: 'springs under most tension', count: springs.length, items: springs,
    swatch: {colour: 'spring', dash: [], width: 4}, shown: false, paint: paintSprings});
  return layers;
}

function measurements(kind, table, name) {
  const counts = STATES.map(() => 0);
  const count = kind === 'fix' ? table.x.length : table.x0.length;
  for (let k = 0; k < count; k += 1) counts[shownState(table, k)] += 1;
  return {id: `${kind}/${table.source}`, kind, name: name.trim(), table, count, counts,
    states: new Set(counts.keys()), swatch: {...LOOKS[BELIEVED], dash: kind === 'fix' ? null : []},
    paint: kind === 'fix' ? paintFixes : paintClosures};
}

// --- paths and ellipses -------------------------------------------------------------------------

/** So many pieces of a path are painted at once: longer ones take more than in proportion. */
const PIECES = 250;

/** Paint a path, without the points that do not show and the parts that are out of sight. */
function paintPath({line, look}, context, frame) {
  const {view, width, height} = frame;
  const {x, y} = line;
  const kept = simplified(line, 2 ** Math.floor(Math.log2(view.scale)));
  const [scale, left, top] = [view.scale, width / 2 - view.x * view.scale,
    height / 2 + view.y * view.scale];
  const sideOf = (u, v) => (u < -5 ? 1 : u > width + 5 ? 2 : 0) | (v < -5 ? 4 : v > height + 5 ? 8 : 0);
  context.strokeStyle = colour(look.colour);
  context.lineWidth = look.width;
  // where thousands of lines lie on each other, dashes and round joints cost much and do not show
  const crowded = kept.length > 8000;
  context.lineJoin = crowded ? 'bevel' : 'round';
  context.setLineDash(crowded ? [] : look.dash);
  context.beginPath();
  let [u0, v0, side0, pieces] = [NaN, NaN, 0, 0];
  for (const k of kept) {
    const [u, v] = [left + x[k] * scale, top - y[k] * scale];
    const side = sideOf(u, v);
    if (k === 0 || (side & side0) !== 0) {
      pieces = 0;
    } else {
      if (pieces % PIECES === 0) {
        context.stroke();
        context.beginPath();
        context.moveTo(u0, v0);
      }
      context.lineTo(u, v);
      pieces += 1;
      frame.points += 1;
    }
    [u0, v0, side0] = [u, v, side];
  }
  context.stroke();
  context.setLineDash([]);
}

/**
 * Which points of a path are needed at a scale: all others are within half a pixel of the lines
 * between these. From each point that is kept, the directions are followed that pass all points
 * after it closely enough; when the next point is in none of them, the one before it is kept.
 */
function simplified(line, scale) {
  line.levels = line.levels || new Map();
  if (line.levels.has(scale)) return line.levels.get(scale);
  const {x, y} = line;
  const [kept, near] = [[0], 0.5 / scale];
  let [from, first, low, high] = [0, 0, -Infinity, Infinity];
  let farthest = 0;
  for (let k = 1; k < x.length; k += 1) {
    const [right, up] = [x[k] - x[from], y[k] - y[from]];
    const far = Math.hypot(right, up);
    if (far <= near) continue;
    const direction = Math.atan2(up, right);
    const turned = wrap(direction - first);
    if (farthest === 0) [first, low, high] = [direction, -Math.PI, Math.PI];
    // a path that comes back would be shortened
    if (farthest > 0 && (turned < low || turned > high || far < farthest - near)) {
      from = k - 1;
      kept.push(from);
      [farthest, k] = [0, k - 1];
      continue;
    }
    const room = Math.asin(Math.min(1, near / far));
    const at = farthest === 0 ? 0 : turned;
    [low, high] = [Math.max(low, at - room), Math.min(high, at + room)];
    farthest = Math.max(far, farthest);
  }
  if (x.length > 1) kept.push(x.length - 1);
  line.levels.set(scale, kept);
  return kept;
}

const wrap = (angle) => angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));

/** Half axes [m] and direction [rad] of an ellipse of so many sigma. */
function ellipseAxes(xx, xy, yy, sigmas) {
  const [mean, half] = [(xx + yy) / 2, Math.hypot((xx - yy) / 2, xy)];
  return [sigmas * Math.sqrt(Math.max(mean + half, 0)), sigmas * Math.sqrt(Math.max(mean - half, 0)),
    0.5 * Math.atan2(2 * xy, xx - yy)];
}

/** Paint ellipses, but none whose middle is in one that is painted: they would be one blot. */
function paintEllipses({ellipses: e, factor}, context, {view, width, height}) {
  context.strokeStyle = context.fillStyle = colour('path');
  context.lineWidth = 1;
  const painted = [];
  for (let k = 0; k < e.x.length; k += 1) {
    if (!known(e.xx[k])) continue;
    const [u, v] = view.toScreen(e.x[k], e.y[k]);
    const [long, short, angle] = ellipseAxes(e.xx[k], e.xy[k], e.yy[k], 2 * factor * view.scale);
    if (long < 1.5 || u < -long || v < -long || u > width + long || v > height + long) continue;
    if (painted.some(([x, y, radius]) => Math.hypot(u - x, v - y) < Math.max(radius, long))) continue;
    painted.push([u, v, long]);
    context.beginPath();
    context.ellipse(u, v, long, Math.max(short, 0.3), -angle, 0, 7);
    context.globalAlpha = 0.1;
    context.fill();
    context.globalAlpha = 0.4;
    context.stroke();
  }
  context.globalAlpha = 1;
}

// --- measurements -------------------------------------------------------------------------------

/** Place of a mark of a shape with a border, which lets it show on lines of any colour. */
function stamp(shape, name, context, u, v, size = 1) {
  context.save();
  context.translate(u, v);
  context.scale(size, size);
  context.strokeStyle = colour('surface');
  context.lineWidth = 3.6;
  context.stroke(shape.drawn);
  context.strokeStyle = context.fillStyle = colour(name);
  context.lineWidth = 1.7;
  if (shape.open) context.stroke(shape.drawn); else context.fill(shape.drawn);
  context.restore();
}

/** States that are painted below the corrected path, and those above; the worst comes last. */
const BELOW = [HELD_OUT, BELIEVED, WEAK];
const ABOVE = [WAITING, REFUSED, DOUBTED];

function paintFixes({table, states, counts}, context, frame, order) {
  const {view, width, height} = frame;
  const [scale, left, top] = [view.scale, width / 2 - view.x * view.scale,
    height / 2 + view.y * view.scale];
  const cell = 3;
  const columns = Math.ceil(width / cell) + 1;
  const crowded = scale * spacing(table) < 9;
  for (const state of order) {
    if (!states.has(state) || counts[state] === 0) continue;
    const {shape, colour: name} = lookOf(state);
    const taken = new Uint8Array(columns * (Math.ceil(height / cell) + 1));
    const places = [];
    for (let k = 0; k < table.x.length; k += 1) {
      if (shownState(table, k) !== state) continue;
      const [u, v] = [left + table.x[k] * scale, top - table.y[k] * scale];
      if (!(u >= 0 && v >= 0 && u < width && v < height)) continue;
      const place = Math.floor(v / cell) * columns + Math.floor(u / cell);
      if (taken[place]) continue;
      taken[place] = 1;
      places.push(u, v);
      frame.points += 1;
    }
    const small = places.length > 2 * 600 || (crowded && order === BELOW);
    context.fillStyle = colour(name);
    for (let k = 0; k < places.length; k += 2) {
      if (small) context.fillRect(places[k] - 1.25, places[k + 1] - 1.25, 2.5, 2.5);
      else stamp(shape, name, context, places[k], places[k + 1], state === BELIEVED ? 0.75 : 1);
    }
  }
}

/** Half of the fixes are farther from the one before than this [m]. */
function spacing(table) {
  if (table.spacing === undefined) {
    const apart = [];
    for (let k = 1; k < table.x.length; k += Math.ceil(table.x.length / 1000)) {
      apart.push(Math.hypot(table.x[k] - table.x[k - 1], table.y[k] - table.y[k - 1]));
    }
    apart.sort((one, other) => one - other);
    table.spacing = apart.length > 0 ? apart[apart.length >> 1] : Infinity;
  }
  return table.spacing;
}

function paintClosures({table, states, counts}, context, {view, width, height}, order) {
  for (const state of order) {
    if (!states.has(state) || counts[state] === 0) continue;
    const {shape, colour: name, dash} = lookOf(state);
    const middles = [];
    context.beginPath();
    for (let k = 0; k < table.x0.length; k += 1) {
      if (table.state[k] !== state) continue;
      const [u, v] = view.toScreen(table.x0[k], table.y0[k]);
      const [p, q] = view.toScreen(table.x1[k], table.y1[k]);
      if (Math.max(u, p) < 0 || Math.max(v, q) < 0 || Math.min(u, p) > width
        || Math.min(v, q) > height) continue;
      context.moveTo(u, v);
      context.lineTo(p, q);
      middles.push((u + p) / 2, (v + q) / 2);
    }
    context.strokeStyle = colour(name);
    context.lineWidth = state === BELIEVED ? 1.3 : 1.6;
    context.setLineDash(dash);
    context.globalAlpha = state === BELIEVED ? 0.75 : 1;
    context.stroke();
    context.setLineDash([]);
    context.globalAlpha = 1;
    const most = state === BELIEVED || state === REFUSED ? 150 : 600;
    for (let k = 0; k < middles.length && middles.length <= 2 * most; k += 2) {
      stamp(shape, name, context, middles[k], middles[k + 1], state === BELIEVED ? 0.7 : 1.1);
    }
  }
}

function paintSprings({items}, context, {view}) {
  context.font = `bold 11px ${FONT.slice(5)}`;
  context.textAlign = 'center';
  context.textBaseline = 'middle';
  for (const {ends, spring} of [...items].reverse()) {
    const places = ends.map((end) => view.toScreen(...end));
    const [u, v] = middleOf(places);
    context.strokeStyle = context.fillStyle = colour('spring');
    context.lineWidth = 4;
    context.beginPath();
    context.moveTo(...places[0]);
    context.lineTo(...places[places.length - 1]);
    context.stroke();
    context.beginPath();
    context.arc(u, v, 8.5, 0, 7);
    context.fill();
    context.fillStyle = colour('surface');
    context.fillText(String(spring.rank), u, v + 0.5);
  }
}

const middleOf = (ends) => [0, 1].map(
  (axisOf) => ends.reduce((sum, end) => sum + end[axisOf], 0) / ends.length);

// --- what is at a place -------------------------------------------------------------------------

/** The item nearest to a place of the screen, of the layers that are shown, within some pixels. */
function pick(layers, view, u, v, within) {
  let [best, item] = [within, null];
  // what is not believed is wanted more often, and there is less of it
  const bonus = (state) => (state === BELIEVED || state === HELD_OUT ? 0 : 3);
  for (const layer of layers) {
    if (!layer.shown) continue;
    if (layer.kind === undefined) {
      for (const spring of layer.items || []) {
        const apart = toSegment(u, v, ...spring.ends.map((end) => view.toScreen(...end))) - 5;
        if (apart < best) [best, item] = [apart, spring];
      }
      continue;
    }
    const {table} = layer;
    for (let k = 0; k < table.state.length; k += 1) {
      const state = shownState(table, k);
      if (!layer.states.has(state)) continue;
      const apart = (layer.kind === 'fix'
        ? toSegment(u, v, view.toScreen(table.x[k], table.y[k]))
        : toSegment(u, v, view.toScreen(table.x0[k], table.y0[k]),
          view.toScreen(table.x1[k], table.y1[k]))) - bonus(state);
      if (apart < best) [best, item] = [apart, {layer, k}];
    }
  }
  return item && item.layer ? itemOf(item.layer.kind, item.layer.table, item.k) : item;
}

/** Distance of a point from a line between two others, or from one. */
function toSegment(u, v, [p, q], [r, s] = [p, q]) {
  const [along, up] = [r - p, s - q];
  const length2 = along * along + up * up;
  const part = length2 === 0 ? 0
    : Math.min(1, Math.max(0, ((u - p) * along + (v - q) * up) / length2));
  return Math.hypot(u - p - part * along, v - q - part * up);
}
