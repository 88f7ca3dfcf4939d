"use strict";
// A face that is not played but driven: actions are added up, and the head is turned at the neck.
const drivenFace = (scene, data) => {
  const { driveStart, driveVertex, driveValue, driveStep, driveRest, neckWeight } = data;
  const weights = new Float32Array(scene.actions.length), place = new Map(scene.actions.map((name, i) => [name, i]));
  const angles = { yaw: 0, pitch: 0, roll: 0 };
  const limited = (value, low, high) => (Number.isFinite(Number(value)) ? Math.max(low, Math.min(high, Number(value))) : 0);

  // A name without Left or Right moves both sides; returns the names that the head does not have.
  const set = (values) => Object.entries(values).filter(([name, value]) => {
    const sides = [name, `${name}Left`, `${name}Right`].filter((side) => place.has(side));
    for (const side of sides) weights[place.get(side)] = limited(value, 0, 1);
    return !sides.length;
  }).map(([name]) => name);

  // Degrees: yaw to the subject's left, pitch up, roll to the subject's left shoulder.
  const pose = (values) => {
    for (const name of Object.keys(angles)) if (name in values) angles[name] = limited(values[name], -60, 60);
  };

  const times = ([w, x, y, z], [a, b, c, d]) => [
    w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c, w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a,
  ];
  const about = (axis, degrees) => {
    const half = degrees * Math.PI / 360, quat = [Math.cos(half), 0, 0, 0];
    quat[axis] = Math.sin(half);
    return quat;
  };

  // Position, growth and rotation (wxyz) of each vertex.
  const fill = (out) => {
    out.set(driveRest);
    weights.forEach((weight, action) => {
      if (!weight) return;
      const gain = Array.from(driveStep.subarray(8 * action, 8 * action + 8), (step) => step * weight);
      for (let k = driveStart[action]; k < driveStart[action + 1]; k++) {
        const to = 8 * driveVertex[k], from = 8 * k;
        for (let c = 0; c < 8; c++) out[to + c] += gain[c] * driveValue[from + c];
      }
    });
    const [w, x, y, z] = times(times(about(2, angles.yaw), about(1, -angles.pitch)), about(3, -angles.roll));
    const [jx, jy, jz] = scene.neck;
    for (let v = 0; v < scene.vertices; v++) {
      const i = 8 * v, share = neckWeight[v] / 255;
      const px = out[i] - jx, py = out[i + 1] - jy, pz = out[i + 2] - jz;
      const tx = 2 * (y * pz - z * py), ty = 2 * (z * px - x * pz), tz = 2 * (x * py - y * px);
      out[i] += share * (w * tx + y * tz - z * ty);
      out[i + 1] += share * (w * ty + z * tx - x * tz);
      out[i + 2] += share * (w * tz + x * ty - y * tx);
      const turned = times([1 - share + share * w, share * x, share * y, share * z], out.subarray(i + 4, i + 8));
      const length = Math.hypot(...turned);
      for (let c = 0; c < 4; c++) out[i + 4 + c] = turned[c] / length;
    }
  };
  return { set, pose, fill, weights, names: scene.actions };
};

// Frames of named activations from a JSON text: one pose, a list, {fps, frames}, or {fps, names, frames: [[...], ...]}.
const motionFrames = (text) => {
  const found = JSON.parse(text);
  const list = Array.isArray(found) ? found : Array.isArray(found.frames) ? found.frames : [found];
  const named = (values) => Object.fromEntries(values.map((value, i) => [found.names[i], value]));
  const frames = list.map((pose) => (Array.isArray(pose) ? named(pose) : pose.blendShapes || pose.weights || pose));
  if (!frames.length || !frames.every((pose) => pose && typeof pose === "object")) throw new Error("holds no frames");
  const fps = Number(found.fps);
  return { frames, fps: fps > 0 && fps <= 240 ? fps : 60 };
};

// Loudness of the microphone in [0, 1], given to a function before each picture; returns what stops it.
const microphoneLevel = async (use) => {
  const stream = await navigator.mediaDevices.getUserMedia({ audio: true });
  const context = new AudioContext(), analyser = context.createAnalyser();
  context.createMediaStreamSource(stream).connect(analyser);
  const samples = new Float32Array(analyser.fftSize);
  let level = 0, on = true;
  const listen = () => {
    if (!on) return;
    analyser.getFloatTimeDomainData(samples);
    const loud = Math.sqrt(samples.reduce((sum, s) => sum + s * s, 0) / samples.length);
    const now = Math.max(0, Math.min(1, 1 + Math.log10(Math.max(loud, 1e-6) / 0.1) / 1.5));  // 30 dB below loud speech is 0
    level += (now - level) * (now > level ? 0.6 : 0.25);
    use(level);
    requestAnimationFrame(listen);
  };
  listen();
  return () => {
    on = false;
    stream.getTracks().forEach((track) => track.stop());
    context.close();
    use(0);
  };
};
