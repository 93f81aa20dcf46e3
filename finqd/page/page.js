// State, selection and limits: what a click changes and what is then drawn anew.

const read = (id) => JSON.parse(document.getElementById(id).textContent);
const data = read("data"),
  shapes = read("shapes");
const byIndex = new Map(data.designs.map((d) => [d.index, d]));
const state = {
  selected: null,
  compared: data.chosen.map((c) => c.index),
  colour: "fitness",
  finger: "mean",
  limits: {},
  mustHold: new Set(),
  order: { by: 2, down: true },
  listed: LIST_STEP,
  solid: null,
};
const viewer = makeViewer(document.getElementById("viewer"));

// What the map and the lines can be coloured by: share of the colour scale and text of a design.
function colourings() {
  const span = (values) => {
    const usable = values.filter(Number.isFinite);
    return [Math.min(...usable, Infinity), Math.max(...usable, -Infinity)];
  };
  const found = {
    fitness: {
      name: "fitness",
      share: (d) => d.fitness,
      text: (d) => number(d.fitness, 2),
      low: "0",
      high: "1, share of objects held",
    },
    margin: {
      name: "margin",
      share: (d) => (d.margin + 1) / 2,
      text: (d) => number(d.margin, 2),
      low: "−1",
      high: "1, mean over the objects",
    },
  };
  if (data.rechecks)
    found.rechecked = {
      name: "held in rechecks",
      share: success,
      text: (d) => percent(success(d)),
      low: "0 %",
      high: "100 %, grey: not rechecked",
    };
  for (const f of data.features.filter(isMain)) {
    const [low, high] = span(data.designs.map((d) => d.features[f.key]));
    found[f.key] = {
      name: f.name,
      share: (d) => (d.features[f.key] - low) / (high - low || 1),
      text: (d) => number(d.features[f.key], 3),
      low: number(low),
      high: withUnit(high, f.unit),
    };
  }
  return found;
}

// Parameters by finger: for each finger a map from key to place in the vector, and the places of all others.
function parameterGroups() {
  const fingers = [],
    others = [],
    keys = [];
  data.parameters.forEach((p, i) => {
    const m = /^fingers\[(\d+)\]\.(.+)$/.exec(p.path);
    if (!m) {
      others.push(i);
      return;
    }
    (fingers[Number(m[1])] ??= new Map()).set(m[2], i);
    if (!keys.includes(m[2])) keys.push(m[2]);
  });
  return { fingers, others, keys };
}

function parallelAxes() {
  const { fingers, others, keys } = parameterGroups();
  const spread = (axis) => {
    const v = data.designs.map(axis.value).filter(Number.isFinite);
    return {
      ...axis,
      low: v.reduce((a, b) => Math.min(a, b), Infinity),
      high: v.reduce((a, b) => Math.max(a, b), -Infinity),
    };
  };
  const axes = [
    { key: "fitness", name: "fitness", unit: "", low: 0, high: 1, value: (d) => d.fitness },
    { key: "margin", name: "margin", unit: "", low: -1, high: 1, value: (d) => d.margin },
  ];
  for (const f of data.features.filter(isMain))
    axes.push(spread({ key: f.key, name: f.name, unit: f.unit, value: (d) => d.features[f.key] }));
  for (const key of keys) {
    const at = state.finger === "mean" ? fingers.map((f) => f.get(key)) : [fingers[state.finger].get(key)],
      p = data.parameters[at[0]];
    axes.push({
      key: `parameter ${key}`,
      name: p.name,
      unit: p.unit,
      low: p.low,
      high: p.high,
      value: (d) => at.reduce((sum, i) => sum + d.parameters[i], 0) / at.length,
    });
  }
  for (const i of others) {
    const p = data.parameters[i];
    axes.push({
      key: `parameter ${p.path}`,
      name: p.name,
      unit: p.unit,
      low: p.low,
      high: p.high,
      value: (d) => d.parameters[i],
    });
  }
  return axes;
}

