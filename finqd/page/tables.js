// What is not a chart: the chosen design, the list, the comparison, sensitivity, failures, rechecks, and the facts.

const cellName = (d) => (d.elite ? `cell ${d.cell.join(", ")}` : `not an elite, in cell ${d.cell.join(", ")}`);
const designName = (d) => `evaluation ${d.index}`;
const held = (row) => (row === undefined ? null : row.status && row.status !== "ok" ? "failed" : row.held === true ? "held" : row.held === false ? "lost" : null);
const heldCount = (d) => Object.values(d.objects).filter((row) => held(row) === "held").length;
const isMain = (feature) => data.axes.some((axis) => axis.key === feature.key) || feature.key === data.pareto.key;
const featureValues = (values) => data.features.filter(isMain).map((f) => `${f.name} ${withUnit(values[f.key], f.unit)}`).join(", ");
const featuresText = (d, between = ", ") => data.features.filter(isMain).map((f) => `${f.name} ${withUnit(d.features[f.key], f.unit)}`).join(between);

const percent = (share) => (share === null || share === undefined ? "–" : `${number(Math.round(1000 * share) / 10)} %`);
const intervalText = (share) => share.interval_95.map((end) => number(Math.round(1000 * end) / 10)).join(" to ") + " %";
const success = (d) => data.rechecks?.elites[d.index]?.success.rate ?? null;

const MARKS = { held: ["✓", "held"], lost: ["✕", "lost"], failed: ["!", "simulation failed"] };
function verdict(row) {
  const kind = held(row);
  if (!kind) return html("span", { class: "verdict none" }, "–", html("span", { class: "hidden" }, "not known"));
  return html("span", { class: `verdict ${kind}` }, html("span", { "aria-hidden": "true" }, MARKS[kind][0]), html("span", { class: "word" }, ` ${MARKS[kind][1]}`));
}

function table(heads, rows, options = {}) {
  const head = html("tr", {}, heads.map((h) => (h instanceof Node ? h : html("th", { scope: "col", class: h.number ? "n" : null }, h.text ?? h))));
  return html("table", options, html("thead", {}, head), html("tbody", {}, rows));
}
const cellsOf = (values, numeric = () => true) => values.map((v, i) => html("td", { class: numeric(i) ? "n" : null }, v));

// -- the chosen design ------------------------------------------------------------------------------------------------

function showDesign() {
  const d = byIndex.get(state.selected), panel = document.getElementById("design");
  panel.hidden = document.getElementById("design-tables").hidden = !d;
  document.getElementById("no-design").hidden = Boolean(d);
  if (!d) return;
  const b = data.benchmark, count = Object.keys(d.objects).length;
  document.getElementById("design-title").textContent = capital(cellName(d));
  document.getElementById("design-subtitle").textContent =
    `${designName(d)}, iteration ${d.iteration}${d.preset ? `, simulated with ${d.preset}` : ""}`;
  const facts = [["holds", `${heldCount(d)} of ${count} objects`, ""], ["fitness", number(d.fitness), ""], ["margin", number(d.margin, 3), "mean over the objects; 1: no drop, −1: lost"]];
  for (const f of data.features.filter(isMain)) {
    const known = b && Number.isFinite(b.features[f.key]), change = known ? 100 * (d.features[f.key] / b.features[f.key] - 1) : null;
    facts.push([f.name, withUnit(d.features[f.key], f.unit), known ? `${change > 0 ? "+" : ""}${number(Math.round(change * 10) / 10)} % against ${b.name}` : ""]);
  }
  const checked = data.rechecks && data.rechecks.elites[d.index];
  if (checked) facts.push(["held in rechecks", percent(checked.success.rate), `${intervalText(checked.success)} with 95 % confidence, ${checked.rechecks} rechecks under other conditions`]);
  document.getElementById("design-facts").replaceChildren(...facts.map(([name, value, note]) => html("div", {}, html("dt", {}, name), html("dd", {}, value, note ? html("small", {}, note) : null))));
  showShape(d);
  document.getElementById("design-objects").replaceChildren(objectTable(d));
  document.getElementById("design-parameters").replaceChildren(parameterTable(d));
  const notes = [];
  if (d.screen) notes.push(`Screened with ${d.screen.preset ?? "a cheaper preset"}: fitness ${number(d.screen.fitness)}.`);
  if (d.accuracy) notes.push(`Accuracy of the simulation: ${d.accuracy}.`);
  document.getElementById("design-notes").textContent = notes.join(" ");
  document.getElementById("compare-add").disabled = state.compared.includes(d.index);
  const command = d.elite ? `finqd export ${data.run_argument} --cell ${d.cell.join(",")} --out gripper.stl` : `finqd export ${fileName(d)}.json --out gripper.stl`;
  document.getElementById("export-command").textContent = command;
}

