// Sensitivity, failures, rechecks, and the facts.

function drawSensitivity() {
  const s = data.sensitivity,
    host = document.getElementById("sensitivity-table");
  document.getElementById("sensitivity-method").textContent = `${s.method} ${s.designs} designs.`;
  document.getElementById("sensitivity-notes").replaceChildren(...s.notes.map((n) => html("li", {}, n)));
  if (!s.rows.length) {
    host.replaceChildren(html("p", { class: "empty" }, capital(`${s.missing}.`)));
    return;
  }
  const byPath = new Map(data.parameters.map((p) => [p.path, p])),
    w = Math.max(150, Math.min(420, 0.4 * host.clientWidth)),
    x = linear(-1, 1, 0, w);
  const bars = (row) =>
    svg(
      "svg",
      { width: w, height: 24, "aria-hidden": "true" },
      svg("rect", { x: x(-s.chance), y: 0, width: x(s.chance) - x(-s.chance), height: 24, class: "chance" }),
      svg("line", { x1: x(0), x2: x(0), y1: 0, y2: 24, class: "axis-line" }),
      ...[
        ["rank_correlation", 4, "bar"],
        ["regression", 13, "bar second"],
      ]
        .filter(([key]) => row[key] !== null)
        .map(([key, y, kind]) =>
          svg("rect", {
            x: Math.min(x(0), x(row[key])),
            y,
            width: Math.max(1, Math.abs(x(row[key]) - x(0))),
            height: 7,
            class: kind,
          }),
        ),
    );
  const rows = s.rows.map((row) => {
    const p = byPath.get(row.path);
    return html(
      "tr",
      {},
      html("th", { scope: "row" }, parameterName(p)),
      html("td", {}, bars(row)),
      cellsOf([number(row.rank_correlation, 2), number(row.regression, 2)]),
    );
  });
  host.replaceChildren(
    table(["parameter", "−1 … 1", { text: "rank correlation", number: true }, { text: "SRRC", number: true }], rows),
  );
  const explained =
    s.explained === null
      ? "No regression: it takes at least three designs a coefficient."
      : `The regression explains ${number(Math.round(100 * s.explained))} % of the variance of the fitness ranks (adjusted R²).`;
  document.getElementById("sensitivity-fit").textContent =
    `Grey: what unrelated numbers reach by chance in 95 of 100 cases (±${number(s.chance, 2)}). ${explained}`;
}

const parameterName = (p) => {
  const m = /^fingers\[(\d+)\]/.exec(p.path);
  return m ? `${p.name}, finger ${Number(m[1]) + 1}` : p.name;
};

function drawFailures() {
  const total = data.summary.evaluations,
    host = document.getElementById("failure-table");
  const rows = (list, all) =>
    list.map((f) =>
      html(
        "tr",
        {},
        html("td", {}, f.status),
        html(
          "td",
          { class: "why" },
          f.reason || "–",
          f.differing ? html("small", {}, " and the like with other numbers") : null,
        ),
        cellsOf([number(f.count), all ? `${number((100 * f.count) / all, 3)} %` : "–", `evaluation ${f.first_index}`]),
      ),
    );
  const heads = [
    "status",
    "reason",
    { text: "times", number: true },
    { text: "of all", number: true },
    { text: "first seen", number: true },
  ];
  host.replaceChildren(
    data.failures.length
      ? table(heads, rows(data.failures, total))
      : html("p", { class: "empty" }, total ? "No design failed." : "Nothing was evaluated yet."),
  );
  if (data.object_failures.length)
    host.append(
      html("h3", {}, "Single grasps that did not finish, of designs that count"),
      html("p", {}, "Such an object counts as lost."),
      table(["object and status", ...heads.slice(1)], rows(data.object_failures, total * data.objects.length)),
    );
}

function drawRechecks() {
  const r = data.rechecks,
    body = document.querySelector("#rechecks .body");
  if (!r) {
    body.replaceChildren(
      html(
        "p",
        { class: "empty" },
        "No elite was rechecked. ",
        html("code", {}, `finqd recheck ${data.run_argument}`),
        " evaluates the elites again under slightly other conditions.",
      ),
    );
    return;
  }
  const elites = Object.entries(r.elites)
    .map(([index, one]) => [byIndex.get(Number(index)), one])
    .filter(([d]) => d);
  const ranges = Object.entries(r.ranges)
    .map(([name, [low, high]]) => `${name.replaceAll("_", " ")} ${number(low)} to ${number(high)}`)
    .join("; ");
  body.replaceChildren(
    html(
      "p",
      {},
      `${elites.length} of ${r.of} elites, ${r.count} rechecks each${r.complete ? "" : " (not all are there yet)"}. Varied: ${ranges || "nothing"}.`,
    ),
    scoreTable(r),
    eliteRechecks(elites),
    objectRechecks(r),
    html("p", { class: "note" }, r.definition),
  );
}

