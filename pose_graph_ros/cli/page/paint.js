// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// What is painted on the map. A frame tells where a place [m] is on the canvas, and what is in it.

/** A canvas on the map that is painted anew when the map has come to rest. */
const Painted = L.Renderer.extend({
  _initContainer() {
    this._container = make('canvas', {'aria-hidden': 'true'});
  },
  /** Leaflet calls this when the map has come to rest. */
  _update() {
    if (this._map._animatingZoom && this._bounds) return;
    L.Renderer.prototype._update.call(this);
    const {min, max} = this._bounds;
    const size = this._bounds.getSize();
    const ratio = window.devicePixelRatio;
    L.DomUtil.setPosition(this._container, min);
    Object.assign(this._container, {width: size.x * ratio, height: size.y * ratio});
    Object.assign(this._container.style, {width: `${size.x}px`, height: `${size.y}px`});
    const context = this._container.getContext('2d');
    context.setTransform(ratio, 0, 0, ratio, -ratio * min.x, -ratio * min.y);
    context.font = '12px system-ui, sans-serif';
    const scale = 2 ** this._map.getZoom();
    const origin = this._map.getPixelOrigin();
    const corner = this._map.containerPointToLayerPoint([0, 0]);
    const visible = [corner, corner.add(this._map.getSize())];
    this.options.paint(context, {
      scale, min, max, visible, place: (x, y) => [x * scale - origin.x, -y * scale - origin.y],
      back: ({x, y}) => [(x + origin.x) / scale, -(y + origin.y) / scale]});
  },
});

/** On which sides a place is out of a frame, as bits. */
const sideOf = ({min, max}, u, v) => (u < min.x - 9 ? 1 : u > max.x + 9 ? 2 : 0)
  | (v < min.y - 9 ? 4 : v > max.y + 9 ? 8 : 0);

/** Paint the layers: what is believed below the corrected path, the worst above all. */
function paintLayers(layers, context, frame) {
  paintGrid(context, frame, false);
  const shown = layers.filter((layer) => layer.shown);
  const measured = (order) => shown.filter(({counts}) => counts).forEach((layer) => order
    .filter((state) => layer.states.has(state) && layer.counts[state] > 0)
    .forEach((state) => (layer.kind === 'fix' ? paintFixes : paintClosures)(
      layer.items.filter((item) => item.state === state && item.times.some(isShownTime)), state,
      context, frame, layer.ramp)));
  for (const layer of shown) {
    if (layer.ellipses) paintEllipses(layer, context, frame);
    if (layer.line && layer.id !== 'corrected') paintPath(layer, context, frame);
  }
  measured([HELD_OUT, BELIEVED, WEAK]);
  for (const layer of shown) {
    if (layer.id === 'corrected') paintPath(layer, context, frame);
    if (layer.kind === 'spring') paintSprings(layer, context, frame);
  }
  measured([WAITING, REFUSED, DOUBTED]);
}

/** Lines at round coordinates, or these as texts at the left and at the lower border. */
function paintGrid(context, frame, asTexts) {
  const {scale, place, back} = frame;
  const [min, max] = asTexts ? frame.visible : [frame.min, frame.max];
  const [[left, top], [right, bottom]] = [back(min), back(max)];
  const least = 110 / scale;
  const power = 10 ** Math.floor(Math.log10(least));
  const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= least);
  const lines = new Path2D();
  for (let k = Math.ceil(left / step); k <= right / step; k += 1) {
    const u = Math.round(place(k * step, 0)[0]) + 0.5;
    lines.moveTo(u, min.y);
    lines.lineTo(u, max.y);
    if (asTexts && u > min.x + 130) halo(context, number(k * step, 6), u + 3, max.y - 5);
  }
  for (let k = Math.ceil(bottom / step); k <= top / step; k += 1) {
    const v = Math.round(place(0, k * step)[1]) + 0.5;
    lines.moveTo(min.x, v);
    lines.lineTo(max.x, v);
    if (asTexts && v < max.y - 30) halo(context, number(k * step, 6), min.x + 6, v - 3);
  }
  if (!asTexts) paint(context, lines, ['grid', 1]);
}