const fileName = (d) => `gripper_${d.elite ? `cell_${d.cell.join("_")}` : `evaluation_${d.index}`}`;

function showShape(d) {
  const shape = shapes.shapes[d.index], note = document.getElementById("shape-note");
  document.getElementById("stl").hidden = !shape;
  document.getElementById("viewer").classList.toggle("without", !shape);
  state.solid = shape ? unpackShape(shape) : null;
  if (shape) viewer.show(state.solid);
  else viewer.show(null);
  const how = viewer.kind === "canvas" ? " Drawn without WebGL, which this browser does not offer: faces that cross each other are approximate." : "";
  note.textContent = shape ? `Drag to turn, arrow keys too; + and − zoom. Floor grid ${GRID_MM} mm.${how}` : `No 3-D view: ${shapes.missing[d.index] ?? "this page was made without shapes"}.`;
}

function objectTable(d) {
  const rows = data.objects.filter((name) => d.objects[name]).map((name) => {
    const row = d.objects[name], why = [row.reason, row.ended].filter(Boolean).join("; ");
    return html("tr", {}, html("th", { scope: "row" }, name), html("td", { class: "why" }, verdict(row), why ? html("small", {}, why) : null),
      cellsOf([number(row.drop_mm, 3), number(row.margin, 3), number(row.max_contact_force_N, 3), number(row.max_penetration_mm, 2)]));
  });
  return table(["object", "verdict", { text: "drop [mm]", number: true }, { text: "margin", number: true }, { text: "force [N]", number: true }, { text: "penetration [mm]", number: true }], rows);
}

// Parameters of the fingers side by side, one row each; those of the gripper below.
function parameterTable(d) {
  const { keys, fingers, others } = parameterGroups();
  const range = (p) => `${number(p.low)} to ${number(p.high)}`;
  const rows = keys.map((key) => {
    const of = fingers.map((f) => f.get(key)), p = data.parameters[of[0]];
    return html("tr", {}, html("th", { scope: "row", title: p.description || null }, titled(p)), cellsOf(of.map((i) => number(d.parameters[i]))), html("td", { class: "n range" }, range(p)));
  });
  for (const i of others) {
    const p = data.parameters[i];
    rows.push(html("tr", {}, html("th", { scope: "row", title: p.description || null }, titled(p)), html("td", { class: "n", colspan: Math.max(1, fingers.length) }, number(d.parameters[i])), html("td", { class: "n range" }, range(p))));
  }
  return table(["parameter", ...fingers.map((_, i) => ({ text: `finger ${i + 1}`, number: true })), { text: "searched", number: true }], rows);
}

// -- all elites -------------------------------------------------------------------------------------------------------

const LIST_STEP = 50;
function listColumns() {
  const columns = [{ name: "cell", value: (d) => d.cell.join(", "), order: (d) => d.index, left: true }, { name: "holds", value: heldCount, order: heldCount }];
  columns.push({ name: "fitness", value: (d) => number(d.fitness), order: (d) => d.fitness }, { name: "margin", value: (d) => number(d.margin, 3), order: (d) => d.margin });
  for (const f of data.features.filter(isMain)) columns.push({ name: titled(f), value: (d) => number(d.features[f.key]), order: (d) => d.features[f.key] });
  if (data.rechecks) columns.push({ name: "held in rechecks", value: (d) => percent(success(d)), order: (d) => success(d) ?? -1 });
  return columns;
}

