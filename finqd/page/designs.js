// The chosen design, the list of all, and the comparison with the benchmark.

const cellName = (d) => (d.elite ? `cell ${d.cell.join(", ")}` : `not an elite, in cell ${d.cell.join(", ")}`);
const designName = (d) => `evaluation ${d.index}`;

// "held", "lost", "failed" (its simulation did not finish), or null where that is not known.
function held(row) {
  if (row === undefined) return null;
  if (row.status && row.status !== "ok") return "failed";
  return row.held === true ? "held" : row.held === false ? "lost" : null;
}

const heldCount = (d) => Object.values(d.objects).filter((row) => held(row) === "held").length;
const isMain = (feature) => data.axes.some((axis) => axis.key === feature.key) || feature.key === data.pareto.key;
const featureValues = (values) =>
  data.features
    .filter(isMain)
    .map((f) => `${f.name} ${withUnit(values[f.key], f.unit)}`)
    .join(", ");
const featuresText = (d, between = ", ") =>
  data.features
    .filter(isMain)
    .map((f) => `${f.name} ${withUnit(d.features[f.key], f.unit)}`)
    .join(between);

const percent = (share) => (share === null || share === undefined ? "–" : `${number(Math.round(1000 * share) / 10)} %`);
const intervalText = (share) => share.interval_95.map((end) => number(Math.round(1000 * end) / 10)).join(" to ") + " %";
const success = (d) => data.rechecks?.elites[d.index]?.success.rate ?? null;

const MARKS = { held: ["✓", "held"], lost: ["✕", "lost"], failed: ["!", "simulation failed"] };
function verdict(row) {
  const kind = held(row);
  if (!kind) return html("span", { class: "verdict none" }, "–", html("span", { class: "hidden" }, "not known"));
  return html(
    "span",
    { class: `verdict ${kind}` },
    html("span", { "aria-hidden": "true" }, MARKS[kind][0]),
    html("span", { class: "word" }, ` ${MARKS[kind][1]}`),
  );
}

function table(heads, rows, options = {}) {
  const head = html(
    "tr",
    {},
    heads.map((h) => (h instanceof Node ? h : html("th", { scope: "col", class: h.number ? "n" : null }, h.text ?? h))),
  );
  return html("table", options, html("thead", {}, head), html("tbody", {}, rows));
}
const cellsOf = (values) => values.map((value) => html("td", { class: "n" }, value));

// -- the chosen design ------------------------------------------------------------------------------------------------

function showDesign() {
  const d = byIndex.get(state.selected),
    panel = document.getElementById("design");
  panel.hidden = document.getElementById("design-tables").hidden = !d;
  document.getElementById("no-design").hidden = Boolean(d);
  if (!d) return;
  const b = data.benchmark,
    count = Object.keys(d.objects).length;
  document.getElementById("design-title").textContent = capital(cellName(d));
  document.getElementById("design-subtitle").textContent =
    `${designName(d)}, iteration ${d.iteration}${d.preset ? `, simulated with ${d.preset}` : ""}`;
  const facts = [
    ["holds", `${heldCount(d)} of ${count} objects`, ""],
    ["fitness", number(d.fitness), ""],
    ["margin", number(d.margin, 3), "mean over the objects; 1: no drop, −1: lost"],
  ];
  for (const f of data.features.filter(isMain)) {
    const known = b && Number.isFinite(b.features[f.key]),
      change = known ? 100 * (d.features[f.key] / b.features[f.key] - 1) : null;
    facts.push([
      f.name,
      withUnit(d.features[f.key], f.unit),
      known ? `${change > 0 ? "+" : ""}${number(Math.round(change * 10) / 10)} % against ${b.name}` : "",
    ]);
  }
  const checked = data.rechecks && data.rechecks.elites[d.index];
  if (checked)
    facts.push([
      "held in rechecks",
      percent(checked.success.rate),
      `${intervalText(checked.success)} with 95 % confidence, ${checked.rechecks} rechecks under other conditions`,
    ]);
  document
    .getElementById("design-facts")
    .replaceChildren(
      ...facts.map(([name, value, note]) =>
        html("div", {}, html("dt", {}, name), html("dd", {}, value, note ? html("small", {}, note) : null)),
      ),
    );
  showShape(d);
  document.getElementById("design-objects").replaceChildren(objectTable(d));
  document.getElementById("design-parameters").replaceChildren(parameterTable(d));
  const notes = [];
  if (d.screen)
    notes.push(`Screened with ${d.screen.preset ?? "a cheaper preset"}: fitness ${number(d.screen.fitness)}.`);
  if (!d.file) notes.push(`No design file: ${d.file_missing}.`);
  document.getElementById("design-file").hidden = !d.file;
  if (d.accuracy) notes.push(`Accuracy of the simulation: ${d.accuracy}.`);
  document.getElementById("design-notes").textContent = notes.join(" ");
  document.getElementById("compare-add").disabled = state.compared.includes(d.index);
  const command = d.elite
    ? `finqd export ${data.run_argument} --cell ${d.cell.join(",")} --out gripper.stl`
    : `finqd export ${fileName(d)}.json --out gripper.stl`;
  document.getElementById("export-command").textContent = command;
}

