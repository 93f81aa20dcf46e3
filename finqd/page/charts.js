// Coverage and QD score against evaluations and time; fitness against volume.

function drawCurves(host) {
  const c = data.curves,
    total = c.seconds[c.seconds.length - 1],
    [unit, length] = total > 36000 ? ["h", 3600] : total > 600 ? ["min", 60] : ["s", 1];
  const time = { name: `computing time [${unit}]`, values: c.seconds.map((s) => s / length) };
  const kinds = [
    ["coverage", "coverage [% of cells]", c.coverage.map((v) => 100 * v)],
    ["score", "QD score", c.score],
  ];
  const panels = kinds.flatMap((kind) =>
    [
      ["evaluations", c.evaluations],
      [time.name, time.values],
    ].map((across) => [kind, across]),
  );
  host.replaceChildren(...panels.map(() => html("div", { class: "panel" })));
  panels.forEach(([[id, title, values], [xName, xs]], k) => {
    const last = values[values.length - 1],
      label = `${title} against ${xName}: ${number(last)} after ${number(xs[xs.length - 1])}`;
    const { root, width, box } = frame(host.children[k], { height: 220, left: 62, right: 30, label });
    const x = linear(0, Math.max(xs[xs.length - 1], 1e-9), box.left, box.right),
      y = linear(0, Math.max(...values, 1e-9) * 1.06, box.bottom, box.top);
    axisY(root, box, y, ticks(0, Math.max(...values, 1e-9), 4), title, { grid: true });
    axisX(root, box, x, ticks(0, Math.max(xs[xs.length - 1], 1e-9), width / 90), xName);
    if (xName === "evaluations" && c.iterations.length <= 40)
      for (const i of c.iterations)
        root.append(svg("line", { x1: x(i), x2: x(i), y1: box.bottom, y2: box.bottom - 4, class: "tick" }));
    const points = xs.map((v, i) =>
      i ? `H${x(v).toFixed(1)}V${y(values[i]).toFixed(1)}` : `M${x(v).toFixed(1)},${y(values[0]).toFixed(1)}`,
    );
    root.append(
      svg("path", { d: points.join(""), class: "curve", "data-kind": id }),
      svg("circle", { cx: x(xs[xs.length - 1]), cy: y(last), r: 3.5, class: "curve-end" }),
      svg("text", { x: box.right, y: y(last) - 8, "text-anchor": "end", class: "value-text" }, number(last)),
    );
  });
}

function drawPareto(host) {
  const p = data.pareto,
    front = p.front.map((i) => byIndex.get(i)),
    b = data.benchmark;
  const { root, width, box } = frame(host, {
    height: 340,
    left: 62,
    right: 18,
    top: 16,
    label: `Fitness against ${p.name}, ${front.length} designs on the front`,
  });
  root.setAttribute("role", "group");
  const xs = [...p.cloud.x, ...(b && Number.isFinite(b.features[p.key]) ? [b.features[p.key]] : [])];
  if (!xs.length) {
    host.replaceChildren(html("p", { class: "empty" }, "No design was evaluated to its end."));
    return;
  }
  const low = xs.reduce((a, v) => Math.min(a, v)),
    high = xs.reduce((a, v) => Math.max(a, v)),
    pad = 0.05 * (high - low || 1);
  const x = linear(low - pad, high + pad, box.left, box.right),
    y = linear(0, 1.04, box.bottom, box.top);
  axisY(root, box, y, ticks(0, 1, 5), "fitness (share of objects held)", { grid: true });
  axisX(root, box, x, ticks(low - pad, high + pad, width / 110), titled(p));
  const dots = new Map(); // as many evaluations share a place on the screen, one path of round dots is enough
  p.cloud.x.forEach((v, i) => {
    const at = `${x(v).toFixed(0)},${y(p.cloud.fitness[i]).toFixed(1)}`;
    dots.set(at, (dots.get(at) || 0) + 1);
  });
  root.append(svg("path", { class: "cloud", d: [...dots.keys()].map((at) => `M${at}h0`).join("") }));
  for (const d of data.designs)
    if (d.elite)
      root.append(
        svg("circle", {
          cx: x(d.features[p.key]),
          cy: y(d.fitness),
          r: 3,
          class: matches(d) ? "elite-dot" : "elite-dot faded",
        }),
      );
  if (front.length) {
    const steps = front.map(
      (d, i) => `${i ? "H" : "M"}${x(d.features[p.key]).toFixed(1)}${i ? "V" : ","}${y(d.fitness).toFixed(1)}`,
    );
    root.append(svg("path", { d: `${steps.join("")}H${box.right}`, class: "front" }));
  }
  for (const d of front) {
    const text = `${designName(d)}: fitness ${number(d.fitness)}, ${p.name} ${withUnit(d.features[p.key], p.unit)}`;
    const dot = svg(
      "circle",
      {
        cx: x(d.features[p.key]),
        cy: y(d.fitness),
        r: 6.5,
        class: "front-dot",
        tabindex: 0,
        role: "button",
        "data-index": d.index,
        "aria-label": text,
      },
      svg("title", {}, text),
    );
    const pick = () => select(d.index, { focus: "front" });
    dot.addEventListener("click", pick);
    dot.addEventListener("keydown", (e) => {
      if (e.key === "Enter" || e.key === " ") {
        e.preventDefault();
        pick();
      }
    });
    root.append(dot);
  }
  markOnPareto(root, x, y, box);
}

function markOnPareto(root, x, y, box) {
  const { key } = data.pareto,
    b = data.benchmark,
    ring = svg("circle", { r: 10, class: "selected-ring" });
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
  const at = x(b.features[key]),
    known = Number.isFinite(b.fitness),
    right = at > (box.left + box.right) / 2;
  root.append(
    svg("line", { x1: at, x2: at, y1: box.top, y2: box.bottom, class: "benchmark-line" }),
    svg(
      "text",
      {
        x: at + (right ? -6 : 6),
        y: box.bottom - 8,
        "text-anchor": right ? "end" : "start",
        class: "value-text benchmark-text",
      },
      known ? b.name : `${b.name}, not evaluated`,
    ),
  );
  if (known)
    root.append(
      svg(
        "path",
        { d: `M${at},${y(b.fitness) - 7}l7,7l-7,7l-7,-7z`, class: "benchmark-mark" },
        svg("title", {}, `${b.name}: fitness ${number(b.fitness)}`),
      ),
    );
}