function drawList() {
  const columns = listColumns(), { by, down } = state.order, shown = data.designs.filter((d) => d.elite && matches(d));
  const column = columns[by];
  shown.sort((a, b) => (column.order(a) - column.order(b)) * (down ? -1 : 1) || b.objective - a.objective || a.index - b.index);
  const heads = columns.map((c, k) => html("th", { scope: "col", class: c.left ? null : "n", "aria-sort": k === by ? (down ? "descending" : "ascending") : null },
    html("button", { type: "button", class: "sort", onclick: () => { state.order = { by: k, down: k === by ? !down : !c.left }; drawList(); document.querySelectorAll("#list .sort")[k].focus(); } }, c.name, html("span", { "aria-hidden": "true" }, k === by ? (down ? " ↓" : " ↑") : ""))));
  const rows = shown.slice(0, state.listed).map((d) => html("tr", { class: d.index === state.selected ? "selected" : null, "data-index": d.index },
    html("td", {}, html("button", { type: "button", class: "link", onclick: () => select(d.index, { focus: "list", scroll: true }) }, d.cell.join(", "))), cellsOf(columns.slice(1).map((c) => c.value(d)))));
  const more = shown.length > state.listed ? html("button", { type: "button", onclick: () => { state.listed = shown.length; drawList(); } }, `Show all ${shown.length}`) : null;
  document.getElementById("list").replaceChildren(...[table(heads, rows), more, shown.length ? null : html("p", { class: "empty" }, "No design meets these limits.")].filter(Boolean));
}

// -- the paper's table ------------------------------------------------------------------------------------------------

function drawCompare() {
  const b = data.benchmark, designs = state.compared.map((i) => byIndex.get(i)).filter(Boolean);
  const why = new Map(data.chosen.map((c) => [c.index, c.why])), host = document.getElementById("compare-table");
  if (!designs.length && !b) { host.replaceChildren(html("p", { class: "empty" }, "There is no design to compare yet.")); return; }
  const heads = ["object", ...(b ? [html("th", { scope: "col", class: "n" }, html("b", {}, b.name))] : []), ...designs.map((d) => html("th", { scope: "col", class: "n" },
    html("button", { type: "button", class: "link", onclick: () => select(d.index, { scroll: true }) }, d.elite ? `cell ${d.cell.join(", ")}` : designName(d)), html("small", {}, why.get(d.index) ?? "chosen by you"),
    html("button", { type: "button", class: "remove", "aria-label": `Take ${designName(d)} off the table`, onclick: () => { state.compared = state.compared.filter((i) => i !== d.index); drawCompare(); showDesign(); } }, "remove")))];
  const all = [...(b ? [b] : []), ...designs];
  const rows = data.objects.map((name) => html("tr", {}, html("th", { scope: "row" }, name), all.map((one) => html("td", { class: "n" }, verdict(one.objects[name])))));
  const line = (name, values, kind = "total") => html("tr", { class: kind }, html("th", { scope: "row" }, name), cellsOf(values));
  rows.push(line("fitness", all.map((one) => number(one.fitness)), "total first"), line("margin", all.map((one) => number(one.margin, 3))));
  for (const f of data.features.filter(isMain)) rows.push(line(titled(f), all.map((one) => against(one, b, f))));
  if (data.rechecks) rows.push(line("held in rechecks", all.map((one) => percent(success(one)))));
  host.replaceChildren(table(heads, rows));
  const notes = b ? [...b.notes.map((n) => `${b.name}: ${n}.`)] : [];
  const note = document.getElementById("compare-note");
  note.replaceChildren(...notes.flatMap((n) => [n, " "]));
  if (b && b.command) note.append("The benchmark's verdicts are not known here; its features follow from its shape. To fill them in: ", html("code", {}, b.command), " and then ", html("code", {}, `finqd report ${data.run_argument} --benchmark benchmark.json`), ".");
}

