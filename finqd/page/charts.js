// The charts, as SVG made by hand: the map, the curves, the Pareto front, the parallel coordinates. Each is drawn anew
// into its host at the host's width, and leaves in `marks` what moves its mark to the design that is chosen. Texts from
// files only ever become text nodes and attributes.

const marks = {};

const SVG_NAMESPACE = "http://www.w3.org/2000/svg";

function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS(SVG_NAMESPACE, tag);
  for (const [name, value] of Object.entries(attributes)) if (value !== null && value !== undefined) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

function html(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value === true) node.setAttribute(name, "");
    else if (value !== null && value !== undefined && value !== false) node.setAttribute(name, value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return node;
}

function number(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const options = size >= 1000 ? { maximumFractionDigits: 0 } : { maximumSignificantDigits: digits };
  return value.toLocaleString("en-GB", options).replace("-", "−");
}
const withUnit = (value, unit) => (unit ? `${number(value)} ${unit}` : number(value));
const titled = (named) => (named.unit ? `${named.name} [${named.unit}]` : named.name);
const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

function ticks(low, high, count) {
  const raw = (high - low || 1) / Math.max(1, count), base = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * base).find((s) => s >= raw * 0.999), found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(Number((k * step).toPrecision(12)));
  return found;
}

const linear = (low, high, from, to) => (value) => from + ((value - low) / (high - low || 1)) * (to - from);

function colourAt(share) {
  const stops = data.colours, at = Math.max(0, Math.min(1, share)) * (stops.length - 1), i = Math.min(Math.floor(at), stops.length - 2);
  const channel = (text, k) => parseInt(text.slice(1 + 2 * k, 3 + 2 * k), 16);
  return `rgb(${[0, 1, 2].map((k) => Math.round(channel(stops[i], k) + (at - i) * (channel(stops[i + 1], k) - channel(stops[i], k)))).join(",")})`;
}

function frame(host, { height, left, right = 12, top = 12, bottom = 44, label }) {
  const width = Math.max(260, host.clientWidth);
  const root = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
  host.replaceChildren(root);
  return { root, width, height, box: { left, right: width - right, top, bottom: height - bottom } };
}

function axisX(root, box, scale, values, title, write = number) {
  for (const value of values) {
    const x = scale(value);
    root.append(svg("line", { x1: x, x2: x, y1: box.bottom, y2: box.bottom + 5, class: "tick" }),
      svg("text", { x, y: box.bottom + 18, class: "tick-text", "text-anchor": "middle" }, write(value)));
  }
  root.append(svg("text", { x: (box.left + box.right) / 2, y: box.bottom + 37, class: "axis-title", "text-anchor": "middle" }, title));
}

function axisY(root, box, scale, values, title, { grid = false, write = number } = {}) {
  for (const value of values) {
    const y = scale(value);
    root.append(svg("line", { x1: grid ? box.left : box.left - 5, x2: grid ? box.right : box.left, y1: y, y2: y, class: grid ? "grid" : "tick" }),
      svg("text", { x: box.left - 9, y: y + 4, class: "tick-text", "text-anchor": "end" }, write(value)));
  }
  root.append(svg("text", { transform: `translate(13 ${(box.top + box.bottom) / 2}) rotate(-90)`, class: "axis-title", "text-anchor": "middle" }, title));
}

// -- the map ----------------------------------------------------------------------------------------------------------

// The elites that the map shows, by "i,j": with more than two axes the best over the others.
function mapCells() {
  const found = new Map();
  for (const d of data.designs) {
    if (!d.elite) continue;
    const place = `${d.cell[0]},${d.cell[1] ?? 0}`, other = found.get(place);
    if (!other || d.objective > other.objective) found.set(place, d);
  }
  return found;
}

