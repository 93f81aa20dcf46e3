// Parallel coordinates of the elites: lines on a canvas, axes that can be dragged along above it.

function drawParallel(host) {
  const axes = parallelAxes(),
    elites = data.designs.filter((d) => d.elite);
  if (!elites.length) {
    host.replaceChildren(html("p", { class: "empty" }, "There are no elites yet."));
    return;
  }
  const inner = html("div", { class: "parallel-inner" });
  inner.style.minWidth = `${Math.max(0, 66 * axes.length)}px`;
  host.replaceChildren(inner);
  const height = 400,
    canvas = html("canvas", { "aria-hidden": "true" }),
    over = html("canvas", { "aria-hidden": "true" });
  const { root, width, box } = frame(inner, {
    height,
    left: 40,
    right: 40,
    top: 78,
    bottom: 30,
    label: `Parallel coordinates of ${elites.length} elites over ${axes.length} axes`,
  });
  root.setAttribute("role", "group");
  inner.prepend(canvas, over);
  const at = (k) => box.left + (k * (box.right - box.left)) / Math.max(1, axes.length - 1);
  const scales = axes.map((axis) => linear(axis.low, axis.high, box.bottom, box.top));
  const path = (pen, d) => {
    pen.beginPath();
    axes.forEach((axis, k) =>
      k ? pen.lineTo(at(k), scales[k](axis.value(d))) : pen.moveTo(at(k), scales[k](axis.value(d))),
    );
  };
  paintLines(cleared(canvas, width, height), elites, path);
  marks.parallel = () => paintChosen(cleared(over, width, height), path);
  marks.parallel();
  axes.forEach((axis, k) => {
    const axisGroup = svg("g", { transform: `translate(${at(k)} 0)`, class: "parallel-axis" }),
      limit = state.limits[axis.key];
    axisGroup.append(
      svg("line", { y1: box.top, y2: box.bottom, class: "axis-line" }),
      svg("text", { y: box.top - 8, "text-anchor": "middle", class: "tick-text" }, number(axis.high, 3)),
      svg("text", { y: box.bottom + 16, "text-anchor": "middle", class: "tick-text" }, number(axis.low, 3)),
    );
    const title = [...wrapped(axis.name), axis.unit ? `[${axis.unit}]` : ""].filter(Boolean);
    title.forEach((line, i) =>
      axisGroup.append(
        svg(
          "text",
          { y: box.top - 27 - 14 * (title.length - 1 - i), "text-anchor": "middle", class: "axis-title" },
          line,
        ),
      ),
    );
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
  const ratio = window.devicePixelRatio || 1,
    pen = canvas.getContext("2d");
  [canvas.width, canvas.height] = [ratio * width, ratio * height];
  [canvas.style.width, canvas.style.height] = [`${width}px`, `${height}px`];
  pen.scale(ratio, ratio);
  return pen;
}

function paintLines(pen, elites, path) {
  const colour = colourings()[state.colour],
    fine = elites.filter(matches),
    line = (d, style, thickness, alpha) => {
      path(pen, d);
      [pen.strokeStyle, pen.lineWidth, pen.globalAlpha] = [style, thickness, alpha];
      pen.stroke();
    };
  const dense = Math.max(0.25, Math.min(0.85, 40 / Math.max(1, fine.length)));
  for (const d of elites) if (!matches(d)) line(d, "#c9cfd4", 1, 0.35);
  for (const d of [...fine].sort((a, b) => a.objective - b.objective))
    line(d, colourAt(colour.share(d) ?? 0), 1.3, dense);
}

function paintChosen(pen, path) {
  const chosen = byIndex.get(state.selected);
  if (!chosen) return;
  for (const [style, thickness] of [
    ["#fff", 5],
    ["#c2410c", 2.6],
  ]) {
    path(pen, chosen);
    [pen.strokeStyle, pen.lineWidth] = [style, thickness];
    pen.stroke();
  }
}

function brushable(axis, k, box, scale) {
  const area = svg(
    "rect",
    { x: -14, width: 28, y: box.top, height: box.bottom - box.top, class: "brush-area" },
    svg("title", {}, `Drag to limit ${axis.name}; click to lift the limit`),
  );
  const valueAt = (e) => {
    const y = e.clientY - area.getBoundingClientRect().top + box.top;
    return axis.low + ((box.bottom - y) / (box.bottom - box.top)) * (axis.high - axis.low);
  };
  area.addEventListener("pointerdown", (e) => {
    const from = valueAt(e),
      mark = svg("rect", { x: -7, width: 14, class: "brush" });
    area.before(mark);
    area.setPointerCapture(e.pointerId);
    const move = (m) => {
      const ys = [from, valueAt(m)].map(scale).sort((a, b) => a - b);
      mark.setAttribute("y", ys[0]);
      mark.setAttribute("height", ys[1] - ys[0]);
    };
    area.addEventListener("pointermove", move);
    area.addEventListener(
      "pointerup",
      (u) => {
        const [low, high] = [from, valueAt(u)].sort((a, b) => a - b),
          near = 0.025 * (axis.high - axis.low);
        const end = (value, limit) =>
          Math.abs(value - limit) < near || (value - limit) * (axis.high + axis.low - 2 * limit) < 0
            ? null
            : Number(value.toPrecision(4));
        setLimit(axis.key, high - low < 0.6 * near ? null : [end(low, axis.low), end(high, axis.high)]); // up to an end: no limit there
      },
      { once: true },
    );
  });
  return area;
}