function against(one, b, f) {
  const value = one.features[f.key], known = b && one !== b && Number.isFinite(b.features[f.key]);
  const change = known ? 100 * (value / b.features[f.key] - 1) : 0;
  return html("span", {}, number(value), known ? html("small", {}, `${change > 0 ? "+" : ""}${number(Math.round(change * 10) / 10)} %`) : null);
}

// -- sensitivity, failures, rechecks ----------------------------------------------------------------------------------

function drawSensitivity() {
  const s = data.sensitivity, host = document.getElementById("sensitivity-table");
  document.getElementById("sensitivity-method").textContent = `${s.method} ${s.designs} designs.`;
  document.getElementById("sensitivity-notes").replaceChildren(...s.notes.map((n) => html("li", {}, n)));
  if (!s.rows.length) { host.replaceChildren(html("p", { class: "empty" }, capital(`${s.missing}.`))); return; }
  const byPath = new Map(data.parameters.map((p) => [p.path, p])), w = Math.max(150, Math.min(420, 0.4 * host.clientWidth)), x = linear(-1, 1, 0, w);
  const bars = (row) => svg("svg", { width: w, height: 24, "aria-hidden": "true" },
    svg("rect", { x: x(-s.chance), y: 0, width: x(s.chance) - x(-s.chance), height: 24, class: "chance" }), svg("line", { x1: x(0), x2: x(0), y1: 0, y2: 24, class: "axis-line" }),
    ...[["rank_correlation", 4, "bar"], ["regression", 13, "bar second"]].filter(([key]) => row[key] !== null).map(([key, y, kind]) => svg("rect", { x: Math.min(x(0), x(row[key])), y, width: Math.max(1, Math.abs(x(row[key]) - x(0))), height: 7, class: kind })));
  const rows = s.rows.map((row) => { const p = byPath.get(row.path); return html("tr", {}, html("th", { scope: "row" }, parameterName(p)), html("td", {}, bars(row)), cellsOf([number(row.rank_correlation, 2), number(row.regression, 2)])); });
  host.replaceChildren(table(["parameter", "−1 … 1", { text: "rank correlation", number: true }, { text: "SRRC", number: true }], rows));
  const explained = s.explained === null ? "No regression: it takes at least three designs a coefficient." : `The regression explains ${number(Math.round(100 * s.explained))} % of the variance of the fitness ranks (adjusted R²).`;
  document.getElementById("sensitivity-fit").textContent = `Grey: what unrelated numbers reach by chance in 95 of 100 cases (±${number(s.chance, 2)}). ${explained}`;
}

const parameterName = (p) => { const m = /^fingers\[(\d+)\]/.exec(p.path); return m ? `${p.name}, finger ${Number(m[1]) + 1}` : p.name; };

function drawFailures() {
  const total = data.summary.evaluations, host = document.getElementById("failure-table");
  const rows = (list, all) => list.map((f) => html("tr", {}, html("td", {}, f.status), html("td", { class: "why" }, f.reason || "–", f.differing ? html("small", {}, " and the like with other numbers") : null),
    cellsOf([number(f.count), all ? `${number((100 * f.count) / all, 3)} %` : "–", `evaluation ${f.first_index}`])));
  const heads = ["status", "reason", { text: "times", number: true }, { text: "of all", number: true }, { text: "first seen", number: true }];
  host.replaceChildren(data.failures.length ? table(heads, rows(data.failures, total)) : html("p", { class: "empty" }, total ? "No design failed." : "Nothing was evaluated yet."));
  if (data.object_failures.length) host.append(html("h3", {}, "Single grasps that did not finish, of designs that count"), html("p", {}, "Such an object counts as lost."), table(["object and status", ...heads.slice(1)], rows(data.object_failures, total * data.objects.length)));
}