let axesNow = parallelAxes();
function matches(d) {
  for (const name of state.mustHold) if (held(d.objects[name]) !== "held") return false;
  for (const axis of axesNow) {
    const limit = state.limits[axis.key],
      value = limit && axis.value(d);
    if (limit && ((limit[0] !== null && value < limit[0] - 1e-9) || (limit[1] !== null && value > limit[1] + 1e-9)))
      return false;
  }
  return true;
}

function select(index, { focus = null, scroll = false } = {}) {
  if (!byIndex.has(index)) return;
  state.selected = index;
  try {
    history.replaceState(null, "", `#design=${index}`);
  } catch {
    /* some viewers of local files forbid it */
  }
  showDesign();
  for (const mark of Object.values(marks)) mark();
  for (const row of document.querySelectorAll("#list tbody tr"))
    row.classList.toggle("selected", Number(row.dataset.index) === index);
  if (focus === "map") document.querySelector(`#map [data-index="${index}"]`)?.focus({ preventScroll: true });
  if (focus === "front")
    document.querySelector(`#pareto-chart [data-index="${index}"]`)?.focus({ preventScroll: true });
  if (focus === "list") document.querySelector(`#list [data-index="${index}"] button`)?.focus({ preventScroll: true });
  if (scroll) document.getElementById("pick").scrollIntoView({ block: "start" });
}

function setLimit(key, limit) {
  if (!limit || (limit[0] === null && limit[1] === null)) delete state.limits[key];
  else state.limits[key] = limit;
  refilter();
}

function refilter() {
  state.listed = LIST_STEP;
  showLimits();
  drawCharts();
  drawList();
  const elites = data.designs.filter((d) => d.elite),
    count = elites.filter(matches).length;
  const limited = state.mustHold.size || Object.keys(state.limits).length;
  for (const place of document.querySelectorAll(".match-count"))
    place.textContent = limited
      ? `${count} of ${elites.length} designs meet the limits`
      : `${elites.length} designs, no limits set`;
  for (const button of document.querySelectorAll(".lift")) button.hidden = !limited;
}

function drawCharts() {
  const map = document.getElementById("map");
  for (const name of Object.keys(marks)) delete marks[name];
  if (data.designs.some((d) => d.elite)) drawMap(map);
  else
    map.replaceChildren(
      html(
        "p",
        { class: "empty" },
        data.summary.evaluations
          ? "No cell is filled: no design was evaluated to its end. See the failures below."
          : "Nothing was evaluated yet.",
      ),
    );
  drawLegend(document.getElementById("legend"));
  drawPareto(document.getElementById("pareto-chart"));
  drawParallel(document.getElementById("parallel-chart"));
}

// Limits by number: two fields an axis, bound to the bars on the axes.
function drawLimits() {
  const field = (axis, end, name) =>
    html("input", {
      type: "number",
      step: "any",
      placeholder: `${name} ${number(end ? axis.high : axis.low)}`,
      "aria-label": `${titled(axis)}, ${name}`,
      "data-key": axis.key,
      "data-end": end,
      onchange: (e) => {
        const now = [...(state.limits[axis.key] || [null, null])];
        now[end] = e.target.value === "" ? null : Number(e.target.value);
        setLimit(axis.key, now);
      },
    });
  const row = (axis) =>
    html("div", {}, html("span", {}, titled(axis)), field(axis, 0, "at least"), field(axis, 1, "at most"));
  document.getElementById("limit-table").replaceChildren(...axesNow.map(row));
  showLimits();
}

function showLimits() {
  for (const input of document.querySelectorAll("#limit-table input")) {
    input.value = state.limits[input.dataset.key]?.[Number(input.dataset.end)] ?? "";
  }
}

function drawChips() {
  const chip = (name) =>
    html(
      "button",
      {
        type: "button",
        class: "chip",
        "aria-pressed": "false",
        onclick: (e) => {
          if (!state.mustHold.delete(name)) state.mustHold.add(name);
          e.currentTarget.setAttribute("aria-pressed", String(state.mustHold.has(name)));
          refilter();
        },
      },
      name,
    );
  document.getElementById("must-hold").replaceChildren(...data.objects.map(chip));
}