function drawMap(host) {
  const [ax, ay] = [data.axes[0], data.axes[1] || { name: "", unit: "", low: 0, high: 1, cells: 1 }];
  const wide = Math.max(260, host.clientWidth), height = data.axes[1] ? Math.round(Math.min(0.82 * wide + 40, 620)) : 150;
  const cells = mapCells(), colour = colourings()[state.colour];
  const { root, box } = frame(host, { height, left: data.axes[1] ? 74 : 16, right: 8, top: 10 });
  root.setAttribute("role", "listbox");
  root.setAttribute("aria-label", `Map of ${cells.size} designs. Arrow keys go from design to design.`);
  const x = linear(0, ax.cells, box.left, box.right), y = linear(0, ay.cells, box.bottom, box.top);
  const [w, h] = [x(1) - x(0), y(0) - y(1)], written = w > 30 && h > 17;
  root.append(svg("rect", { x: box.left, y: box.top, width: box.right - box.left, height: box.bottom - box.top, class: "map-ground" }));
  if (ax.cells <= 40 && ay.cells <= 40) {
    for (let i = 1; i < ax.cells; i++) root.append(svg("line", { x1: x(i), x2: x(i), y1: box.top, y2: box.bottom, class: "map-line" }));
    for (let j = 1; j < ay.cells; j++) root.append(svg("line", { x1: box.left, x2: box.right, y1: y(j), y2: y(j), class: "map-line" }));
  }
  for (const [place, d] of cells) {
    const [i, j] = place.split(",").map(Number), share = colour.share(d), text = colour.text(d);
    const cell = svg("g", { role: "option", class: "cell", tabindex: -1, "data-index": d.index, "data-place": place, "aria-selected": false, "aria-label": `${cellName(d)}: ${colour.name} ${text}; ${featuresText(d)}` },
      svg("title", {}, `${cellName(d)}\n${colour.name} ${text}\n${featuresText(d, "\n")}`),
      svg("rect", { x: x(i), y: y(j + 1), width: w, height: h, fill: share === null ? "#d9dde1" : colourAt(share) }));
    if (written) cell.append(svg("text", { x: x(i) + w / 2, y: y(j) - h / 2 + 4, "text-anchor": "middle", class: "cell-text", fill: share > 0.62 ? "#16242c" : "#fff" }, text));
    if (!matches(d)) cell.classList.add("faded");
    root.append(cell);
  }
  markBenchmark(root, x, y, w, h);
  marks.map = markedCell(root, x, y, w, h);
  marks.map();
  axisX(root, box, linear(ax.low, ax.high, box.left, box.right), ticks(ax.low, ax.high, wide / 110), titled(ax));
  if (data.axes[1]) axisY(root, box, linear(ay.low, ay.high, box.bottom, box.top), ticks(ay.low, ay.high, height / 70), titled(ay));
  root.addEventListener("click", (e) => { const cell = e.target.closest(".cell"); if (cell) select(Number(cell.dataset.index), { focus: "map" }); });
  root.addEventListener("keydown", (e) => moveOnMap(e, cells));
}

function markBenchmark(root, x, y, w, h) {
  const b = data.benchmark;
  if (b && b.cell && b.cell.length <= 2) {
    root.append(svg("rect", { x: x(b.cell[0]) + 1.5, y: y((b.cell[1] ?? 0) + 1) + 1.5, width: Math.max(2, w - 3), height: Math.max(2, h - 3), class: "benchmark-ground" }),
      svg("rect", { x: x(b.cell[0]) + 1.5, y: y((b.cell[1] ?? 0) + 1) + 1.5, width: Math.max(2, w - 3), height: Math.max(2, h - 3), class: "benchmark-cell" },
      svg("title", {}, `${b.name} lies here: ${featureValues(b.features)}`)));
  }
}

// Frames the chosen cell, and makes it the one that the tab key reaches.
function markedCell(root, x, y, w, h) {
  const frameOf = svg("rect", { width: w + 2, height: h + 2, class: "selected-cell" });
  let last = null;
  return () => {
    const d = byIndex.get(state.selected), now = root.querySelector(`[data-index="${state.selected}"]`) || root.querySelector(".cell");
    if (last) { last.setAttribute("tabindex", -1); last.setAttribute("aria-selected", false); }
    last = now;
    now.setAttribute("tabindex", 0);
    now.setAttribute("aria-selected", Number(now.dataset.index) === state.selected);
    frameOf.remove();
    if (!d) return;
    frameOf.setAttribute("x", x(d.cell[0]) - 1);
    frameOf.setAttribute("y", y((d.cell[1] ?? 0) + 1) - 1);
    root.append(frameOf);
  };
}