function drawRechecks() {
  const r = data.rechecks, body = document.querySelector("#rechecks .body");
  if (!r) {
    body.replaceChildren(html("p", { class: "empty" }, "No elite was rechecked. ", html("code", {}, `finqd recheck ${data.run_argument}`), " evaluates the elites again under slightly other conditions."));
    return;
  }
  const elites = Object.entries(r.elites).map(([index, one]) => [byIndex.get(Number(index)), one]).filter(([d]) => d);
  const ranges = Object.entries(r.ranges).map(([name, [low, high]]) => `${name.replaceAll("_", " ")} ${number(low)} to ${number(high)}`).join("; ");
  body.replaceChildren(html("p", {}, `${elites.length} of ${r.of} elites, ${r.count} rechecks each${r.complete ? "" : " (not all are there yet)"}. Varied: ${ranges || "nothing"}.`),
    scoreTable(r), eliteRechecks(elites), objectRechecks(r), html("p", { class: "note" }, r.definition));
}

function scoreTable(r) {
  const row = (name, raw, corrected) => html("tr", {}, html("th", { scope: "row" }, name), cellsOf([raw, corrected]));
  return table(["of the elites that were rechecked", { text: "raw", number: true }, { text: "corrected", number: true }],
    [row("coverage", percent(r.raw.coverage), percent(r.corrected.coverage)), row("QD score", number(r.raw.qd_score), number(r.corrected.qd_score))]);
}

function eliteRechecks(elites) {
  const heads = ["elite", ...["fitness", "held in rechecks", "95 % interval", "keeps its objects", "verdicts flipped", "failed"].map((text) => ({ text, number: true }))];
  elites.sort((a, b) => b[1].success.rate - a[1].success.rate || b[0].objective - a[0].objective);
  const rows = elites.map(([d, one]) => html("tr", {},
    html("td", {}, html("button", { type: "button", class: "link", onclick: () => select(d.index, { scroll: true }) }, `cell ${d.cell.join(", ")}`)),
    cellsOf([number(d.fitness), percent(one.success.rate), intervalText(one.success), `${one.keeps.part} of ${one.keeps.whole}`, percent(one.flips.rate), `${one.failed} of ${one.rechecks}`])));
  return html("div", rows.length > 20 ? { class: "scroll tall", tabindex: 0, role: "region", "aria-label": "Rechecks of the elites" } : {}, table(heads, rows));
}

function objectRechecks(r) {
  const heads = ["object, over all elites", { text: "held in rechecks", number: true }, { text: "verdicts flipped", number: true }];
  return table(heads, Object.entries(r.objects).map(([name, one]) => html("tr", {}, html("th", { scope: "row" }, name), cellsOf([percent(one.held.rate), percent(one.flips.rate)]))));
}

// -- facts ------------------------------------------------------------------------------------------------------------

function drawFacts() {
  document.getElementById("assumption-list").replaceChildren(...data.assumptions.map((a) => html("li", {}, a)));
  const effects = data.effects.map((e) => html("tr", {}, html("th", { scope: "row", title: e.what || null }, e.name), html("td", {}, e.state), html("td", { class: "n" }, e.grasps ? `${number(e.met)} of ${number(e.grasps)}` : "")));
  document.getElementById("effect-table").replaceChildren(effects.length ? table(["effect", "state", { text: "met in grasps of elites", number: true }], effects) : html("p", { class: "empty" }, "Known once there is an elite."));
  document.getElementById("reduction-list").replaceChildren(...Object.entries(data.reductions).map(([name, text]) => html("li", {}, html("b", {}, `${name.replaceAll("_", " ")}: `), text)));
  document.getElementById("preset-table").replaceChildren(data.presets.length ? table(["preset", "used for", { text: "evaluations", number: true }, "measured accuracy"], data.presets.map((p) => html("tr", {}, html("th", { scope: "row" }, p.preset), html("td", {}, p.role), cellsOf([number(p.evaluations)]), html("td", {}, p.accuracy)))) : html("p", { class: "empty" }, "The log names no preset."));
  document.getElementById("setting-table").replaceChildren(table(["setting", "value"], data.settings.map(([key, value]) => html("tr", {}, html("th", { scope: "row" }, key), html("td", {}, html("code", {}, value))))));
}
