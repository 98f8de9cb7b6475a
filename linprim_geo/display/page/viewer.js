"use strict";
// Shows the meshes of the element #meshes, packed by report_mesh.py, in the canvas #view with WebGL 2; nothing is fetched.
(() => {
  const canvas = document.getElementById("view");
  const holder = document.getElementById("meshes");
  if (!canvas || !holder) return;
  const meshes = JSON.parse(holder.textContent);
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  const say = (text) => { document.getElementById("view-message").textContent = text; };
  if (!gl) {
    say("This browser offers no WebGL 2, so the mesh cannot be turned here; the pictures above show it.");
    canvas.hidden = true;
    return;
  }

  const VERTEX = `#version 300 es
    uniform mat4 eye_from_unit, clip_from_eye;
    in vec3 place, tint;
    out vec3 eye, color;
    void main() {
      vec4 at = eye_from_unit * vec4(place, 1.0);
      eye = at.xyz;
      color = tint;
      gl_Position = clip_from_eye * at;
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    uniform float shading;
    in vec3 eye, color;
    out vec4 shown;
    void main() {
      vec3 normal = normalize(cross(dFdx(eye), dFdy(eye)));
      float light = abs(dot(normal, normalize(eye)));
      vec3 base = gl_FrontFacing ? color : mix(color, vec3(0.35, 0.43, 0.78), 0.6);
      shown = vec4(base * (1.0 - shading + shading * light), 1.0);
    }`;

  function compile(kind, source) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    return shader;
  }
  const program = gl.createProgram();
  gl.attachShader(program, compile(gl.VERTEX_SHADER, VERTEX));
  gl.attachShader(program, compile(gl.FRAGMENT_SHADER, FRAGMENT));
  gl.bindAttribLocation(program, 0, "place");
  gl.bindAttribLocation(program, 1, "tint");
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const buffers = { place: gl.createBuffer(), tint: gl.createBuffer(), index: gl.createBuffer() };

  // --- vectors: matrices are columns, as WebGL wants them ---
  const add = (a, b, k = 1) => a.map((x, i) => x + k * b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const l = Math.hypot(...a) || 1; return a.map((x) => x / l); };

  const FIELD = Math.tan((Math.PI / 180) * 20);
  const STEEPEST = 1.55;
  let mesh, layer, shape, axes, home, turn, pitch, away, target;

  function frame() {
    // Right, forward and up of the scene; the angles are about `up`.
    const up = unit(mesh.up);
    const side = unit(cross(Math.abs(up[0]) > 0.9 ? [0, 1, 0] : [1, 0, 0], up));
    axes = [side, cross(up, side), up];
    const from = unit(mesh.from);
    home = { turn: Math.atan2(dot(from, axes[1]), dot(from, axes[0])), pitch: Math.asin(Math.max(-1, Math.min(1, dot(from, up)))) };
  }
  function reset() {
    turn = home.turn;
    pitch = Math.max(-STEEPEST, Math.min(STEEPEST, home.pitch));
    away = 0.95 / FIELD;
    target = [0, 0, 0];
  }

  function eyeAxes() {
    const flat = add(axes[0].map((x) => x * Math.cos(turn)), axes[1], Math.sin(turn));
    const back = add(flat.map((x) => x * Math.cos(pitch)), axes[2], Math.sin(pitch));
    const right = unit(cross(axes[2], back));
    return [right, cross(back, right), back];
  }

  let asked = false;
  function draw() {
    if (asked) return;
    asked = true;
    requestAnimationFrame(paint);
  }
  function paint() {
    asked = false;
    const scale = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(canvas.clientWidth * scale));
    const height = Math.max(1, Math.round(canvas.clientHeight * scale));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    if (document.getElementById("view-backs").checked) gl.enable(gl.CULL_FACE); else gl.disable(gl.CULL_FACE);
    const [right, up, back] = eyeAxes();
    const eye = add(target, back, away);
    // Places are 0 to 1 in the mesh's box; in the middle of it, in units of its half diagonal, is the unit of everything here.
    const half = Math.hypot(...shape) / 2 || 1;
    const view = [];
    for (let k = 0; k < 3; k++) view.push([right, up, back].map((axis) => (axis[k] * shape[k]) / half), [0]);
    const corner = add(shape.map((x) => -x / 2 / half), eye, -1);
    const matrix = [...view.flat(), dot(right, corner), dot(up, corner), dot(back, corner), 1];
    const near = Math.max(0.02, away - 2.5), far = away + 4;
    const wide = Math.max(1, height / width), aspect = width / height;
    const projection = [1 / (FIELD * wide * aspect), 0, 0, 0, 0, 1 / (FIELD * wide), 0, 0,
      0, 0, -(far + near) / (far - near), -1, 0, 0, (-2 * far * near) / (far - near), 0];
    gl.uniformMatrix4fv(uniform("eye_from_unit"), false, matrix);
    gl.uniformMatrix4fv(uniform("clip_from_eye"), false, projection);
    gl.uniform1f(uniform("shading"), layer.name === "shape" ? 0.75 : 0.35);
    gl.drawElements(gl.TRIANGLES, mesh.faces * 3, gl.UNSIGNED_INT, 0);
    canvas.dataset.drawn = mesh.name + ", " + layer.name;
  }

  function showLayer(name) {
    layer = mesh.layers.find((each) => each.name === name) || mesh.layers[0];
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.tint);
    gl.bufferData(gl.ARRAY_BUFFER, bytes(layer.colors), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 3, gl.UNSIGNED_BYTE, true, 0, 0);
    const legend = document.getElementById("view-legend");
    legend.hidden = !layer.legend;
    if (layer.legend) document.getElementById("view-top").textContent = layer.legend;
    draw();
  }
  function showMesh(number) {
    const before = layer && layer.name;
    mesh = meshes[number];
    shape = mesh.size;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.place);
    gl.bufferData(gl.ARRAY_BUFFER, new Uint16Array(bytes(mesh.places).buffer), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    // Rows of four, as WebGL wants attributes aligned to four bytes; the last is not read.
    gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, true, 8, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.index);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(bytes(mesh.index).buffer), gl.STATIC_DRAW);
    document.getElementById("view-backs").checked = mesh.inside;
    say(mesh.said);
    const choice = document.getElementById("view-layers");
    choice.replaceChildren(...mesh.layers.map((each) => {
      const label = document.createElement("label"), input = document.createElement("input");
      Object.assign(input, { type: "radio", name: "layer", value: each.name });
      input.addEventListener("change", () => showLayer(each.name));
      label.append(input, " " + each.name);
      return label;
    }));
    frame();
    reset();
    showLayer(mesh.layers.some((each) => each.name === before) ? before : mesh.layers[0].name);
    choice.querySelectorAll("input").forEach((input) => { input.checked = input.value === layer.name; });
  }

  // --- mouse, touch, keys ---
  const fingers = new Map();
  const zoom = (factor) => { away = Math.max(0.05, Math.min(20, away * factor)); draw(); };
  const rotate = (x, y) => {
    turn -= x;
    pitch = Math.max(-STEEPEST, Math.min(STEEPEST, pitch + y));
    draw();
  };
  const shift = (x, y) => {
    const [right, up] = eyeAxes(), step = (2 * FIELD * away) / canvas.clientHeight;
    target = add(add(target, right, -x * step), up, y * step);
    draw();
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const old = fingers.get(event.pointerId);
    if (!old) return;
    const now = [event.clientX, event.clientY], x = now[0] - old[0], y = now[1] - old[1];
    if (fingers.size === 1) {
      if (event.shiftKey || event.buttons & 6) shift(x, y); else rotate(x * 0.008, y * 0.008);
    } else if (fingers.size === 2) {
      const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
      const span = (place) => Math.hypot(place[0] - other[0], place[1] - other[1]) || 1;
      shift(x / 2, y / 2);
      zoom(span(old) / span(now));
    }
    fingers.set(event.pointerId, now);
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    // A page that is scrolled past stays scrollable: the wheel belongs to the mesh once it has been clicked.
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    zoom(Math.exp(Math.max(-0.3, Math.min(0.3, event.deltaY * 0.0015))));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { reset(); draw(); });
  canvas.addEventListener("keydown", (event) => {
    const keys = {
      ArrowLeft: () => rotate(-0.1, 0), ArrowRight: () => rotate(0.1, 0), ArrowUp: () => rotate(0, -0.1), ArrowDown: () => rotate(0, 0.1),
      "+": () => zoom(0.9), "-": () => zoom(1.1), Home: () => { reset(); draw(); },
    };
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  canvas.addEventListener("webglcontextlost", () => say("The graphics driver dropped the mesh; load the page again."));
  document.getElementById("view-backs").addEventListener("change", draw);
  const which = document.getElementById("view-mesh");
  meshes.forEach((each, number) => which.append(new Option(each.name, number)));
  which.closest("label").hidden = meshes.length < 2;
  which.addEventListener("change", () => showMesh(Number(which.value)));
  new ResizeObserver(draw).observe(canvas);
  showMesh(0);
})();