// The nearest filled cell in the direction of the key: what lies straight ahead counts for more than what lies aside.
function moveOnMap(event, cells) {
  const here = event.target.closest(".cell"), ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  if (!here) return;
  if (event.key === "Enter" || event.key === " ") { event.preventDefault(); select(Number(here.dataset.index), { focus: "map" }); return; }
  const way = ways[event.key];
  if (!way) return;
  event.preventDefault();
  const at = here.dataset.place.split(",").map(Number);
  let best = null, least = Infinity;
  for (const [place, d] of cells) {
    const [dx, dy] = place.split(",").map((v, k) => Number(v) - at[k]);
    const ahead = dx * way[0] + dy * way[1], aside = Math.abs(dx * way[1]) + Math.abs(dy * way[0]);
    if (ahead > 0 && ahead + 2.5 * aside < least) [best, least] = [d, ahead + 2.5 * aside];
  }
  if (best) select(best.index, { focus: "map" });
}

function drawLegend(host) {
  const colour = colourings()[state.colour], bar = svg("svg", { width: 120, height: 12, "aria-hidden": "true" });
  for (let k = 0; k < 60; k++) bar.append(svg("rect", { x: 2 * k, y: 0, width: 2.3, height: 12, fill: colourAt(k / 59) }));
  host.replaceChildren(html("span", {}, colour.low), bar, html("span", {}, colour.high));
}

// -- curves -----------------------------------------------------------------------------------------------------------

function drawCurves(host) {
  const c = data.curves, total = c.seconds[c.seconds.length - 1], [unit, length] = total > 36000 ? ["h", 3600] : total > 600 ? ["min", 60] : ["s", 1];
  const time = { name: `computing time [${unit}]`, values: c.seconds.map((s) => s / length) };
  const kinds = [["coverage", "coverage [% of cells]", c.coverage.map((v) => 100 * v)], ["score", "QD score", c.score]];
  const panels = kinds.flatMap((kind) => [["evaluations", c.evaluations], [time.name, time.values]].map((across) => [kind, across]));
  host.replaceChildren(...panels.map(() => html("div", { class: "panel" })));
  panels.forEach(([[id, title, values], [xName, xs]], k) => {
    const last = values[values.length - 1], label = `${title} against ${xName}: ${number(last)} after ${number(xs[xs.length - 1])}`;
    const { root, width, box } = frame(host.children[k], { height: 220, left: 62, right: 30, label });
    const x = linear(0, Math.max(xs[xs.length - 1], 1e-9), box.left, box.right), y = linear(0, Math.max(...values, 1e-9) * 1.06, box.bottom, box.top);
    axisY(root, box, y, ticks(0, Math.max(...values, 1e-9), 4), title, { grid: true });
    axisX(root, box, x, ticks(0, Math.max(xs[xs.length - 1], 1e-9), width / 90), xName);
    if (xName === "evaluations" && c.iterations.length <= 40) for (const i of c.iterations) root.append(svg("line", { x1: x(i), x2: x(i), y1: box.bottom, y2: box.bottom - 4, class: "tick" }));
    const points = xs.map((v, i) => (i ? `H${x(v).toFixed(1)}V${y(values[i]).toFixed(1)}` : `M${x(v).toFixed(1)},${y(values[0]).toFixed(1)}`));
    root.append(svg("path", { d: points.join(""), class: "curve", "data-kind": id }),
      svg("circle", { cx: x(xs[xs.length - 1]), cy: y(last), r: 3.5, class: "curve-end" }),
      svg("text", { x: box.right, y: y(last) - 8, "text-anchor": "end", class: "value-text" }, number(last)));
  });
}

// -- Pareto -----------------------------------------------------------------------------------------------------------