function drawHeader() {
  const s = data.summary,
    f = (value, name, note = "") =>
      html("div", {}, html("dt", {}, name, note ? html("small", {}, note) : null), html("dd", {}, value));
  const duration = (t) =>
    t < 120 ? `${number(t, 3)} s` : t < 7200 ? `${number(t / 60, 3)} min` : `${number(t / 3600, 3)} h`;
  const best = byIndex.get(s.best_index);
  document
    .getElementById("figures")
    .replaceChildren(
      f(number(s.evaluations), "designs evaluated", s.failed ? `${number(s.failed)} failed` : "none failed"),
      f(`${number(100 * s.coverage, 3)} %`, "of the map covered", `${number(s.elites)} of ${number(s.cells)} cells`),
      f(number(s.qd_score), "QD score", "sum of the cells’ objectives"),
      f(
        best ? `${heldCount(best)} of ${Object.keys(best.objects).length}` : "–",
        "objects held by the best",
        best ? `fitness ${number(s.best_fitness)}` : "",
      ),
      f(duration(s.elapsed_seconds), "computing time", `${duration(s.evaluation_seconds)} of evaluations`),
    );
  document.getElementById("made").textContent = `Made ${data.made} by finqd ${data.finqd_version}.`;
}

const download = (name, blob) => {
  const a = html("a", { href: URL.createObjectURL(blob), download: name });
  document.body.append(a);
  a.click();
  a.remove();
  setTimeout(() => URL.revokeObjectURL(a.href), 10000);
};

function wire() {
  const on = (id, event, call) => document.getElementById(id).addEventListener(event, call);
  const fill = (id, options, chosen) =>
    document
      .getElementById(id)
      .replaceChildren(...options.map(([value, name]) => html("option", { value, selected: value === chosen }, name)));
  fill(
    "colour",
    Object.entries(colourings()).map(([key, c]) => [key, c.name]),
    "fitness",
  );
  on("colour", "change", (e) => {
    state.colour = e.target.value;
    drawCharts();
  });
  fill(
    "finger",
    [["mean", "mean of the fingers"], ...parameterGroups().fingers.map((_, i) => [String(i), `finger ${i + 1}`])],
    "mean",
  );
  on("finger", "change", (e) => {
    state.finger = e.target.value;
    for (const key of Object.keys(state.limits))
      if (key.startsWith("parameter fingers") || (!["fitness", "margin"].includes(key) && key.startsWith("parameter ")))
        delete state.limits[key];
    axesNow = parallelAxes();
    drawLimits();
    refilter();
  });
  for (const button of document.querySelectorAll(".lift"))
    button.addEventListener("click", () => {
      state.limits = {};
      state.mustHold.clear();
      drawChips();
      refilter();
    });
  for (const button of document.querySelectorAll("[data-view]"))
    button.addEventListener("click", () => viewer.look(button.dataset.view));
  const chosen = () => byIndex.get(state.selected);
  on("design-file", "click", () =>
    download(`${fileName(chosen())}.json`, new Blob([chosen().file], { type: "application/json" })),
  );
  on("stl", "click", () => download(`${fileName(chosen())}_shells.stl`, stlOf(state.solid)));
  on("compare-add", "click", () => {
    state.compared.push(state.selected);
    drawCompare();
    showDesign();
  });
  on("copy", "click", async (e) => {
    try {
      await navigator.clipboard.writeText(document.getElementById("export-command").textContent);
      e.target.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(document.getElementById("export-command"));
    }
  });
  let waiting = 0;
  let width = document.documentElement.clientWidth;
  window.addEventListener("resize", () => {
    clearTimeout(waiting);
    waiting = setTimeout(() => {
      if (width === document.documentElement.clientWidth) return;
      width = document.documentElement.clientWidth;
      drawCharts();
      drawCurves(document.getElementById("curve-panels"));
      drawSensitivity();
    }, 120);
  });
}

drawHeader();
wire();
drawChips();
drawLimits();
refilter();
drawCurves(document.getElementById("curve-panels"));
drawCompare();
drawSensitivity();
drawFailures();
drawRechecks();
drawFacts();
const wanted = Number(/#design=(\d+)/.exec(location.hash)?.[1] ?? NaN);
if (byIndex.has(wanted)) select(wanted);
else if (data.designs.length) select(data.chosen[0].index);
else showDesign();
