// Splats bound to a moving mesh: the vertex shader poses and projects them; the processor only sorts by depth.
(async () => {
  const $ = (id) => document.getElementById(id);
  const scene = JSON.parse($("scene").textContent);
  const say = (text) => { $("message").textContent = text; };
  const canvas = $("view");
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
  if (!gl) { say("This browser has no WebGL 2."); return; }

  const unpack = async () => {
    const text = atob($("data").textContent);
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    $("data").remove();
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const buffer = await new Response(stream).arrayBuffer();
    const kinds = { uint8: Uint8Array, int16: Int16Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };
    return Object.fromEntries(scene.arrays.map((a) => [a.name, new kinds[a.type](buffer, a.offset, a.length)]));
  };
  const data = await unpack();
  const count = scene.count, vertices = scene.vertices;

  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, "index");
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) || "shader");
  gl.useProgram(program);
  const uniform = (name) => gl.getUniformLocation(program, name);

  let units = 0;
  const texture = (name, width, internal, format, type, values, perRow) => {
    const height = Math.ceil(values.length / perRow);
    const full = new values.constructor(height * perRow);
    full.set(values);
    gl.activeTexture(gl.TEXTURE0 + units);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, full);
    gl.uniform1i(uniform(name), units);
    return { unit: units++, width, height, full };
  };
  const quads = new Uint32Array(4 * count), still = new Float32Array(8 * count), turn = new Float32Array(4 * count);
  const [low, step] = data.scaleRange;
  const weights = new Float32Array(3 * count), offsets = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const u = data.barycentric[2 * i] / 65535, v = data.barycentric[2 * i + 1] / 65535;
    weights.set([u, v, 1 - u - v], 3 * i);
    for (let k = 0; k < 3; k++) {
      quads[4 * i + k] = data.corners[3 * i + k];
      offsets[3 * i + k] = data.offset[3 * i + k] * data.offsetStep[0];
    }
    const size = (k) => Math.exp(low + step * data.scales[3 * i + k]);
    const [x, y, z] = offsets.subarray(3 * i, 3 * i + 3);
    still.set([u, v, x, y, z, size(0), size(1), size(2)], 8 * i);
    for (let k = 0; k < 4; k++) turn[4 * i + k] = data.quats[4 * i + k] / 32767;
  }
  const mesh = texture("mesh", 1024, gl.RGBA32F, gl.RGBA, gl.FLOAT, new Float32Array(8 * vertices), 4096);
  texture("corners", 1024, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT, quads, 4096);
  texture("still", 1024, gl.RGBA32F, gl.RGBA, gl.FLOAT, still, 4096);
  texture("turn", 1024, gl.RGBA32F, gl.RGBA, gl.FLOAT, turn, 4096);
  texture("paint", 1024, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, data.colors, 4096);

  const order = new Uint32Array(count);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, order.byteLength, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);

  const state = { frame: 0, yaw: 0, pitch: 0, zoom: 1, shift: [0, 0, 0], background: [1, 1, 1] };
  const face = drivenFace(scene, data);
  let shown = -1, driven = false;
  const pose = (frame) => {
    if (frame === shown && !driven) return;
    shown = driven ? -1 : frame;
    const out = mesh.full;
    if (driven) face.fill(out); else playedFrame(frame, out);
    gl.activeTexture(gl.TEXTURE0 + mesh.unit);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, mesh.width, mesh.height, gl.RGBA, gl.FLOAT, out);
  };
  const playedFrame = (frame, out) => {
    const modes = data.steps.length / 8, size = 8 * vertices;
    out.set(data.mean);
    for (let m = 0; m < modes; m++) {
      const gain = data.weights[frame * modes + m], base = m * size;
      const steps = Array.from(data.steps.subarray(8 * m, 8 * m + 8), (value) => value * gain);
      for (let i = 0; i < size; i++) out[i] += steps[i & 7] * data.modes[base + i];
    }
    for (let i = 0; i < size; i += 8) {
      const length = Math.hypot(out[i + 4], out[i + 5], out[i + 6], out[i + 7]);
      for (let k = 4; k < 8; k++) out[i + k] /= length;
    }
  };

  const local = new Float32Array(4 * vertices), depth = new Float32Array(count), bins = new Uint32Array(65537);
  const keys = new Uint16Array(count);
  const sort = (forward, start) => {
    const m = mesh.full, [fx, fy, fz] = forward;
    for (let v = 0; v < vertices; v++) {
      const i = 8 * v, w = m[i + 4], x = -m[i + 5], y = -m[i + 6], z = -m[i + 7];
      const tx = 2 * (y * fz - z * fy), ty = 2 * (z * fx - x * fz), tz = 2 * (x * fy - y * fx);
      local[4 * v] = fx + w * tx + y * tz - z * ty;
      local[4 * v + 1] = fy + w * ty + z * tx - x * tz;
      local[4 * v + 2] = fz + w * tz + x * ty - y * tx;
      local[4 * v + 3] = m[i] * fx + m[i + 1] * fy + m[i + 2] * fz + start;
    }
    let near = Infinity, far = -Infinity;
    for (let i = 0; i < count; i++) {
      let sum = 0;
      const a = offsets[3 * i], b = offsets[3 * i + 1], c = offsets[3 * i + 2];
      for (let k = 0; k < 3; k++) {
        const v = 4 * quads[4 * i + k];
        sum += weights[3 * i + k] * (local[v + 3] + local[v] * a + local[v + 1] * b + local[v + 2] * c);
      }
      depth[i] = sum;
      if (sum < near) near = sum;
      if (sum > far) far = sum;
    }
    bins.fill(0);
    const gain = 65535 / Math.max(far - near, 1e-9);
    for (let i = 0; i < count; i++) {
      keys[i] = (far - depth[i]) * gain;
      bins[keys[i] + 1]++;
    }
    for (let i = 1; i < bins.length; i++) bins[i] += bins[i - 1];
    for (let i = 0; i < count; i++) order[bins[keys[i]]++] = i;
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
  };

  const draw = () => {
    const a = state.yaw * Math.PI / 180, b = state.pitch * Math.PI / 180;
    const back = [Math.sin(a) * Math.cos(b), Math.sin(b), Math.cos(a) * Math.cos(b)];
    const right = [Math.cos(a), 0, -Math.sin(a)];
    const down = [right[1] * back[2] - right[2] * back[1], right[2] * back[0] - right[0] * back[2], right[0] * back[1] - right[1] * back[0]];
    const forward = back.map((value) => -value);
    const distance = scene.distance * state.zoom;
    const eye = back.map((value, k) => scene.target[k] + state.shift[k] + distance * value);
    const dot = (p, q) => p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
    const rows = [right, down, forward];
    const view = new Float32Array(16);
    rows.forEach((row, r) => { row.forEach((value, c) => { view[4 * c + r] = value; }); view[12 + r] = -dot(row, eye); });
    view[15] = 1;
    pose(state.frame);
    sort(forward, -dot(forward, eye));
    // The head fills the shorter side.
    const focal = Math.min(canvas.width, canvas.height) / 2 / Math.tan(scene.fov * Math.PI / 360);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.uniformMatrix4fv(uniform("view"), false, view);
    gl.uniform2f(uniform("focal"), focal, focal);
    gl.uniform2f(uniform("size"), canvas.width, canvas.height);
    gl.clearColor(...state.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    $("frame").value = state.frame;
    $("time").textContent = (state.frame / scene.fps).toFixed(2) + " s";
  };

  let dirty = true, playing = true, began = 0;
  const change = (values) => { Object.assign(state, values); dirty = true; };
  const fit = () => {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    dirty = true;
  };
  let given = null;  // a motion that the page was not made with: {frames, fps}
  const play = (on) => {
    playing = on;
    if (on) driven = !!given;
    began = performance.now() - (given ? 0 : 1000 * state.frame / scene.fps);
    $("play").textContent = on ? "Pause" : "Play";
  };
  const show = (pose) => {
    face.weights.fill(0);
    face.set(pose);
    const degrees = (name) => (Number(pose[name]) || 0) * 180 / Math.PI;  // Live Link's radians; its pitch is down
    face.pose({ yaw: degrees("headYaw"), pitch: -degrees("headPitch"), roll: -degrees("headRoll") });
    dirty = true;
  };
  const tick = (now) => {
    if (playing && given) {
      show(given.frames[Math.floor(Math.max(0, now - began) / 1000 * given.fps) % given.frames.length]);
    } else if (playing) {
      const frame = Math.floor(Math.max(0, now - began) / 1000 * scene.fps) % scene.frames;
      if (frame !== state.frame) change({ frame });
    }
    if (dirty) { dirty = false; draw(); }
    requestAnimationFrame(tick);
  };

  $("frame").max = scene.frames - 1;
  $("frame").addEventListener("input", () => { play(false); driven = false; change({ frame: Number($("frame").value) }); });
  $("play").addEventListener("click", () => play(!playing));
  $("front").addEventListener("click", () => change({ yaw: 0, pitch: 0, zoom: 1, shift: [0, 0, 0] }));
  $("shade").addEventListener("click", () => {
    const levels = [1, 0.5, 0], next = levels[(levels.indexOf(state.background[0]) + 1) % 3];
    change({ background: [next, next, next] });
  });
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    if (event.buttons & 2 || event.shiftKey) {
      const metres = 2 * scene.distance * state.zoom * Math.tan(scene.fov * Math.PI / 360) / canvas.clientHeight;
      const a = state.yaw * Math.PI / 180, along = -event.movementX * metres;
      const [x, y, z] = state.shift;
      change({ shift: [x + along * Math.cos(a), y + event.movementY * metres, z - along * Math.sin(a)] });
      return;
    }
    const pitch = Math.max(-85, Math.min(85, state.pitch + 0.3 * event.movementY));
    change({ yaw: state.yaw - 0.3 * event.movementX, pitch });
  });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    change({ zoom: Math.max(0.1, Math.min(5, state.zoom * Math.exp(0.001 * event.deltaY))) });
  }, { passive: false });
  window.addEventListener("resize", fit);
  for (const [name, value] of Object.entries(scene.provenance)) {
    const term = document.createElement("dt"), text = document.createElement("dd");
    term.textContent = name;
    text.textContent = value;
    $("about").append(term, text);
  }
  fit();
  say("");
  play(true);
  const drive = () => { if (playing) play(false); driven = true; dirty = true; };
  let stopListening = null;
  // For scripts: docs/page.md says how.
  window.avatar = {
    names: face.names,
    get driven() { return driven; },
    level: (name) => face.weights[face.names.indexOf(name)],
    set: (values) => { drive(); return face.set(values); },
    pose: (values) => { drive(); face.pose(values); },
    motion: (text) => { given = motionFrames(text); driven = true; show(given.frames[0]); play(true); },
    listen: async () => {
      if (stopListening) return;
      stopListening = await microphoneLevel((level) => avatar.set({ jawOpen: 0.45 * level, mouthLowerDown: 0.3 * level }));
    },
    quiet: () => { if (stopListening) stopListening(); stopListening = null; },
    // One still picture of width x height pixels; a frame of the page's own motion ends driving.
    show: (width, height, values = {}) => {
      play(false);
      if ("frame" in values) driven = false;
      canvas.width = width;
      canvas.height = height;
      Object.assign(state, values);
      draw();
      return canvas.toDataURL("image/png");
    },
    state,
  };
  window.addEventListener("message", ({ data: told }) => {
    if (!told || told.type !== "avatar") return;
    if (told.set && typeof told.set === "object") avatar.set(told.set);
    if (told.pose && typeof told.pose === "object") avatar.pose(told.pose);
  });
  const complain = (name) => (error) => say(`${name}: ${error.message || error}`);
  const wanted = new URLSearchParams(location.search).get("motion");
  if (wanted && location.protocol === "file:") complain(wanted)("open the page from a web server, or drop the file on it");
  else if (wanted) {
    fetch(wanted).then((answer) => {
      if (!answer.ok) throw new Error(`${answer.status} ${answer.statusText}`);
      return answer.text();
    }).then(avatar.motion).catch(complain(wanted));
  }
  window.addEventListener("dragover", (event) => event.preventDefault());
  window.addEventListener("drop", (event) => {
    event.preventDefault();
    const [file] = event.dataTransfer.files;
    if (file) file.text().then(avatar.motion).then(() => say("")).catch(complain(file.name));
  });
  $("listen").addEventListener("click", () => {
    if (stopListening) avatar.quiet(); else avatar.listen().catch(complain("microphone"));
  });
  requestAnimationFrame(tick);
})().catch((error) => { document.getElementById("message").textContent = String(error); throw error; });