function drawPareto(host) {
  const p = data.pareto, front = p.front.map((i) => byIndex.get(i)), b = data.benchmark;
  const { root, width, box } = frame(host, { height: 340, left: 62, right: 18, top: 16, label:
    `Fitness against ${p.name}, ${front.length} designs on the front` });
  root.setAttribute("role", "group");
  const xs = [...p.cloud.x, ...(b && Number.isFinite(b.features[p.key]) ? [b.features[p.key]] : [])];
  if (!xs.length) { host.replaceChildren(html("p", { class: "empty" }, "No design was evaluated to its end.")); return; }
  const low = xs.reduce((a, v) => Math.min(a, v)), high = xs.reduce((a, v) => Math.max(a, v)), pad = 0.05 * (high - low || 1);
  const x = linear(low - pad, high + pad, box.left, box.right), y = linear(0, 1.04, box.bottom, box.top);
  axisY(root, box, y, ticks(0, 1, 5), "fitness (share of objects held)", { grid: true });
  axisX(root, box, x, ticks(low - pad, high + pad, width / 110), titled(p));
  const dots = new Map(); // as many evaluations share a place on the screen, one path of round dots is enough
  p.cloud.x.forEach((v, i) => { const at = `${x(v).toFixed(0)},${y(p.cloud.fitness[i]).toFixed(1)}`; dots.set(at, (dots.get(at) || 0) + 1); });
  root.append(svg("path", { class: "cloud", d: [...dots.keys()].map((at) => `M${at}h0`).join("") }));
  for (const d of data.designs) if (d.elite) root.append(svg("circle", { cx: x(d.features[p.key]), cy: y(d.fitness), r: 3, class: matches(d) ? "elite-dot" : "elite-dot faded" }));
  if (front.length) {
    const steps = front.map((d, i) => `${i ? "H" : "M"}${x(d.features[p.key]).toFixed(1)}${i ? "V" : ","}${y(d.fitness).toFixed(1)}`);
    root.append(svg("path", { d: `${steps.join("")}H${box.right}`, class: "front" }));
  }
  for (const d of front) {
    const text = `${designName(d)}: fitness ${number(d.fitness)}, ${p.name} ${withUnit(d.features[p.key], p.unit)}`;
    const dot = svg("circle", { cx: x(d.features[p.key]), cy: y(d.fitness), r: 6.5, class: "front-dot", tabindex: 0, role: "button", "data-index": d.index, "aria-label": text }, svg("title", {}, text));
    const pick = () => select(d.index, { focus: "front" });
    dot.addEventListener("click", pick);
    dot.addEventListener("keydown", (e) => { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); pick(); } });
    root.append(dot);
  }
  markOnPareto(root, x, y, box);
}

function markOnPareto(root, x, y, box) {
  const { key } = data.pareto, b = data.benchmark, ring = svg("circle", { r: 10, class: "selected-ring" });
  marks.pareto = () => {
    const d = byIndex.get(state.selected);
    ring.remove();
    if (!d) return;
    ring.setAttribute("cx", x(d.features[key]));
    ring.setAttribute("cy", y(d.fitness));
    root.append(ring);
  };
  marks.pareto();
  if (!b || !Number.isFinite(b.features[key])) return;
  const at = x(b.features[key]), known = Number.isFinite(b.fitness), right = at > (box.left + box.right) / 2;
  root.append(svg("line", { x1: at, x2: at, y1: box.top, y2: box.bottom, class: "benchmark-line" }),
    svg("text", { x: at + (right ? -6 : 6), y: box.bottom - 8, "text-anchor": right ? "end" : "start", class: "value-text benchmark-text" }, known ? b.name : `${b.name}, not evaluated`));
  if (known) root.append(svg("path", { d: `M${at},${y(b.fitness) - 7}l7,7l-7,7l-7,-7z`, class: "benchmark-mark" }, svg("title", {}, `${b.name}: fitness ${number(b.fitness)}`)));
}

// -- parallel coordinates ---------------------------------------------------------------------------------------------

function drawParallel(host) {
  const axes = parallelAxes(), elites = data.designs.filter((d) => d.elite);
  if (!elites.length) { host.replaceChildren(html("p", { class: "empty" }, "There are no elites yet.")); return; }
  const inner = html("div", { class: "parallel-inner" });
  inner.style.minWidth = `${Math.max(0, 66 * axes.length)}px`;
  host.replaceChildren(inner);
  const height = 400, canvas = html("canvas", { "aria-hidden": "true" }), over = html("canvas", { "aria-hidden": "true" });
  const { root, width, box } = frame(inner, { height, left: 40, right: 40, top: 78, bottom: 30, label: `Parallel coordinates of ${elites.length} elites over ${axes.length} axes` });
  root.setAttribute("role", "group");
  inner.prepend(canvas, over);
  const at = (k) => box.left + (k * (box.right - box.left)) / Math.max(1, axes.length - 1);
  const scales = axes.map((axis) => linear(axis.low, axis.high, box.bottom, box.top));
  const path = (pen, d) => { pen.beginPath(); axes.forEach((axis, k) => (k ? pen.lineTo(at(k), scales[k](axis.value(d))) : pen.moveTo(at(k), scales[k](axis.value(d))))); };
  paintLines(cleared(canvas, width, height), elites, path);
  marks.parallel = () => paintChosen(cleared(over, width, height), path);
  marks.parallel();
  axes.forEach((axis, k) => {
    const axisGroup = svg("g", { transform: `translate(${at(k)} 0)`, class: "parallel-axis" }), limit = state.limits[axis.key];
    axisGroup.append(svg("line", { y1: box.top, y2: box.bottom, class: "axis-line" }),
      svg("text", { y: box.top - 8, "text-anchor": "middle", class: "tick-text" }, number(axis.high, 3)),
      svg("text", { y: box.bottom + 16, "text-anchor": "middle", class: "tick-text" }, number(axis.low, 3)));
    const title = [...wrapped(axis.name), axis.unit ? `[${axis.unit}]` : ""].filter(Boolean);
    title.forEach((line, i) => axisGroup.append(svg("text", { y: box.top - 27 - 14 * (title.length - 1 - i), "text-anchor": "middle", class: "axis-title" }, line)));
    if (limit) {
      const [a, b] = [limit[0] ?? axis.low, limit[1] ?? axis.high].map(scales[k]);
      axisGroup.append(svg("rect", { x: -7, width: 14, y: b, height: Math.max(3, a - b), class: "brush" }));
    }
    axisGroup.append(brushable(axis, k, box, scales[k]));
    root.append(axisGroup);
  });
}