const fileName = (d) => `gripper_${d.elite ? `cell_${d.cell.join("_")}` : `evaluation_${d.index}`}`;

function showShape(d) {
  const shape = shapes.shapes[d.index],
    note = document.getElementById("shape-note");
  document.getElementById("stl").hidden = !shape;
  document.getElementById("viewer").classList.toggle("without", !shape);
  state.solid = shape ? unpackShape(shape) : null;
  if (shape) viewer.show(state.solid);
  else viewer.show(null);
  const how =
    viewer.kind === "canvas"
      ? " Drawn without WebGL, which this browser does not offer: faces that cross each other are approximate."
      : "";
  note.textContent = shape
    ? `Drag to turn, arrow keys too; + and − zoom. Floor grid ${GRID_MM} mm.${how}`
    : `No 3-D view: ${shapes.missing[d.index] ?? "this page was made without shapes"}.`;
}

function objectTable(d) {
  const rows = data.objects
    .filter((name) => d.objects[name])
    .map((name) => {
      const row = d.objects[name],
        why = [row.reason, row.ended].filter(Boolean).join("; ");
      return html(
        "tr",
        {},
        html("th", { scope: "row" }, name),
        html("td", { class: "why" }, verdict(row), why ? html("small", {}, why) : null),
        cellsOf([
          number(row.drop_mm, 3),
          number(row.margin, 3),
          number(row.max_contact_force_N, 3),
          number(row.max_penetration_mm, 2),
        ]),
      );
    });
  return table(
    [
      "object",
      "verdict",
      { text: "drop [mm]", number: true },
      { text: "margin", number: true },
      { text: "peak force on a finger [N]", number: true },
      { text: "deepest penetration [mm]", number: true },
    ],
    rows,
  );
}

// Parameters of the fingers side by side, one row each; those of the gripper below.
function parameterTable(d) {
  const { keys, fingers, others } = parameterGroups();
  const range = (p) => `${number(p.low)} to ${number(p.high)}`;
  const rows = keys.map((key) => {
    const of = fingers.map((f) => f.get(key)),
      p = data.parameters[of[0]];
    return html(
      "tr",
      {},
      html("th", { scope: "row", title: p.description || null }, titled(p)),
      cellsOf(of.map((i) => number(d.parameters[i]))),
      html("td", { class: "n range" }, range(p)),
    );
  });
  for (const i of others) {
    const p = data.parameters[i];
    rows.push(
      html(
        "tr",
        {},
        html("th", { scope: "row", title: p.description || null }, titled(p)),
        html("td", { class: "n", colspan: Math.max(1, fingers.length) }, number(d.parameters[i])),
        html("td", { class: "n range" }, range(p)),
      ),
    );
  }
  return table(
    [
      "parameter",
      ...fingers.map((_, i) => ({ text: `finger ${i + 1}`, number: true })),
      { text: "searched", number: true },
    ],
    rows,
  );
}

// -- all elites -------------------------------------------------------------------------------------------------------

const LIST_STEP = 50;
function listColumns() {
  const columns = [
    { name: "cell", value: (d) => d.cell.join(", "), order: (d) => d.index, left: true },
    { name: "holds", value: heldCount, order: heldCount },
  ];
  columns.push(
    { name: "fitness", value: (d) => number(d.fitness), order: (d) => d.fitness },
    { name: "margin", value: (d) => number(d.margin, 3), order: (d) => d.margin },
  );
  for (const f of data.features.filter(isMain))
    columns.push({ name: titled(f), value: (d) => number(d.features[f.key]), order: (d) => d.features[f.key] });
  if (data.rechecks)
    columns.push({ name: "held in rechecks", value: (d) => percent(success(d)), order: (d) => success(d) ?? -1 });
  return columns;
}

