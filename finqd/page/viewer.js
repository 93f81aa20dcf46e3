// A gripper in 3-D: orbit, zoom, flat shading, sharp edges as lines, a floor grid of 20 mm. WebGL 2; where there is
// none, the same picture is painted from far to near on a plain canvas (faces that cross each other are not resolved).
// Coordinates are millimetres in the gripper's frame, z up.

const PART_COLOURS = { finger: [0.36, 0.68, 0.8], mount: [0.76, 0.79, 0.81] };
const EDGE_COLOUR = [0.09, 0.2, 0.26],
  GRID_COLOUR = [0.84, 0.86, 0.88],
  GRID_MM = 20;
const SHARP = Math.cos((25 * Math.PI) / 180);
const VIEWS = { oblique: [0.6, 0.38], front: [Math.PI / 6, 0], below: [Math.PI / 6, -Math.PI / 2 + 0.001] };

function unpackShape(shape) {
  const text = atob(shape.data),
    bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const view = new DataView(bytes.buffer),
    points = new Float32Array(3 * shape.vertices);
  for (let i = 0; i < points.length; i++) points[i] = view.getInt16(2 * i, true) * shape.step_mm;
  const triangles = new Uint16Array(3 * shape.triangles),
    start = 6 * shape.vertices;
  for (let i = 0; i < triangles.length; i++) triangles[i] = view.getUint16(start + 2 * i, true);
  return { points, triangles, parts: shape.parts };
}

// The solid as a binary STL file: its shells as they are, not joined.
function stlOf(solid) {
  const count = solid.triangles.length / 3,
    view = new DataView(new ArrayBuffer(84 + 50 * count));
  view.setUint32(80, count, true);
  for (let t = 0; t < count; t++) {
    const corners = [0, 1, 2].map((k) => cornerOf(solid, 3 * t + k));
    [normalOf(...corners), ...corners].forEach((vector, row) =>
      vector.forEach((value, axis) => view.setFloat32(84 + 50 * t + 12 * row + 4 * axis, value, true)),
    );
  }
  return new Blob([view.buffer], { type: "model/stl" });
}

function cornerOf(solid, k) {
  const at = 3 * solid.triangles[k];
  return [solid.points[at], solid.points[at + 1], solid.points[at + 2]];
}

function normalOf(a, b, c) {
  const u = b.map((x, i) => x - a[i]),
    v = c.map((x, i) => x - a[i]);
  const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
  const length = Math.hypot(...n) || 1;
  return n.map((x) => x / length);
}

// Faces with their colours and normals, the sharp edges between them, the grid below, and the size of it all.
function preparedSolid(solid) {
  const faces = [],
    edges = new Map(),
    key = (p) => p.join(" ");
  let t = 0;
  for (const [name, count] of solid.parts) {
    for (let end = t + count; t < end; t++) {
      const corners = [0, 1, 2].map((k) => cornerOf(solid, 3 * t + k)),
        normal = normalOf(...corners);
      faces.push({ corners, normal, colour: PART_COLOURS[name] || PART_COLOURS.mount });
      for (let k = 0; k < 3; k++) {
        const ends = [corners[k], corners[(k + 1) % 3]],
          id = ends.map(key).sort().join("|") + name;
        if (!edges.has(id)) edges.set(id, { ends, normals: [] });
        edges.get(id).normals.push(normal);
      }
    }
  }
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const sharp = [...edges.values()].filter((e) => e.normals.length < 2 || dot(e.normals[0], e.normals[1]) < SHARP);
  const low = [Infinity, Infinity, Infinity],
    high = [-Infinity, -Infinity, -Infinity];
  for (const { corners } of faces)
    for (const p of corners)
      for (let i = 0; i < 3; i++) {
        low[i] = Math.min(low[i], p[i]);
        high[i] = Math.max(high[i], p[i]);
      }
  const centre = [0, 0, (low[2] + high[2]) / 2],
    reach = Math.max(...low.map(Math.abs), ...high.map(Math.abs));
  return {
    faces,
    edges: sharp.map((e) => e.ends),
    grid: gridLines(low, high),
    centre,
    radius: 0.5 * Math.hypot(...high.map((x, i) => x - low[i])) || reach,
  };
}

function gridLines(low, high) {
  const half = GRID_MM * Math.ceil(Math.max(...[0, 1].flatMap((i) => [-low[i], high[i]])) / GRID_MM),
    lines = [];
  for (let x = -half; x <= half; x += GRID_MM) {
    lines.push(
      [
        [x, -half, low[2]],
        [x, half, low[2]],
      ],
      [
        [-half, x, low[2]],
        [half, x, low[2]],
      ],
    );
  }
  return lines;
}

