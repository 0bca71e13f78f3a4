"use strict";
// Interactive charts: values at the pointer or by arrow keys, zoom by dragging, series switched off, enlarged view.
// Values are read from the drawn paths and from data-scale (low, high, start, stop, kind, label) of each axis. A zoom draws the samples
// within it from data-full: 16-bit numbers from -32767 (low) to 32767 (high) of the axis, -32768 for none.
const SVG = "http://www.w3.org/2000/svg", SUBDIVISION = 10, MOST = 32767, DOTS = 300, BUCKETS = 140, MEANS = 40;
const scaleOf = (element) => {
  const [low, high, start, stop, kind, ...label] = element.dataset.scale.split(",");
  const ends = { low: +low, high: +high }, text = label.join(",").trim();
  return { full: ends, view: { ...ends }, start: +start, stop: +stop, kind, label: text, names: element.dataset.ticks?.split("|"), unit: text.includes(", ") ? text.split(", ").pop() : "" };
};
const place = (axis, value, range = axis.view) => axis.start + (value - range.low) / (range.high - range.low) * (axis.stop - axis.start);
const valueAt = (axis, at, range = axis.view) => range.low + (at - axis.start) / (axis.stop - axis.start) * (range.high - range.low);
const plain = (value, digits = 4) => value === 0 ? "0" : Math.abs(value) >= 1e-4 && Math.abs(value) < 1e6 ? String(+value.toPrecision(digits)) : value.toExponential(Math.min(digits - 1, 2));
const say = (axis, value, digits) => plain(axis.kind === "log" ? 10 ** value : value, digits).replace("-", "\u2212");
const told = (axis, value) => { // with the digits of a coordinate: a tenth of a pixel, or 16 bits
  if (axis.names) return axis.names[Math.min(Math.max(Math.round(value), 1), axis.names.length) - 1];
  const step = (axis.full.high - axis.full.low) / (axis.exact ? 2 * MOST : Math.abs(axis.stop - axis.start) * SUBDIVISION);
  const share = axis.kind === "log" ? Math.LN10 * step : step / Math.abs(value);
  return share >= 1 ? "0" : say(axis, value, Math.min(axis.exact ? 6 : 4, Math.max(1, Math.ceil(-Math.log10(share)) + (axis.exact ? 1 : 0))));
};

function ticksOf(axis, count) {
  const { low, high } = axis.view, out = [];
  if (axis.names) return axis.names.map((name, i) => [i + 1, name]).filter(([v]) => v >= low && v <= high);
  if (axis.kind === "log" && high - low > 0.7) {
    for (let k = Math.floor(low); k <= high; k++)
      for (const m of high - low > 2 ? [1] : [1, 2, 5]) out.push(k + Math.log10(m));
    return out.filter((v) => v >= low && v <= high).map((v) => [v, say(axis, v)]);
  }
  const coarse = Math.max((high - low) / count, axis.kind === "count" ? 1 : 0), power = 10 ** Math.floor(Math.log10(coarse));
  const whole = axis.kind === "angle" && coarse > 2;
  const step = whole ? [5, 10, 15, 30, 45, 90, 180, 360, 720].find((s) => s >= coarse) ?? 3600 : power * [1, 2, 5, 10].find((s) => s * power >= coarse * 0.999);
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n++)
    out.push([n * step, axis.kind === "log" ? say(axis, n * step) : step < 2e-4 ? (n * step).toExponential(1) : (n * step).toFixed(decimals)]);
  return out;
}

const unitAt = (x, point) => point.unit ?? Math.round(valueAt(x, point[0] / SUBDIVISION, x.full)) - 1; // its place in the list of units
const known = new WeakMap();
function pointsOf(path) { // [x, low, high] of each vertex in drawing units; of a line or dots low is high
  if (known.has(path)) return known.get(path);
  const out = [];
  let x = 0, y = 0;
  for (const [, command, text] of path.getAttribute("d").matchAll(/([MLlmhV])([^MLlmhV]*)/g)) {
    const n = text.match(/-?[\d.]+(?:e-?\d+)?/g)?.map(Number) ?? [];
    if (command === "V") { out[out.length - 1][2] = n[0]; continue; }
    if (command === "h") continue;
    for (let i = 0; i < n.length; i += 2) {
      [x, y] = command === "M" || command === "L" ? [n[i], n[i + 1]] : [x + n[i], y + n[i + 1]];
      out.push([x, y, y]);
    }
  }
  path.dataset.units?.split(" ").forEach((unit, i) => { out[i].unit = unit - 1; out[i].i = i; });
  known.set(path, out);
  return out;
}