/** A text that can be read on whatever is below it. */
function halo(context, text, u, v) {
  context.lineJoin = 'round';
  context.strokeStyle = colour('surface');
  context.lineWidth = 3;
  context.strokeText(text, u, v);
  context.fillStyle = colour('muted');
  context.fillText(text, u, v);
}

/** Paint a shape in some colours, one above the other: lines of a width, or filled if it is 0. */
function paint(context, shape, ...coats) {
  context.lineJoin = 'round';
  for (const [name, width] of coats) {
    context.strokeStyle = context.fillStyle = colour(name);
    context.lineWidth = width;
    context[width > 0 ? 'stroke' : 'fill'](shape);
  }
}

function through(places) {
  const shape = new Path2D();
  for (const [k, [u, v]] of places.entries()) shape[k === 0 ? 'moveTo' : 'lineTo'](u, v);
  return shape;
}

function circle(u, v, radius) {
  const shape = new Path2D();
  shape.arc(u, v, radius, 0, 7);
  return shape;
}

/** Paint a path, without the points that do not show and the parts that are out of sight. */
function paintPath({line: {t, x, y}, look, ramp}, context, frame) {
  const shapes = new Map();
  let [p, q, before, last] = [Infinity, Infinity, 0, null];
  for (let k = 0; k < x.length; k += 1) {
    if (t && !isShownTime(t[k])) {
      last = null;
      continue;
    }
    const [u, v] = frame.place(x[k], y[k]);
    if (last && Math.abs(u - p) + Math.abs(v - q) < 1.5 && k < x.length - 1) continue;
    const side = sideOf(frame, u, v);
    const name = ramp ? ramp.colourOf(ramp.values[k]) : look.colour;
    if (!shapes.has(name)) shapes.set(name, new Path2D());
    const shape = shapes.get(name);
    const isCut = last === null || (side & before) !== 0;
    if (isCut) shape.moveTo(u, v);
    else if (name !== last) shape.moveTo(p, q);
    if (!isCut) shape.lineTo(u, v);
    [p, q, before, last] = [u, v, side, name];
  }
  context.setLineDash(look.dash);
  for (const [name, shape] of shapes) paint(context, shape, [name, ramp ? 4 : look.width]);
  context.setLineDash([]);
}

/** Paint ellipses, but none whose middle is in one that is painted: they would be one blot. */
function paintEllipses({ellipses: e, factor}, context, frame) {
  context.strokeStyle = context.fillStyle = colour('path');
  context.lineWidth = 1;
  const painted = [];
  for (let k = 0; k < e.x.length; k += 1) {
    if (!known(e.xx[k]) || (e.t && !isShownTime(e.t[k]))) continue;
    const [u, v] = frame.place(e.x[k], e.y[k]);
    const [mean, half] = [(e.xx[k] + e.yy[k]) / 2, Math.hypot((e.xx[k] - e.yy[k]) / 2, e.xy[k])];
    const [long, short] = [mean + half, mean - half].map(
      (variance) => 2 * factor * frame.scale * Math.sqrt(Math.max(variance, 0)));
    if (long < 1.5) continue;
    if (painted.some(([x, y, radius]) => Math.hypot(u - x, v - y) < Math.max(radius, long))) continue;
    painted.push([u, v, long]);
    context.beginPath();
    context.ellipse(u, v, long, Math.max(short, 0.3),
      -0.5 * Math.atan2(2 * e.xy[k], e.xx[k] - e.yy[k]), 0, 7);
    context.globalAlpha = 0.1;
    context.fill();
    context.globalAlpha = 0.4;
    context.stroke();
  }
  context.globalAlpha = 1;
}

/** Paint the mark of a state with a border, which lets it show on lines of any colour. */
function stamp(state, context, [u, v], size) {
  const {colour: name, shape, open} = lookOf(state);
  context.save();
  context.translate(u, v);
  context.scale(size, size);
  paint(context, new Path2D(shape), ['surface', 3.6], [name, open ? 1.7 : 0]);
  context.restore();
}

