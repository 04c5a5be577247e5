// Copyright 2026 The pose_graph_ros authors
// SPDX-License-Identifier: Apache-2.0
// Which part of the map is seen, and the gestures that change it: wheel, drag, pinch, double click,
// keys. The middle of the view is (x, y) [m], its scale is in pixels per metre.

const SCALES = [1e-4, 2e4];

function makeView(surface, onChange) {
  const view = {x: 0, y: 0, scale: 1, moving: null};

  view.toScreen = (x, y) => [
    surface.canvas.clientWidth / 2 + (x - view.x) * view.scale,
    surface.canvas.clientHeight / 2 - (y - view.y) * view.scale];
  view.toMap = (u, v) => [
    view.x + (u - surface.canvas.clientWidth / 2) / view.scale,
    view.y - (v - surface.canvas.clientHeight / 2) / view.scale];
  view.set = (x, y, scale) => {
    view.scale = Math.min(SCALES[1], Math.max(SCALES[0], scale));
    [view.x, view.y] = [x, y];
    onChange();
  };
  view.pan = (right, down) => view.set(
    view.x - right / view.scale, view.y + down / view.scale, view.scale);
  /** Zoom so that a point of the screen stays where it is. */
  view.zoom = (factor, u = surface.canvas.clientWidth / 2, v = surface.canvas.clientHeight / 2) => {
    const [x, y] = view.toMap(u, v);
    const scale = Math.min(SCALES[1], Math.max(SCALES[0], view.scale * factor));
    const part = 1 - view.scale / scale;
    view.set(view.x + (x - view.x) * part, view.y + (y - view.y) * part, scale);
  };
  /** Go to a place, at once for those who want no motion. */
  view.flyTo = (x, y, scale) => {
    cancelAnimationFrame(view.moving);
    const from = {x: view.x, y: view.y, scale: view.scale};
    if (CALM.matches) { view.set(x, y, scale); return; }
    const began = performance.now();
    const step = (now) => {
      const t = Math.min(1, Math.max(0, (now - began) / 260));
      const part = t * t * (3 - 2 * t);
      view.set(from.x + (x - from.x) * part, from.y + (y - from.y) * part,
        from.scale * (scale / from.scale) ** part);
      if (t < 1) view.moving = requestAnimationFrame(step);
    };
    view.moving = requestAnimationFrame(step);
  };
  /** Show a box of the map as a whole. */
  view.fit = (box, fly = true) => {
    const {clientWidth: width, clientHeight: height} = surface.canvas;
    (fly ? view.flyTo : view.set)(...middleAndScale(box, {width, height}));
  };
  /** Whether just this box is shown. */
  view.fits = (box, size) => {
    const [x, y, scale] = middleAndScale(box, size);
    return Math.hypot(view.x - x, view.y - y) * scale < 1 && Math.abs(view.scale / scale - 1) < 1e-6;
  };
  return view;
}

function middleAndScale({left, right, bottom, top}, {width, height}) {
  const scale = Math.min((width - 60) / Math.max(right - left, 1),
    (height - 70) / Math.max(top - bottom, 1));
  return [(left + right) / 2, (bottom + top) / 2, Math.min(SCALES[1], Math.max(scale, SCALES[0]))];
}

/** Let pointer, wheel and keys change a view; `onPick` gets clicks, `onHover` where the mouse is. */
function addGestures(surface, view, {onPick, onHover, onFit}) {
  const {canvas} = surface;
  const held = new Map();
  let [travelled, hadTwo] = [0, false];

  canvas.addEventListener('pointerdown', (event) => {
    if (event.button !== 0) return;
    cancelAnimationFrame(view.moving);
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.offsetX, event.offsetY]);
    if (held.size === 1) [travelled, hadTwo] = [0, false]; else hadTwo = true;
  });
  canvas.addEventListener('pointermove', (event) => {
    const now = [event.offsetX, event.offsetY];
    const before = held.get(event.pointerId);
    if (!before) { onHover(...now); return; }
    const others = [...held].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    held.set(event.pointerId, now);
    const [right, down] = [now[0] - before[0], now[1] - before[1]];
    travelled += Math.abs(right) + Math.abs(down);
    if (others.length === 0) {
      if (travelled > 4 || event.pointerType === 'mouse') view.pan(right, down);
      return;
    }
    const [u, v] = others[0];
    const apart = (at) => Math.max(Math.hypot(at[0] - u, at[1] - v), 1);
    view.pan(right / 2, down / 2);
    view.zoom(apart(now) / apart(before), (now[0] + u) / 2, (now[1] + v) / 2);
  });
  const release = (event) => {
    if (!held.delete(event.pointerId)) return;
    if (event.type === 'pointerup' && travelled <= 5 && !hadTwo) {
      onPick(event.offsetX, event.offsetY, event.pointerType === 'mouse' ? 9 : 18);
    }
  };
  canvas.addEventListener('pointerup', release);
  canvas.addEventListener('pointercancel', release);
  canvas.addEventListener('pointerleave', () => { if (held.size === 0) onHover(null, null); });
  canvas.addEventListener('dblclick', (event) => {
    event.preventDefault();
    const [x, y] = view.toMap(event.offsetX, event.offsetY);
    const part = event.shiftKey ? -1 : 0.5;     // so that the place stays under the pointer
    view.flyTo(view.x + (x - view.x) * part, view.y + (y - view.y) * part,
      view.scale * (event.shiftKey ? 0.5 : 2));
  });
  wheelZooms(canvas, view);
  canvas.addEventListener('keydown', (event) => {
    const step = event.shiftKey ? 200 : 60;
    const action = {
      ArrowLeft: () => view.pan(step, 0), ArrowRight: () => view.pan(-step, 0),
      ArrowUp: () => view.pan(0, step), ArrowDown: () => view.pan(0, -step),
      '+': () => view.zoom(1.5), '=': () => view.zoom(1.5), '-': () => view.zoom(1 / 1.5),
      0: onFit, Escape: () => lookAtItem(null),
      Enter: () => onPick(canvas.clientWidth / 2, canvas.clientHeight / 2, Infinity),
    }[event.key];
    if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    action();
  });
}

/** The wheel zooms, unless it has begun to scroll the page before the map came under it. */
function wheelZooms(canvas, view) {
  let scrolled = -Infinity;
  window.addEventListener('wheel', (event) => {
    if (event.target !== canvas) scrolled = performance.now();
  }, {passive: true});
  canvas.addEventListener('wheel', (event) => {
    if (performance.now() - scrolled < 200) { scrolled = performance.now(); return; }
    event.preventDefault();
    const pixels = event.deltaY * [1, 33, 400][event.deltaMode];
    // a pinch on a touchpad comes as a wheel with ctrl, in small steps
    view.zoom(Math.exp(-Math.min(240, Math.max(-240, pixels)) * (event.ctrlKey ? 0.01 : 0.002)),
      event.offsetX, event.offsetY);
  }, {passive: false});
}