// All samples of a curve in drawing units of the full view.
const fullOf = (element, axis) => Array.from(new Int16Array(Uint8Array.from(atob(element.dataset.full), (c) => c.charCodeAt(0)).buffer),
  (n) => n < -MOST ? NaN : SUBDIVISION * (axis.start + (n / MOST + 1) / 2 * (axis.stop - axis.start)));
function buckets(points, most, form) {
  const size = Math.ceil(points.length / most), out = [];
  for (let i = 0; i < points.length; i += size) {
    const of = points.slice(i, i + size), heights = of.map((p) => p[1]), mean = (k) => of.reduce((sum, p) => sum + p[k], 0) / of.length;
    out.push(form(mean(0), mean(1), Math.max(...heights), Math.min(...heights)));
  }
  return out;
}
function detail(path, x, y, zoomed) { // draws the samples of a curve within the view: as dots, or as the ranges of buckets
  const mean = path.nextElementSibling?.matches(".mean") ? path.nextElementSibling : null, both = [path, mean].filter(Boolean);
  for (const each of both) { each.drawn ??= each.getAttribute("d"); known.delete(each); }
  path.full ??= fullOf(path, y);
  const [low, high] = [x.view.low, x.view.high].map((v) => SUBDIVISION * place(x, v, x.full));
  const points = zoomed ? path.full.map((v, i) => [x.samples[i], v]).filter(([u, v]) => u >= low && u <= high && !Number.isNaN(v)) : [];
  const few = zoomed && points.length <= DOTS, at = few ? points.map(([u, v]) => `M${u} ${v}h0`) : buckets(points, BUCKETS, (u, _, a, b) => `M${u} ${a}V${b}`);
  path.classList.toggle("dots", few); path.classList.toggle("strokes", !few);
  path.setAttribute("d", zoomed ? at.join("") : path.drawn);
  mean?.setAttribute("d", zoomed ? buckets(points, MEANS, (u, v) => `${u} ${v}`).map((p, i) => `${i ? "L" : "M"}${p}`).join("") : mean.drawn);
}