function wrapped(name) {
  const lines = [""];
  for (const word of name.split(" ")) {
    if (lines[lines.length - 1] && lines[lines.length - 1].length + word.length > 9) lines.push("");
    lines[lines.length - 1] += (lines[lines.length - 1] ? " " : "") + word;
  }
  return lines;
}

function cleared(canvas, width, height) {
  const ratio = window.devicePixelRatio || 1, pen = canvas.getContext("2d");
  [canvas.width, canvas.height] = [ratio * width, ratio * height];
  [canvas.style.width, canvas.style.height] = [`${width}px`, `${height}px`];
  pen.scale(ratio, ratio);
  return pen;
}

function paintLines(pen, elites, path) {
  const colour = colourings()[state.colour], fine = elites.filter(matches), line = (d, style, thickness, alpha) => {
    path(pen, d);
    [pen.strokeStyle, pen.lineWidth, pen.globalAlpha] = [style, thickness, alpha];
    pen.stroke();
  };
  const dense = Math.max(0.25, Math.min(0.85, 40 / Math.max(1, fine.length)));
  for (const d of elites) if (!matches(d)) line(d, "#c9cfd4", 1, 0.35);
  for (const d of [...fine].sort((a, b) => a.objective - b.objective)) line(d, colourAt(colour.share(d) ?? 0), 1.3, dense);
}

function paintChosen(pen, path) {
  const chosen = byIndex.get(state.selected);
  if (!chosen) return;
  for (const [style, thickness] of [["#fff", 5], ["#c2410c", 2.6]]) {
    path(pen, chosen);
    [pen.strokeStyle, pen.lineWidth] = [style, thickness];
    pen.stroke();
  }
}

function brushable(axis, k, box, scale) {
  const area = svg("rect", { x: -14, width: 28, y: box.top, height: box.bottom - box.top, class: "brush-area" }, svg("title", {}, `Drag to limit ${axis.name}; click to lift the limit`));
  const valueAt = (e) => { const y = e.clientY - area.getBoundingClientRect().top + box.top; return axis.low + ((box.bottom - y) / (box.bottom - box.top)) * (axis.high - axis.low); };
  area.addEventListener("pointerdown", (e) => {
    const from = valueAt(e), mark = svg("rect", { x: -7, width: 14, class: "brush" });
    area.before(mark);
    area.setPointerCapture(e.pointerId);
    const move = (m) => { const ys = [from, valueAt(m)].map(scale).sort((a, b) => a - b); mark.setAttribute("y", ys[0]); mark.setAttribute("height", ys[1] - ys[0]); };
    area.addEventListener("pointermove", move);
    area.addEventListener("pointerup", (u) => {
      const [low, high] = [from, valueAt(u)].sort((a, b) => a - b), near = 0.025 * (axis.high - axis.low);
      const end = (value, limit) => (Math.abs(value - limit) < near || (value - limit) * (axis.high + axis.low - 2 * limit) < 0 ? null : Number(value.toPrecision(4)));
      setLimit(axis.key, high - low < 0.6 * near ? null : [end(low, axis.low), end(high, axis.high)]); // up to an end: no limit there
    }, { once: true });
  });
  return area;
}