function scoreTable(r) {
  const row = (name, raw, corrected) => html("tr", {}, html("th", { scope: "row" }, name), cellsOf([raw, corrected]));
  return table(
    ["of the elites that were rechecked", { text: "raw", number: true }, { text: "corrected", number: true }],
    [
      row("coverage", percent(r.raw.coverage), percent(r.corrected.coverage)),
      row("QD score", number(r.raw.qd_score), number(r.corrected.qd_score)),
    ],
  );
}

function eliteRechecks(elites) {
  const heads = [
    "elite",
    ...["fitness", "held in rechecks", "95 % interval", "keeps its objects", "verdicts flipped", "failed"].map(
      (text) => ({ text, number: true }),
    ),
  ];
  elites.sort((a, b) => b[1].success.rate - a[1].success.rate || b[0].objective - a[0].objective);
  const rows = elites.map(([d, one]) =>
    html(
      "tr",
      {},
      html(
        "td",
        {},
        html(
          "button",
          { type: "button", class: "link", onclick: () => select(d.index, { scroll: true }) },
          `cell ${d.cell.join(", ")}`,
        ),
      ),
      cellsOf([
        number(d.fitness),
        percent(one.success.rate),
        intervalText(one.success),
        `${one.keeps.part} of ${one.keeps.whole}`,
        percent(one.flips.rate),
        `${one.failed} of ${one.rechecks}`,
      ]),
    ),
  );
  return html(
    "div",
    rows.length > 20
      ? { class: "scroll tall", tabindex: 0, role: "region", "aria-label": "Rechecks of the elites" }
      : {},
    table(heads, rows),
  );
}

function objectRechecks(r) {
  const heads = [
    "object, over all elites",
    { text: "held in rechecks", number: true },
    { text: "verdicts flipped", number: true },
  ];
  return table(
    heads,
    Object.entries(r.objects).map(([name, one]) =>
      html("tr", {}, html("th", { scope: "row" }, name), cellsOf([percent(one.held.rate), percent(one.flips.rate)])),
    ),
  );
}

function drawFacts() {
  document.getElementById("assumption-list").replaceChildren(...data.assumptions.map((a) => html("li", {}, a)));
  const effects = data.effects.map((e) =>
    html(
      "tr",
      {},
      html("th", { scope: "row", title: e.what || null }, e.name),
      html("td", {}, e.state),
      html("td", { class: "n" }, e.grasps ? `${number(e.met)} of ${number(e.grasps)}` : ""),
    ),
  );
  document
    .getElementById("effect-table")
    .replaceChildren(
      effects.length
        ? table(["effect", "state", { text: "met in grasps of elites", number: true }], effects)
        : html("p", { class: "empty" }, "Known once there is an elite."),
    );
  document
    .getElementById("reduction-list")
    .replaceChildren(
      ...Object.entries(data.reductions).map(([name, text]) =>
        html("li", {}, html("b", {}, `${name.replaceAll("_", " ")}: `), text),
      ),
    );
  const s = data.screening;
  document.getElementById("screening").textContent = s
    ? `${number(s.confirmed)} designs were screened and then confirmed: the fitness of ${number(s.other_fitness)} ` +
      `changed, and ${number(s.flipped)} of ${number(s.verdicts)} verdicts.`
    : "";
  document.getElementById("preset-table").replaceChildren(
    data.presets.length
      ? table(
          ["preset", "used for", { text: "evaluations", number: true }, "measured accuracy"],
          data.presets.map((p) =>
            html(
              "tr",
              {},
              html("th", { scope: "row" }, p.preset),
              html("td", {}, p.role),
              cellsOf([number(p.evaluations)]),
              html("td", {}, p.accuracy),
            ),
          ),
        )
      : html("p", { class: "empty" }, "The log names no preset."),
  );
  document.getElementById("setting-table").replaceChildren(
    table(
      ["setting", "value"],
      data.settings.map(([key, value]) =>
        html("tr", {}, html("th", { scope: "row" }, key), html("td", {}, html("code", {}, value))),
      ),
    ),
  );
}