function prepare(svg) {
  const figure = svg.closest("figure"), x = scaleOf(svg), names = window.chartNames?.[svg.dataset.names], values = window.chartValues?.[svg.getAttribute("aria-labelledby").split("-t ")[0]];
  const readable = names ? ".dots" : ".line, .dots, .strokes"; // where dots are units, lines summarise many units
  const panels = [...svg.querySelectorAll(".panel")].map((group) => ({ group, y: scaleOf(group), layers: group.querySelector(".layers"), grid: group.querySelector(".grid"), ticks: group.querySelector(".ticks") }));
  const xTicks = svg.querySelector(":scope > .ticks"), xTop = +xTicks.firstElementChild?.getAttribute("y");
  const readout = document.createElement("div"), cursor = document.createElementNS(SVG, "path"), frame = document.createElementNS(SVG, "rect");
  readout.className = "readout"; readout.setAttribute("role", "status"); readout.hidden = true;
  cursor.setAttribute("class", "cursor"); frame.setAttribute("class", "frame");
  svg.tabIndex = 0;
  figure.append(readout);
  let current = 0, drag = null, shown = null, unit = null, moved = false;

  const label = (at, top, text, kind) => {
    const t = document.createElementNS(SVG, "text");
    t.setAttribute("x", at); t.setAttribute("y", top); t.setAttribute("class", kind); t.textContent = text.replace("-", "\u2212");
    return t;
  };
  const redraw = () => {
    const sx = (x.full.high - x.full.low) / (x.view.high - x.view.low), tx = x.start - sx * place(x, x.view.low, x.full);
    const across = ticksOf(x, 6), zoomed = x.view.low > x.full.low || x.view.high < x.full.high;
    if (svg.dataset.full) x.samples ??= fullOf(svg, x);
    x.exact = zoomed && svg.dataset.full;
    xTicks.replaceChildren(...across.map(([v, text]) => label(place(x, v), xTop, text, "m")));
    for (const { y, layers, grid, ticks } of panels) {
      if (!layers.parentNode.classList.contains("clip")) { // an inner svg cuts off what lies outside
        const clip = document.createElementNS(SVG, "svg"), width = x.stop - x.start, height = y.start - y.stop;
        for (const [k, v] of Object.entries({ class: "clip", x: x.start, y: y.stop, width, height, viewBox: `${x.start} ${y.stop} ${width} ${height}` })) clip.setAttribute(k, v);
        layers.replaceWith(clip); clip.append(layers);
      }
      const sy = (y.full.high - y.full.low) / (y.view.high - y.view.low), ty = y.start - sy * place(y, y.view.low, y.full);
      const curves = layers.querySelectorAll("[data-full]");
      curves.forEach((path) => detail(path, x, y, zoomed));
      y.exact = zoomed && curves.length;
      layers.setAttribute("transform", `translate(${tx} ${ty}) scale(${sx / SUBDIVISION} ${sy / SUBDIVISION})`);
      const few = ticksOf(y, Math.max(2, (y.start - y.stop) / 28)), up = few.length > 1 ? few : ticksOf(y, 4);
      ticks.replaceChildren(...up.map(([v, text]) => label(x.start - 4, place(y, v) + 3.5, text, "e")));
      grid.setAttribute("d", up.map(([v]) => `M${x.start} ${place(y, v)}H${x.stop}`).join("") + across.map(([v]) => `M${place(x, v)} ${y.stop}V${y.start}`).join(""));
    }
  };
  const zoom = (axis, low, high) => {
    const limit = (axis.full.high - axis.full.low) * 1e-4;
    if (high - low < limit) return;
    axis.view = { low: Math.max(low, axis.full.low), high: Math.min(high, axis.full.high) };
  };
  const pan = (axis, by) => {
    const wide = axis.view.high - axis.view.low, low = Math.min(Math.max(axis.view.low + by, axis.full.low), axis.full.high - wide);
    axis.view = { low, high: low + wide };
  };
  const reset = () => { for (const axis of [x, ...panels.map((p) => p.y)]) axis.view = { ...axis.full }; redraw(); };
  const hide = () => { readout.hidden = true; cursor.remove(); shown = null; };

  const nearest = (panel, at, upright) => { // the vertex of each series that is nearest to a place in drawing units of the full view
    const found = new Map();
    for (const path of panel.layers.querySelectorAll(readable)) {
      const colour = [...path.classList].find((c) => /^c\d$/.test(c));
      if (figure.classList.contains(`without-${colour}`)) continue;
      let best = null, least = Infinity;
      for (const p of pointsOf(path)) {
        const far = Math.abs(p[0] - at) + (upright === null ? 0 : Math.abs(p[1] - upright));
        if (far < least) [best, least] = [p, far];
      }
      const entry = found.get(colour) ?? {};
      if (!best || (entry.point && path.matches(".mean"))) continue; // a sample rather than the mean of many
      if (path.classList.contains("strokes")) entry.range = best; else entry.point = best;
      entry.far = least;
      found.set(colour, entry);
    }
    return found;
  };
  const show = (panel, at, upright) => {
    let found = [...nearest(panel, at, names ? upright : null)];
    if (!found.length) return hide();
    if (names) found = [found.reduce((a, b) => a[1].far <= b[1].far ? a : b)];
    const first = found[0][1].point ?? found[0][1].range, value = valueAt(x, first[0] / SUBDIVISION, x.full);
    const read = (v) => told(panel.y, valueAt(panel.y, v / SUBDIVISION, panel.y.full));
    const head = document.createElement("b");
    head.textContent = names ? names[unitAt(x, first)] : `${x.label}: ${told(x, value)}`;
    const rows = found.map(([colour, { point, range }]) => {
      const row = document.createElement("span"), dot = document.createElement("i");
      dot.className = colour;
      const name = figure.querySelector(`.legend .${colour}`)?.parentNode.textContent.trim() ?? "";
      const numbers = values ? (values[colour] ?? values.after)[point.i ?? unitAt(x, point)] : point ? read(point[1]) + (range ? ` (${read(Math.max(range[1], range[2]))} to ${read(Math.min(range[1], range[2]))})` : "") : `${read(Math.max(range[1], range[2]))} to ${read(Math.min(range[1], range[2]))}`;
      row.append(dot, `${name} ${numbers} ${panel.y.unit}`);
      return row;
    });
    readout.replaceChildren(head, ...rows);
    readout.hidden = false;
    shown = first[0];
    unit = names ? unitAt(x, first) : null;
    const px = place(x, value);
    cursor.setAttribute("d", `M${px} ${panel.y.stop}V${panel.y.start}`);
    svg.append(cursor);
    const box = svg.getBoundingClientRect(), outer = figure.getBoundingClientRect(), ratio = box.width / svg.viewBox.baseVal.width;
    const left = box.left - outer.left + px * ratio;
    readout.style.top = `${box.top - outer.top + panel.y.stop * ratio}px`;
    readout.style.left = left < outer.width / 2 ? `${left + 10}px` : "";
    readout.style.right = left < outer.width / 2 ? "" : `${outer.width - left + 10}px`;
  };
  const inside = (event) => {
    const box = svg.getBoundingClientRect(), ratio = svg.viewBox.baseVal.width / box.width;
    return [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
  };
  const panelAt = (py) => panels.reduce((a, b) => Math.abs(py - (a.y.start + a.y.stop) / 2) <= Math.abs(py - (b.y.start + b.y.stop) / 2) ? a : b);
  const base = (axis, at) => place(axis, valueAt(axis, at), axis.full) * SUBDIVISION;

  svg.addEventListener("pointermove", (event) => {
    const [px, py] = inside(event);
    if (drag?.pan) {
      pan(x, valueAt(x, drag.x) - valueAt(x, px)); pan(drag.panel.y, valueAt(drag.panel.y, drag.y) - valueAt(drag.panel.y, py));
      [drag.x, drag.y] = [px, py];
      redraw();
    } else if (drag) {
      const tall = drag.choose || Math.abs(py - drag.y) > 12, p = drag.panel.y;
      frame.setAttribute("x", Math.min(px, drag.x)); frame.setAttribute("width", Math.abs(px - drag.x));
      frame.setAttribute("y", tall ? Math.min(py, drag.y) : p.stop); frame.setAttribute("height", tall ? Math.abs(py - drag.y) : p.start - p.stop);
      svg.append(frame);
    } else if (px >= x.start && px <= x.stop) {
      const panel = panelAt(py);
      current = panels.indexOf(panel);
      show(panel, base(x, px), base(panel.y, py));
    } else hide();
  });
  svg.addEventListener("pointerdown", (event) => {
    const [px, py] = inside(event);
    if (event.pointerType !== "mouse" || event.button || px < x.start) return;
    drag = { x: px, y: py, panel: panelAt(py), pan: event.shiftKey, choose: names && (event.ctrlKey || event.metaKey) };
    moved = false;
    svg.setPointerCapture(event.pointerId);
    hide();
    event.preventDefault();
    svg.focus();
  });
  svg.addEventListener("pointerup", (event) => {
    if (!drag) return;
    const [px, py] = inside(event), { x: ox, y: oy, panel, pan: panned, choose } = drag, ends = (axis, a, b) => [valueAt(axis, a), valueAt(axis, b)].sort((p, q) => p - q);
    drag = null;
    frame.remove();
    moved = panned || Math.abs(px - ox) > 6 || Math.abs(py - oy) > 12;
    if (panned) return;
    if (choose && moved) {
      const within = (axis, a, b, at) => (at - base(axis, a)) * (at - base(axis, b)) <= 0;
      const points = [...panel.layers.querySelectorAll(".dots")].flatMap(pointsOf).filter((p) => within(x, ox, px, p[0]) && within(panel.y, oy, py, p[1]));
      return window.choose?.([...new Set(points.map((p) => unitAt(x, p)))]);
    }
    if (Math.abs(px - ox) > 6) zoom(x, ...ends(x, ox, px));
    if (Math.abs(py - oy) > 12) zoom(panel.y, ...ends(panel.y, oy, py));
    if (Math.abs(px - ox) > 6 || Math.abs(py - oy) > 12) redraw();
  });
  svg.addEventListener("click", (event) => {
    if (!names || moved) return;
    const [px, py] = inside(event), panel = panelAt(py);
    show(panel, base(x, px), base(panel.y, py));
    if (unit !== null) window.choose?.([unit]);
  });
  svg.addEventListener("pointercancel", () => { drag = null; frame.remove(); });
  svg.addEventListener("pointerleave", () => { if (!drag) hide(); });
  svg.addEventListener("blur", hide);
  svg.addEventListener("dblclick", reset);
  svg.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const panel = panels[current], all = [...panel.layers.querySelectorAll(readable)].flatMap((p) => pointsOf(p).map((q) => q[0]));
    const column = [...new Set(all)].sort((a, b) => a - b).filter((v) => v >= base(x, x.start) - 1 && v <= base(x, x.stop) + 1);
    const i = shown === null ? -1 : column.findIndex((v) => v >= shown), middle = valueAt(x, (x.start + x.stop) / 2), half = (x.view.high - x.view.low) / 2;
    if (event.shiftKey && event.key.startsWith("Arrow")) {
      const [dx, dy] = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      for (const [axis, by] of [[x, dx], [panel.y, dy]]) pan(axis, by * (axis.view.high - axis.view.low) / 10);
      redraw();
      event.preventDefault();
      return;
    }
    const step = { ArrowRight: 1, ArrowLeft: -1, PageDown: 10, PageUp: -10 }[event.key];
    if (step) show(panel, column[Math.min(Math.max(i + step, 0), column.length - 1)], null);
    else if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      if (panels.length === 1) return;
      current = (current + (event.key === "ArrowDown" ? 1 : panels.length - 1)) % panels.length;
      show(panels[current], shown ?? column[0], null);
    } else if (event.key === "+" || event.key === "-") {
      const about = shown === null ? middle : valueAt(x, shown / SUBDIVISION, x.full), wide = half * (event.key === "+" ? 0.5 : 2);
      zoom(x, about - wide, about + wide);
      redraw();
    } else if (event.key === "Enter" && shown !== null && unit !== null) window.choose?.([unit]);
    else if (event.key === "0" || (event.key === "Escape" && (shown !== null || x.view.low !== x.full.low || x.view.high !== x.full.high))) { hide(); reset(); } else return;
    event.preventDefault();
    event.stopPropagation();
  });
}