function rotationOf(yaw, pitch) {
  // rows: right, up, towards the viewer
  const [s, c, sp, cp] = [Math.sin(yaw), Math.cos(yaw), Math.sin(pitch), Math.cos(pitch)];
  return [-s, c, 0, -sp * c, -sp * s, cp, cp * c, cp * s, sp];
}

const SHADERS = {
  vertex: `#version 300 es
    in vec3 place; in vec3 colour; uniform mat3 turn; uniform vec3 centre; uniform vec4 lens; out vec3 seen; out vec3 tint;
    void main() {
      seen = turn * (place - centre); tint = colour;
      float w = lens.x - seen.z, near = 0.05 * lens.x, far = 4.0 * lens.x;
      float depth = (far + near) / (far - near) * w - 2.0 * far * near / (far - near) - lens.w * 0.0004 * w;
      gl_Position = vec4(seen.xy * lens.yz, depth, w);
    }`,
  fragment: `#version 300 es
    precision highp float; in vec3 seen; in vec3 tint; uniform float shaded; out vec4 pixel;
    void main() {
      vec3 n = normalize(cross(dFdx(seen), dFdy(seen)));
      float light = 0.46 + 0.40 * max(n.z, 0.0) + 0.30 * max(dot(n, normalize(vec3(-0.35, 0.8, 0.45))), 0.0);
      pixel = vec4(shaded > 0.5 ? tint * light : tint, 1.0);
    }`,
};

function glPainter(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: true });
  if (!gl) return null;
  const program = gl.createProgram();
  for (const [kind, source] of [
    [gl.VERTEX_SHADER, SHADERS.vertex],
    [gl.FRAGMENT_SHADER, SHADERS.fragment],
  ]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(0, 0, 0, 0);
  const where = (name) => gl.getUniformLocation(program, name),
    buffer = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  ["place", "colour"].forEach((name, i) => {
    const at = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 24, 12 * i);
  });
  let loaded = null,
    counts = [0, 0, 0];
  return (model, turn, distance, focus) => {
    if (loaded !== model) {
      const rows = [];
      for (const f of model.faces) for (const p of f.corners) rows.push(...p, ...f.colour);
      for (const line of model.edges) for (const p of line) rows.push(...p, ...EDGE_COLOUR);
      for (const line of model.grid) for (const p of line) rows.push(...p, ...GRID_COLOUR);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(rows), gl.STATIC_DRAW);
      const edges = 2 * model.edges.length;
      counts = [3 * model.faces.length, edges, edges + 2 * model.grid.length];
      loaded = model;
    }
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix3fv(where("turn"), true, turn);
    gl.uniform3fv(where("centre"), model.centre);
    const short = Math.min(canvas.width, canvas.height),
      zoom = [(focus * short) / canvas.width, (focus * short) / canvas.height];
    gl.uniform4f(where("lens"), distance, ...zoom, 0);
    gl.uniform1f(where("shaded"), 1);
    gl.drawArrays(gl.TRIANGLES, 0, counts[0]);
    gl.uniform4f(where("lens"), distance, ...zoom, 1); // lines a little nearer than the faces that they bound
    gl.uniform1f(where("shaded"), 0);
    gl.drawArrays(gl.LINES, counts[0], turn[8] < -0.1 ? counts[1] : counts[2]); // no floor between it and who looks up
  };
}

// The corners of a face's pieces, none with an edge longer than `longest`: painting by depth needs small faces.
function pieces(corners, longest) {
  const lengths = corners.map((p, k) => Math.hypot(...p.map((x, i) => x - corners[(k + 1) % 3][i]))),
    k = lengths.indexOf(Math.max(...lengths));
  if (lengths[k] <= longest) return [corners];
  const [a, b, c] = [0, 1, 2].map((i) => corners[(k + i) % 3]),
    middle = a.map((x, i) => (x + b[i]) / 2);
  return [...pieces([a, middle, c], longest), ...pieces([middle, b, c], longest)];
}

