// The map: a cell a design, by the first two features; the arrow keys go from cell to cell.

// The elites that the map shows, by "i,j": with more than two axes the best over the others.
function mapCells() {
  const found = new Map();
  for (const d of data.designs) {
    if (!d.elite) continue;
    const place = `${d.cell[0]},${d.cell[1] ?? 0}`,
      other = found.get(place);
    if (!other || d.objective > other.objective) found.set(place, d);
  }
  return found;
}

function drawMap(host) {
  const [ax, ay] = [data.axes[0], data.axes[1] || { name: "", unit: "", low: 0, high: 1, cells: 1 }];
  const wide = Math.max(260, host.clientWidth),
    height = data.axes[1] ? Math.round(Math.min(0.82 * wide + 40, 620)) : 150;
  const cells = mapCells(),
    colour = colourings()[state.colour];
  const { root, box } = frame(host, { height, left: data.axes[1] ? 74 : 16, right: 8, top: 10 });
  root.setAttribute("role", "listbox");
  root.setAttribute("aria-label", `Map of ${cells.size} designs. Arrow keys go from design to design.`);
  const x = linear(0, ax.cells, box.left, box.right),
    y = linear(0, ay.cells, box.bottom, box.top);
  const [w, h] = [x(1) - x(0), y(0) - y(1)],
    written = w > 30 && h > 17;
  root.append(
    svg("rect", {
      x: box.left,
      y: box.top,
      width: box.right - box.left,
      height: box.bottom - box.top,
      class: "map-ground",
    }),
  );
  if (ax.cells <= 40 && ay.cells <= 40) {
    for (let i = 1; i < ax.cells; i++)
      root.append(svg("line", { x1: x(i), x2: x(i), y1: box.top, y2: box.bottom, class: "map-line" }));
    for (let j = 1; j < ay.cells; j++)
      root.append(svg("line", { x1: box.left, x2: box.right, y1: y(j), y2: y(j), class: "map-line" }));
  }
  for (const [place, d] of cells) {
    const [i, j] = place.split(",").map(Number),
      share = colour.share(d),
      text = colour.text(d);
    const cell = svg(
      "g",
      {
        role: "option",
        class: "cell",
        tabindex: -1,
        "data-index": d.index,
        "data-place": place,
        "aria-selected": false,
        "aria-label": `${cellName(d)}: ${colour.name} ${text}; ${featuresText(d)}`,
      },
      svg("title", {}, `${cellName(d)}\n${colour.name} ${text}\n${featuresText(d, "\n")}`),
      svg("rect", { x: x(i), y: y(j + 1), width: w, height: h, fill: share === null ? "#d9dde1" : colourAt(share) }),
    );
    if (written)
      cell.append(
        svg(
          "text",
          {
            x: x(i) + w / 2,
            y: y(j) - h / 2 + 4,
            "text-anchor": "middle",
            class: "cell-text",
            fill: share >= 0.5 ? "#16242c" : "#fff",
          },
          text,
        ),
      );
    if (!matches(d)) cell.classList.add("faded");
    root.append(cell);
  }
  markBenchmark(root, x, y, w, h);
  marks.map = markedCell(root, x, y, w, h);
  marks.map();
  axisX(root, box, linear(ax.low, ax.high, box.left, box.right), ticks(ax.low, ax.high, wide / 110), titled(ax));
  if (data.axes[1])
    axisY(root, box, linear(ay.low, ay.high, box.bottom, box.top), ticks(ay.low, ay.high, height / 70), titled(ay));
  root.addEventListener("click", (e) => {
    const cell = e.target.closest(".cell");
    if (cell) select(Number(cell.dataset.index), { focus: "map" });
  });
  root.addEventListener("keydown", (e) => moveOnMap(e, cells));
}

function markBenchmark(root, x, y, w, h) {
  const b = data.benchmark;
  if (b && b.cell && b.cell.length <= 2) {
    root.append(
      svg("rect", {
        x: x(b.cell[0]) + 1.5,
        y: y((b.cell[1] ?? 0) + 1) + 1.5,
        width: Math.max(2, w - 3),
        height: Math.max(2, h - 3),
        class: "benchmark-ground",
      }),
      svg(
        "rect",
        {
          x: x(b.cell[0]) + 1.5,
          y: y((b.cell[1] ?? 0) + 1) + 1.5,
          width: Math.max(2, w - 3),
          height: Math.max(2, h - 3),
          class: "benchmark-cell",
        },
        svg("title", {}, `${b.name} lies here: ${featureValues(b.features)}`),
      ),
    );
  }
}

// Frames the chosen cell, and makes it the one that the tab key reaches.
function markedCell(root, x, y, w, h) {
  const frameOf = svg("rect", { width: w + 2, height: h + 2, class: "selected-cell" });
  let last = null;
  return () => {
    const d = byIndex.get(state.selected),
      now = root.querySelector(`[data-index="${state.selected}"]`) || root.querySelector(".cell");
    if (last) {
      last.setAttribute("tabindex", -1);
      last.setAttribute("aria-selected", false);
    }
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
  const here = event.target.closest(".cell"),
    ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  if (!here) return;
  if (event.key === "Enter" || event.key === " ") {
    event.preventDefault();
    select(Number(here.dataset.index), { focus: "map" });
    return;
  }
  const way = ways[event.key];
  if (!way) return;
  event.preventDefault();
  const at = here.dataset.place.split(",").map(Number);
  let best = null,
    least = Infinity;
  for (const [place, d] of cells) {
    const [dx, dy] = place.split(",").map((v, k) => Number(v) - at[k]);
    const ahead = dx * way[0] + dy * way[1],
      aside = Math.abs(dx * way[1]) + Math.abs(dy * way[0]);
    if (ahead > 0 && ahead + 2.5 * aside < least) [best, least] = [d, ahead + 2.5 * aside];
  }
  if (best) select(best.index, { focus: "map" });
}

function drawLegend(host) {
  const colour = colourings()[state.colour],
    bar = svg("svg", { width: 120, height: 12, "aria-hidden": "true" });
  for (let k = 0; k < 60; k++)
    bar.append(svg("rect", { x: 2 * k, y: 0, width: 2.3, height: 12, fill: colourAt(k / 59) }));
  host.replaceChildren(html("span", {}, colour.low), bar, html("span", {}, colour.high));
}