for (const svg of document.querySelectorAll("svg[data-scale]")) {
  const start = () => { // prepared when it is first used: a page holds dozens of charts
    svg.removeEventListener("pointerenter", start); svg.removeEventListener("focus", start);
    prepare(svg);
  };
  svg.tabIndex = 0;
  svg.addEventListener("pointerenter", start); svg.addEventListener("focus", start);
}
for (const item of document.querySelectorAll("figure .legend li")) {
  const colour = item.querySelector("i").className, figure = item.closest("figure");
  if (!figure.querySelector(`.layers .${colour}`)) continue;
  const button = document.createElement("button");
  button.type = "button";
  button.setAttribute("aria-pressed", "true");
  button.append(...item.childNodes);
  button.addEventListener("click", () => button.setAttribute("aria-pressed", String(!figure.classList.toggle(`without-${colour}`))));
  item.append(button);
}
const large = document.createElement("dialog");
large.setAttribute("aria-label", "Enlarged chart");
document.body.append(large);
large.addEventListener("close", () => large.figure.space.replaceWith(large.figure));
for (const figure of document.querySelectorAll("figure")) {
  const tools = document.createElement("div"), button = document.createElement("button");
  tools.className = "tools"; button.type = "button"; button.className = "enlarge"; button.textContent = "\u2922";
  button.setAttribute("aria-label", "Enlarge or put back this chart");
  button.addEventListener("click", () => {
    if (large.open) { large.close(); button.focus(); return; }
    figure.space = document.createElement("figure");
    figure.replaceWith(figure.space);
    large.figure = figure;
    large.append(figure);
    large.showModal();
  });
  tools.append(button);
  figure.prepend(tools);
}
for (const hint of document.querySelectorAll(".chart-hint")) hint.hidden = !document.querySelector("svg[data-scale]");
if (window.parent !== window) // shown inside of another page, such as a report of Snakemake: links to other pages do not work
  for (const link of document.querySelectorAll("a[href]:not([href^='#'])")) link.replaceWith(...link.childNodes);