function flatPainter(canvas) {
  const pen = canvas.getContext("2d");
  let loaded = null,
    split = [];
  const css = (colour, light) => `rgb(${colour.map((c) => Math.round(255 * Math.min(1, c * light))).join(" ")})`;
  return (model, turn, distance, focus) => {
    const turned = (p, c) =>
      [0, 3, 6].map((r) => turn[r] * (p[0] - c[0]) + turn[r + 1] * (p[1] - c[1]) + turn[r + 2] * (p[2] - c[2]));
    const half = 0.5 * focus * Math.min(canvas.width, canvas.height);
    const flat = (q) => [
      canvas.width / 2 + (half * q[0]) / (distance - q[2]),
      canvas.height / 2 - (half * q[1]) / (distance - q[2]),
    ];
    const path = (points) => {
      pen.beginPath();
      points.forEach((q, i) => (i ? pen.lineTo(...flat(q)) : pen.moveTo(...flat(q))));
    };
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.lineJoin = "round";
    pen.lineWidth = window.devicePixelRatio || 1;
    pen.strokeStyle = css(GRID_COLOUR, 1);
    for (const line of turn[8] < -0.1 ? [] : model.grid) {
      path(line.map((p) => turned(p, model.centre)));
      pen.stroke();
    }
    if (loaded !== model) {
      split = model.faces.flatMap((f) => pieces(f.corners, 0.12 * model.radius).map((corners) => ({ ...f, corners })));
      loaded = model;
    }
    const faces = [];
    for (const f of split) {
      const n = turned(f.normal, [0, 0, 0]),
        corners = f.corners.map((p) => turned(p, model.centre));
      const middle = [0, 1, 2].map((i) => (corners[0][i] + corners[1][i] + corners[2][i]) / 3);
      if (n[0] * -middle[0] + n[1] * -middle[1] + n[2] * (distance - middle[2]) <= 0) continue;
      const light = 0.46 + 0.4 * Math.max(n[2], 0) + 0.3 * Math.max(-0.356 * n[0] + 0.815 * n[1] + 0.458 * n[2], 0);
      faces.push({ corners, depth: middle[2], colour: css(f.colour, light) });
    }
    faces.sort((a, b) => a.depth - b.depth);
    for (const { corners, colour } of faces) {
      path(corners);
      pen.fillStyle = pen.strokeStyle = colour;
      pen.fill();
      pen.stroke();
    }
  };
}

// Returns { show(solid), look(name), kind }: kind is "webgl" or "canvas".
function makeViewer(canvas) {
  const gl = glPainter(canvas);
  if (!gl) {
    // a canvas that was asked for WebGL gives no other picture
    const fresh = canvas.cloneNode();
    canvas.replaceWith(fresh);
    canvas = fresh;
  }
  const paint = gl || flatPainter(canvas);
  let model = null,
    [yaw, pitch] = VIEWS.oblique,
    zoom = 1,
    asked = false;
  const draw = () => {
    asked = false;
    const ratio = window.devicePixelRatio || 1,
      [w, h] = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.round(ratio * x));
    if (!model || !w || !h) return;
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    paint(model, rotationOf(yaw, pitch), 3.4 * model.radius, 3.6 * zoom);
  };
  const redraw = () => {
    if (!asked) {
      asked = true;
      requestAnimationFrame(draw);
    }
  };
  const turnBy = (a, b) => {
    yaw -= a;
    pitch = Math.max(-Math.PI / 2 + 0.001, Math.min(Math.PI / 2 - 0.001, pitch + b));
    redraw();
  };
  const zoomBy = (factor) => {
    zoom = Math.max(0.4, Math.min(8, zoom * factor));
    redraw();
  };
  const look = (name) => {
    [yaw, pitch] = VIEWS[name];
    zoom = 1;
    redraw();
  };
  const fingers = new Map(); // pointers that are down: one turns, two zoom
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => fingers.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    const last = fingers.get(e.pointerId);
    if (!last) return;
    const before = fingers.size === 2 ? spread() : 0;
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    if (fingers.size === 2) zoomBy(spread() / (before || 1));
    else turnBy((e.clientX - last.x) * 0.01, (e.clientY - last.y) * 0.01);
  });
  canvas.addEventListener(
    "wheel",
    (e) => {
      if (!e.ctrlKey && document.activeElement !== canvas) return; // the page scrolls until the picture is chosen
      e.preventDefault();
      zoomBy(Math.exp(-0.0015 * e.deltaY));
    },
    { passive: false },
  );
  canvas.addEventListener("keydown", (e) => {
    const turns = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, -0.12], ArrowDown: [0, 0.12] };
    if (turns[e.key]) turnBy(...turns[e.key]);
    else if (e.key === "+" || e.key === "=") zoomBy(1.15);
    else if (e.key === "-") zoomBy(1 / 1.15);
    else if (e.key === "0" || e.key === "Home") look("oblique");
    else return;
    e.preventDefault();
  });
  new ResizeObserver(redraw).observe(canvas);
  return {
    show: (solid) => {
      model = solid && preparedSolid(solid);
      redraw();
    },
    look,
    kind: gl ? "webgl" : "canvas",
  };
}