/** Paint fixes, of those that hide one another one; many are dots. */
function paintFixes(items, state, context, frame) {
  const places = new Map();
  for (const {ends: [[x, y]]} of items) {
    const [u, v] = frame.place(x, y);
    if (sideOf(frame, u, v) === 0) places.set(Math.round(u / 3) * 1e5 + Math.round(v / 3), [u, v]);
  }
  context.fillStyle = colour(lookOf(state).colour);
  for (const [u, v] of places.values()) {
    if (places.size > 400) context.fillRect(u - 1.25, v - 1.25, 2.5, 2.5);
    else stamp(state, context, [u, v], state === BELIEVED ? 0.75 : 1);
  }
}

/** Paint closures, those that are used in the colours of their errors if there is a ramp. */
function paintClosures(items, state, context, frame, ramp) {
  const {colour: name, dash} = lookOf(state);
  const [believed, byError] = [state === BELIEVED, ramp && state <= WEAK];
  const ordered = byError ? [...items].sort((one, other) => one.distance - other.distance) : items;
  const lines = ordered.map(({ends, distance}) => Object.assign(ends.map(
    (end) => frame.place(...end)), {shade: byError ? ramp.colourOf(distance) : name})).filter(
    ([one, other]) => (sideOf(frame, ...one) & sideOf(frame, ...other)) === 0);
  context.setLineDash(dash);
  context.globalAlpha = believed && !byError ? 0.75 : 1;
  for (const line of lines) paint(context, through(line), [line.shade, believed ? 1.3 : 1.6]);
  context.setLineDash([]);
  context.globalAlpha = 1;
  if (byError || lines.length > (believed || state === REFUSED ? 150 : 600)) return;
  for (const line of lines) stamp(state, context, middleOf(line), believed ? 0.7 : 1.1);
}

function paintSprings({items}, context, frame) {
  context.textAlign = 'center';
  context.textBaseline = 'middle';
  for (const {ends, spring} of items.filter(({times}) => times.some(isShownTime)).reverse()) {
    const places = ends.map((end) => frame.place(...end));
    const [u, v] = middleOf(places);
    paint(context, through(places), ['spring', 4]);
    paint(context, circle(u, v, 8.5), ['spring', 0]);
    context.fillStyle = colour('surface');
    context.fillText(String(spring.rank), u, v + 0.5);
  }
}

/** What the reader looks at: the chosen item, and the robot at the time; and coordinates. */
function paintFocus(path, context, frame) {
  paintGrid(context, frame, true);
  context.lineCap = 'round';
  context.globalAlpha = 0.35;
  for (const part of focus.spans) {
    const places = alongPath(path, part).map((place) => frame.place(...place));
    if (part[0] === part[1]) paint(context, circle(...places[0], 12), ['ink', 4]);
    else paint(context, through(places), ['ink', 13]);
  }
  context.lineCap = 'butt';
  context.globalAlpha = 1;
  if (focus.item) paintChosen(focus.item, context, frame);
  if (focus.time === null) return;
  const {x, y, theta} = poseAt(path, focus.time);
  context.translate(...frame.place(x, y));
  context.rotate(-(theta || 0));
  paint(context, new Path2D('M13,0L-8,7.5L-4.5,0L-8,-7.5Z'), ['surface', 5], ['ink', 0]);
}

/** A frame around what is chosen, and a line from a fix to where the robot was. */
function paintChosen(item, context, frame) {
  const places = item.ends.map((end) => frame.place(...end));
  const name = item.spring ? 'spring' : lookOf(item.state).colour;
  if (item.tie) paint(context, through([places[0], frame.place(...item.tie)]), [name, 1.5]);
  paint(context, through(places), ['surface', 9], [name, 4.5]);
  for (const [u, v] of places) paint(context, circle(u, v, 10), ['surface', 6], ['ink', 2.4]);
  if (!item.spring) stamp(item.state, context, middleOf(places), 1.3);
}