function drawList() {
  const columns = listColumns(),
    { by, down } = state.order,
    shown = data.designs.filter((d) => d.elite && matches(d));
  const column = columns[by];
  shown.sort(
    (a, b) => (column.order(a) - column.order(b)) * (down ? -1 : 1) || b.objective - a.objective || a.index - b.index,
  );
  const heads = columns.map((c, k) =>
    html(
      "th",
      { scope: "col", class: c.left ? null : "n", "aria-sort": k === by ? (down ? "descending" : "ascending") : null },
      html(
        "button",
        {
          type: "button",
          class: "sort",
          onclick: () => {
            state.order = { by: k, down: k === by ? !down : !c.left };
            drawList();
            document.querySelectorAll("#list .sort")[k].focus();
          },
        },
        c.name,
        html("span", { "aria-hidden": "true" }, k === by ? (down ? " ↓" : " ↑") : ""),
      ),
    ),
  );
  const rows = shown
    .slice(0, state.listed)
    .map((d) =>
      html(
        "tr",
        { class: d.index === state.selected ? "selected" : null, "data-index": d.index },
        html(
          "td",
          {},
          html(
            "button",
            { type: "button", class: "link", onclick: () => select(d.index, { focus: "list", scroll: true }) },
            d.cell.join(", "),
          ),
        ),
        cellsOf(columns.slice(1).map((c) => c.value(d))),
      ),
    );
  const more =
    shown.length > state.listed
      ? html(
          "button",
          {
            type: "button",
            onclick: () => {
              state.listed = shown.length;
              drawList();
            },
          },
          `Show all ${shown.length}`,
        )
      : null;
  document
    .getElementById("list")
    .replaceChildren(
      ...[
        table(heads, rows),
        more,
        shown.length ? null : html("p", { class: "empty" }, "No design meets these limits."),
      ].filter(Boolean),
    );
}

// -- the paper's table ------------------------------------------------------------------------------------------------

function drawCompare() {
  const b = data.benchmark,
    designs = state.compared.map((i) => byIndex.get(i)).filter(Boolean);
  const why = new Map(data.chosen.map((c) => [c.index, c.why])),
    host = document.getElementById("compare-table");
  if (!designs.length && !b) {
    host.replaceChildren(html("p", { class: "empty" }, "There is no design to compare yet."));
    return;
  }
  const heads = [
    "object",
    ...(b ? [html("th", { scope: "col", class: "n" }, html("b", {}, b.name))] : []),
    ...designs.map((d) =>
      html(
        "th",
        { scope: "col", class: "n" },
        html(
          "button",
          { type: "button", class: "link", onclick: () => select(d.index, { scroll: true }) },
          d.elite ? `cell ${d.cell.join(", ")}` : designName(d),
        ),
        html("small", {}, why.get(d.index) ?? "chosen by you"),
        html(
          "button",
          {
            type: "button",
            class: "remove",
            "aria-label": `Take ${designName(d)} off the table`,
            onclick: () => {
              state.compared = state.compared.filter((i) => i !== d.index);
              drawCompare();
              showDesign();
            },
          },
          "remove",
        ),
      ),
    ),
  ];
  const all = [...(b ? [b] : []), ...designs];
  const rows = data.objects.map((name) =>
    html(
      "tr",
      {},
      html("th", { scope: "row" }, name),
      all.map((one) => html("td", { class: "n" }, verdict(one.objects[name]))),
    ),
  );
  const line = (name, values, kind = "total") =>
    html("tr", { class: kind }, html("th", { scope: "row" }, name), cellsOf(values));
  rows.push(
    line(
      "fitness",
      all.map((one) => number(one.fitness)),
      "total first",
    ),
    line(
      "margin",
      all.map((one) => number(one.margin, 3)),
    ),
  );
  for (const f of data.features.filter(isMain))
    rows.push(
      line(
        titled(f),
        all.map((one) => against(one, b, f)),
      ),
    );
  if (data.rechecks)
    rows.push(
      line(
        "held in rechecks",
        all.map((one) => percent(success(one))),
      ),
    );
  host.replaceChildren(table(heads, rows));
  const notes = b ? [...b.notes.map((n) => `${b.name}: ${n}.`)] : [];
  const note = document.getElementById("compare-note");
  note.replaceChildren(...notes.flatMap((n) => [n, " "]));
  if (b && b.command)
    note.append(
      "The benchmark's verdicts are not known here; its features follow from its shape. To fill them in: ",
      html("code", {}, b.command),
      " and then ",
      html("code", {}, `finqd report ${data.run_argument} --benchmark benchmark.json`),
      ".",
    );
}

function against(one, b, f) {
  const value = one.features[f.key],
    known = b && one !== b && Number.isFinite(b.features[f.key]);
  const change = known ? 100 * (value / b.features[f.key] - 1) : 0;
  return html(
    "span",
    {},
    number(value),
    known ? html("small", {}, `${change > 0 ? "+" : ""}${number(Math.round(change * 10) / 10)} %`) : null,
  );
}
