// What all charts are made of: elements, numbers with their units, scales, axes, colours. Each chart is drawn anew into
// its host at the host's width, and leaves in `marks` what moves its mark to the design that is chosen. Texts from files
// only ever become text nodes and attributes.

const marks = {};

const SVG_NAMESPACE = "http://www.w3.org/2000/svg";

function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS(SVG_NAMESPACE, tag);
  for (const [name, value] of Object.entries(attributes))
    if (value !== null && value !== undefined) node.setAttribute(name, value);
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
  const raw = (high - low || 1) / Math.max(1, count),
    base = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * base).find((s) => s >= raw * 0.999),
    found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++)
    found.push(Number((k * step).toPrecision(12)));
  return found;
}

const linear = (low, high, from, to) => (value) => from + ((value - low) / (high - low || 1)) * (to - from);

function colourAt(share) {
  const stops = data.colours,
    at = Math.max(0, Math.min(1, share)) * (stops.length - 1),
    i = Math.min(Math.floor(at), stops.length - 2);
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
    root.append(
      svg("line", { x1: x, x2: x, y1: box.bottom, y2: box.bottom + 5, class: "tick" }),
      svg("text", { x, y: box.bottom + 18, class: "tick-text", "text-anchor": "middle" }, write(value)),
    );
  }
  root.append(
    svg(
      "text",
      { x: (box.left + box.right) / 2, y: box.bottom + 37, class: "axis-title", "text-anchor": "middle" },
      title,
    ),
  );
}

function axisY(root, box, scale, values, title, { grid = false, write = number } = {}) {
  for (const value of values) {
    const y = scale(value);
    root.append(
      svg("line", {
        x1: grid ? box.left : box.left - 5,
        x2: grid ? box.right : box.left,
        y1: y,
        y2: y,
        class: grid ? "grid" : "tick",
      }),
      svg("text", { x: box.left - 9, y: y + 4, class: "tick-text", "text-anchor": "end" }, write(value)),
    );
  }
  root.append(
    svg(
      "text",
      {
        transform: `translate(13 ${(box.top + box.bottom) / 2}) rotate(-90)`,
        class: "axis-title",
        "text-anchor": "middle",
      },
      title,
    ),
  );
}
