"use strict";
// Plays the episodes of a page: every <figure class="replay"> holds its data as JSON (see render/page.py).
// Bodies are drawn by a rasteriser with a depth buffer, written out below: no WebGL, no library, no network.

// ------------------------------------------------------------------------------------------------ the player

function mount(figure) {
  const data = JSON.parse(figure.querySelector("script").textContent);
  const last = data.reward.length - 1;
  const view = element("canvas", { className: "view", tabIndex: 0, role: "img", ariaLabel: data.title });
  const strip = element("canvas", { className: "strip", role: "img", ariaLabel: "reward and cost of each step" });
  const play = element("button", { type: "button" });
  const seek = element("input", { type: "range", min: 0, max: last, value: 0, step: 1, ariaLabel: "control step" });
  const speed = element("select", { ariaLabel: "speed" });
  for (const s of [0.25, 0.5, 1, 2, 4, 8]) speed.add(new Option(s + "x", s, s === 1, s === 1));
  const status = element("output", {});
  const bar = element("div", { className: "bar" });
  bar.append(play, seek, speed);
  figure.append(view, strip, bar, status);

  const paint = { scene: sceneView, map: mapView, plain: plainView }[data.kind](view, data, redraw);
  let t = 0, playing = false, before = 0, queued = false;

  function redraw() {
    if (!queued) requestAnimationFrame(frame);
    queued = true;
  }

  function frame(now) {
    queued = false;
    if (playing) {
      t += Math.min(0.1, Math.max(0, now - before) / 1000) * data.rate * Number(speed.value);
      before = now;
      if (t >= last) { t = last; setPlaying(false); }
      redraw();
    }
    const moment = Math.round(t);
    paint(t, playing);
    drawStrip(strip, data, moment);
    seek.value = moment;
    view.classList.toggle("costs", data.cost[moment] > 0);
    status.textContent = `step ${data.step[moment]} of ${data.step[last]} · reward ${data.reward_sum[moment].toFixed(1)} · ` +
      `cost ${round(data.cost_sum[moment])} (limit ${data.limit})` + (data.cost[moment] > 0 ? " · costs now" : "");
    status.classList.toggle("costs", data.cost[moment] > 0);
    figure.dataset.drawn = moment;
  }

  function setPlaying(on) {
    playing = on && last > 0;
    if (playing && t >= last) t = 0;
    before = performance.now();
    play.textContent = playing ? "❚❚" : "▶";
    play.ariaLabel = playing ? "pause" : "play";
    redraw();
  }

  function goTo(moment) {
    t = Math.max(0, Math.min(last, moment));
    redraw();
  }

  play.onclick = () => setPlaying(!playing);
  seek.oninput = () => { setPlaying(false); goTo(Number(seek.value)); };
  view.onkeydown = (event) => {
    const jump = { ArrowLeft: -1, ArrowRight: 1, PageUp: -20, PageDown: 20 }[event.key];
    if (event.key === " ") setPlaying(!playing);
    else if (jump) { setPlaying(false); goTo(Math.round(t) + jump); }
    else return;
    event.preventDefault();
  };
  const scrub = (event) => {
    if (!event.buttons) return;
    const box = strip.getBoundingClientRect();
    setPlaying(false);
    goTo(Math.round((event.clientX - box.left) / box.width * last));
  };
  strip.onpointerdown = strip.onpointermove = scrub;
  new ResizeObserver(redraw).observe(figure);
  matchMedia("(prefers-color-scheme: dark)").onchange = redraw;
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches || figure.dataset.play === "no";
  setPlaying(!calm);
}

function element(name, properties) {
  return Object.assign(document.createElement(name), properties);
}

function round(x) {
  return String(Math.round(x * 100) / 100);
}

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
}

// A canvas as large as it is shown, in sharp pixels, cleared, with CSS pixels as the unit of drawing.
function fresh(canvas) {
  const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  pen.font = "12px system-ui, sans-serif";
  return [pen, width, height];
}

// Two lanes, each with its name above it: the reward of each step as a curve, its cost as bars.
function drawStrip(canvas, data, moment) {
  const [pen, width, height] = fresh(canvas);
  const last = Math.max(1, data.reward.length - 1), x = (t) => t / last * width;
  const lane = height / 2, name = 16;
  pen.fillStyle = colour("grid");
  pen.fillRect(0, lane + name, width, lane - name);
  curve(pen, data.reward.slice(1), (t) => x(t + 1), name + 3, lane - 4, colour("accent"));
  pen.fillStyle = colour("danger");
  const largest = Math.max(...data.cost, 1e-9);
  data.cost.forEach((cost, t) => {
    const tall = (lane - name) * (cost > 0 ? 0.3 + 0.7 * cost / largest : 0);
    pen.fillRect(x(t - 0.5), height - tall, Math.max(1.5, x(1) + 0.5), tall);
  });
  pen.fillStyle = colour("quiet");
  pen.fillText("reward of a step", 0, name - 4);
  pen.fillText("cost of a step", 0, lane + name - 4);
  pen.fillStyle = colour("ink");
  pen.fillRect(x(moment) - 1, name, 2, lane - name);
  pen.fillRect(x(moment) - 1, lane + name, 2, lane - name);
}

// The curve of `values` between the heights `top` and `bottom`.
function curve(pen, values, x, top, bottom, stroke) {
  const low = Math.min(...values), high = Math.max(...values), span = high - low || 1;
  const y = (value) => bottom - (value - low) / span * (bottom - top);
  pen.strokeStyle = stroke;
  pen.lineWidth = 1.25;
  pen.beginPath();
  values.forEach((value, t) => pen.lineTo(x(t), y(value)));
  pen.stroke();
}

function unpackArray(text, type) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return type === "u1" ? bytes : new Float32Array(bytes.buffer);
}

// ------------------------------------------------------------------------------------------------ a task without a picture


function plainView(canvas, data) {
  const panels = data.panels, last = Math.max(1, data.reward.length - 1);
  return (t) => {
    const columns = canvas.clientWidth > 560 ? 2 : 1, high = 84;
    canvas.style.aspectRatio = "auto";
    canvas.style.height = `${Math.ceil(panels.length / columns) * high}px`;
    const [pen, width] = fresh(canvas), wide = width / columns, moment = Math.round(t);
    panels.forEach(({ name, lines }, i) => {
      const left = (i % columns) * wide, top = Math.floor(i / columns) * high;
      const x = (k) => left + 10 + k / last * (wide - 24);
      const all = lines.flat(), least = Math.min(...all), span = Math.max(...all) - least || 1;
      const y = (value) => top + high - 8 - (value - least) / span * (high - 34);
      pen.fillStyle = colour("ink");
      const now = lines.map((line) => line[moment].toPrecision(3)).join("  ");
      pen.fillText(`${name}  ${lines.length > 4 ? "" : now}`, left + 10, top + 16, wide - 20);
      lines.forEach((line, k) => {
        pen.strokeStyle = lines.length > 1 ? LINES[k % LINES.length] : colour("accent");
        pen.lineWidth = 1.25;
        pen.beginPath();
        line.forEach((value, step) => pen.lineTo(x(step), y(value)));
        pen.stroke();
        pen.fillStyle = data.cost[moment] > 0 ? colour("danger") : colour("ink");
        pen.beginPath();
        pen.arc(x(moment), y(line[moment]), 3.5, 0, 7);
        pen.fill();
      });
    });
  };
}

// ------------------------------------------------------------------------------------------------ a map of a network

function mapView(canvas, data) {
  const map = data.map, n = map.x.length, values = unpackArray(map.values, "f4");
  const [low, high] = map.band, middle = (low + high) / 2;
  const agents = new Set(map.agents);
  return (t) => {
    const [pen, width, height] = fresh(canvas);
    const moment = Math.round(t), v = values.subarray(moment * n, moment * n + n);
    const x = (i) => 18 + map.x[i] * (width - 36), y = (i) => 20 + map.y[i] * (height - 84);
    const size = Math.max(2.5, Math.min(8, width / 60, width / Math.sqrt(n) / 10));
    pen.lineCap = "round";
    for (const [a, b] of map.links) {
      pen.strokeStyle = bandColour((v[a] + v[b]) / 2);
      pen.lineWidth = size * 0.5;
      pen.beginPath();
      pen.moveTo(x(a), y(a));
      pen.lineTo(x(a), y(b));
      pen.lineTo(x(b), y(b));
      pen.stroke();
    }
    for (let i = 0; i < n; i++) {
      const out = v[i] < low || v[i] > high;
      pen.fillStyle = bandColour(v[i]);
      pen.strokeStyle = out ? colour("ink") : colour("paper");
      pen.lineWidth = out ? Math.max(1, size / 3) : 1;
      pen.beginPath();
      if (agents.has(i)) pen.rect(x(i) - size * 1.2, y(i) - size * 1.2, size * 2.4, size * 2.4);
      else pen.arc(x(i), y(i), out ? size * 1.25 : size, 0, 7);
      pen.fill();
      pen.stroke();
    }
    legend(pen, width, height, v);
  };

  // Blue below the middle of the band, red above it; full strength begins where the band ends.
  function bandColour(value) {
    const off = (value - middle) / (high - middle), end = off < 0 ? [33, 102, 172] : [190, 40, 45];
    const strength = Math.abs(off) > 1 ? Math.min(1, 0.8 + 0.2 * (Math.abs(off) - 1)) : 0.55 * Math.abs(off);
    return `rgb(${[205, 205, 200].map((c, k) => Math.round(c + (end[k] - c) * strength))})`;
  }

  function legend(pen, width, height, v) {
    const wide = Math.min(260, width - 100), reach = 2 * (high - middle), top = height - 34;
    for (let k = 0; k < wide; k++) {
      pen.fillStyle = bandColour(middle - reach + 2 * reach * k / wide);
      pen.fillRect(18 + k, top, 1.5, 10);
    }
    pen.fillStyle = colour("quiet");
    pen.textAlign = "center";
    for (const mark of [low, middle, high]) {
      pen.fillText(mark.toFixed(2), 18 + wide * (mark - middle + reach) / (2 * reach), top + 24);
    }
    pen.textAlign = "left";
    pen.fillText(`now ${Math.min(...v).toFixed(3)} to ${Math.max(...v).toFixed(3)} ${map.unit}`, 18, top - 8);
    pen.fillText("■ agent", 30 + wide, top + 10);
  }
}

// ------------------------------------------------------------------------------------------------ bodies in space

const LIGHT = unit([0.25, -0.35, 1]); // where light comes from
const SKY = [232, 238, 243], ZENITH = [178, 200, 218], FLOOR = [226, 229, 231];
const PIXELS = 1.2e6, LEAST_PIXELS = 1.5e5, SLOW = 28; // of a picture; milliseconds for one

function sceneView(canvas, data, redraw) {
  const scene = data.scene, kinds = scene.kinds;
  const pose = unpack(scene.pose, "f4"), size = unpack(scene.size, "f4"), rgba = unpack(scene.rgba, "u1");
  const centre = unpackArray(scene.centre, "f4");
  const view = orbit(canvas, scene.eye, redraw);
  const raster = new Raster(canvas.getContext("2d"));
  let budget = PIXELS, average = 0;

  return (t, moving) => {
    const begin = performance.now(), most = moving ? budget : PIXELS;
    const ratio = canvas.clientWidth / Math.max(1, canvas.clientHeight);
    const sharp = canvas.clientWidth * canvas.clientHeight * Math.max(2, devicePixelRatio || 1) ** 2;
    const height = Math.max(2, Math.round(Math.sqrt(Math.min(most, sharp) / ratio)));
    raster.begin(Math.round(height * ratio), height, view.camera(at(centre, t), scene.fovy));
    drawGeoms(t);
    raster.end();
    if (!moving) return;
    average = 0.8 * average + 0.2 * (performance.now() - begin);
    if (average > SLOW && budget > LEAST_PIXELS) { budget *= 0.7; average = 0; }
  };

  function drawGeoms(t) {
    const moment = Math.round(t);
    const geoms = kinds.map((kind, g) => ({
      kind, place: between(pose, g, t), size: row(size, g, moment), rgba: row(rgba, g, moment),
    })).filter((geom) => geom.rgba[3] > 0);
    const floors = geoms.filter((geom) => geom.kind === "plane");
    const bodies = geoms.filter((geom) => geom.kind !== "plane").sort((a, b) => b.rgba[3] - a.rgba[3]);
    for (const floor of floors) raster.plane(floor.place, floor.rgba);
    if (floors.length) {
      for (const body of bodies) if (body.rgba[3] > 250) raster.shadow(body, floors[0].place[2]);
    }
    for (const body of bodies) raster.body(body);
  }
}

function unpack(packed, type) {
  const slot = new Map(packed.moving.map((g, k) => [g, k]));
  return {
    width: packed.width, slot, moving: packed.moving.length,
    first: unpackArray(packed.first, type), frames: unpackArray(packed.frames, type),
  };
}

// The values of geom `g` at a whole moment.
function row(table, g, moment) {
  const w = table.width, k = table.slot.get(g);
  if (k === undefined) return table.first.subarray(g * w, g * w + w);
  const begin = (moment * table.moving + k) * w;
  return table.frames.subarray(begin, begin + w);
}

// Position and quaternion of geom `g` between two moments.
function between(table, g, t) {
  const now = row(table, g, Math.floor(t));
  if (t === Math.floor(t) || !table.slot.has(g)) return now;
  const next = row(table, g, Math.floor(t) + 1), share = t - Math.floor(t);
  const turn = now[3] * next[3] + now[4] * next[4] + now[5] * next[5] + now[6] * next[6] < 0 ? -1 : 1;
  return now.map((x, k) => x + share * ((k < 3 ? 1 : turn) * next[k] - x));
}

function at(points, t) {
  const k = 3 * Math.floor(t), share = t - Math.floor(t), next = Math.min(k + 3, points.length - 3);
  return [0, 1, 2].map((i) => points[k + i] + share * (points[next + i] - points[k + i]));
}

// The view that drags, wheel and pinch turn and bring closer; a double click brings the first one back.
function orbit(canvas, eye, redraw) {
  const distance = Math.hypot(...eye);
  const home = { turn: Math.atan2(eye[1], eye[0]), tilt: Math.asin(eye[2] / distance), distance };
  const state = { ...home }, fingers = new Map();
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, event);
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => fingers.delete(event.pointerId);
  canvas.onpointermove = (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    if (fingers.size === 1) {
      state.turn -= (event.clientX - before.clientX) * 0.008;
      state.tilt = clamp(state.tilt + (event.clientY - before.clientY) * 0.008, 0.05, 1.55);
    } else {
      const other = [...fingers.entries()].find(([id]) => id !== event.pointerId)[1];
      const apart = (a) => Math.hypot(a.clientX - other.clientX, a.clientY - other.clientY) || 1;
      zoom(apart(before) / apart(event));
    }
    fingers.set(event.pointerId, event);
    redraw();
  };
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return; // a page is scrolled past, a chosen view zooms
    event.preventDefault();
    zoom(Math.exp(event.deltaY * 0.001));
  }, { passive: false });
  canvas.ondblclick = () => { Object.assign(state, home); redraw(); };

  function zoom(factor) {
    state.distance = clamp(state.distance * factor, home.distance / 8, home.distance * 8);
    redraw();
  }

  return {
    camera(target, fovy) {
      const { turn, tilt, distance } = state;
      const back = [Math.cos(tilt) * Math.cos(turn), Math.cos(tilt) * Math.sin(turn), Math.sin(tilt)];
      const right = [-Math.sin(turn), Math.cos(turn), 0];
      const forward = back.map((x) => -x), up = cross(right, forward);
      return { eye: target.map((c, i) => c + distance * back[i]), right, up, forward, fovy, distance };
    },
  };
}

// Scan conversion with a depth buffer of inverse distances, which are affine on the screen.
class Raster {
  constructor(pen) {
    this.pen = pen;
    this.meshes = { fine: meshes(20, 10), coarse: meshes(12, 6) };
  }

  begin(width, height, camera) {
    if (!this.image || this.width !== width || this.height !== height) {
      Object.assign(this, { width, height });
      Object.assign(this.pen.canvas, { width, height });
      this.image = this.pen.createImageData(width, height);
      this.pixels = new Uint32Array(this.image.data.buffer);
      this.depth = new Float32Array(width * height);
      this.shaded = new Uint8Array(width * height);
    }
    this.camera = camera;
    this.focus = height / 2 / Math.tan(camera.fovy * Math.PI / 360);
    this.haze = 4 * camera.distance; // where it begins
    this.near = 0.02 * camera.distance;
    this.depth.fill(0);
    this.shaded.fill(0);
    for (let y = 0; y < height; y++) {
      const share = clamp(1 - (y / height) * 1.5, 0, 1);
      this.pixels.fill(rgb(...SKY.map((c, k) => c + (ZENITH[k] - c) * share)), y * width, (y + 1) * width);
    }
  }

  end() {
    this.pen.putImageData(this.image, 0, 0);
  }

  // An endless checkered plane; its squares fade into the distance.
  plane(place, rgba) {
    const { eye, right, up, forward, distance } = this.camera;
    const [xAxis, yAxis, normal] = axes(place), offset = sub(place, eye), height = dot(normal, offset);
    if (height >= 0) return; // seen from below
    const side = 2 ** Math.round(Math.log2(distance / 4)), tone = FLOOR.map((c, k) => c * rgba[k] / 255);
    const along = (axis) => [dot(axis, right) / this.focus, -dot(axis, up) / this.focus, dot(axis, forward)];
    const [n, a, b] = [normal, xAxis, yAxis].map(along), a0 = -dot(xAxis, offset), b0 = -dot(yAxis, offset);
    for (let y = 0; y < this.height; y++) {
      const v = y + 0.5 - this.height / 2;
      for (let x = 0, i = y * this.width; x < this.width; x++, i++) {
        const u = x + 0.5 - this.width / 2, inverse = (n[0] * u + n[1] * v + n[2]) / height;
        if (inverse <= this.depth[i]) continue;
        const z = 1 / inverse;
        const p = a0 + z * (a[0] * u + a[1] * v + a[2]), q = b0 + z * (b[0] * u + b[1] * v + b[2]);
        const odd = (Math.floor(p / side) + Math.floor(q / side)) & 1;
        const contrast = Math.max(0, 1 - z / (2.5 * this.haze)) * (odd ? -9 : 5);
        this.depth[i] = inverse;
        this.pixels[i] = this.hazy(tone[0] + contrast, tone[1] + contrast, tone[2] + contrast, inverse);
      }
    }
  }

  hazy(r, g, b, inverse) {
    const seen = Math.min(1, inverse * this.haze);
    return rgb(SKY[0] + (r - SKY[0]) * seen, SKY[1] + (g - SKY[1]) * seen, SKY[2] + (b - SKY[2]) * seen);
  }

  // The shadow that a body throws on a level floor.
  shadow(body, level) {
    const low = level + 1e-4;
    this.triangles(body, (p) => {
      const fall = (p[2] - low) / LIGHT[2];
      return [p[0] - fall * LIGHT[0], p[1] - fall * LIGHT[1], low];
    }, (i) => {
      if (this.shaded[i]) return;
      this.shaded[i] = 1;
      const c = this.pixels[i];
      this.pixels[i] = rgb((c & 255) * 0.8, (c >> 8 & 255) * 0.8, (c >> 16 & 255) * 0.81);
    }, false);
  }

  body(body) {
    const [r, g, b] = body.rgba, alpha = body.rgba[3] / 255, { pixels, depth } = this;
    this.triangles(body, (p) => p, alpha > 0.98
      ? (i, inverse, light) => {
        if (inverse <= depth[i]) return;
        depth[i] = inverse;
        pixels[i] = this.hazy(r * light, g * light, b * light, inverse);
      }
      : (i, inverse, light) => {
        if (inverse <= depth[i]) return;
        if (alpha > 0.5) depth[i] = inverse;
        const under = pixels[i], over = this.hazy(r * light, g * light, b * light, inverse);
        const mix = (shift) => (under >> shift & 255) * (1 - alpha) + (over >> shift & 255) * alpha;
        pixels[i] = rgb(mix(0), mix(8), mix(16));
      }, true);
  }

  // Calls `shade(pixel, inverse distance, light)` for each pixel of a body whose points are moved by `move`.
  triangles(body, move, shade, cull) {
    const { eye, right, up, forward } = this.camera, [xAxis, yAxis, zAxis] = axes(body.place);
    const size = body.size, capsule = body.kind === "capsule", scale = [size[0], size[1], capsule ? size[0] : size[2]];
    const far = dot(sub(body.place, eye), forward);
    const detail = this.focus * size[0] > 14 * Math.max(far, this.near) ? "fine" : "coarse";
    const mesh = this.meshes[detail][body.kind];
    const lamp = [dot(LIGHT, xAxis), dot(LIGHT, yAxis), dot(LIGHT, zAxis)], top = [xAxis[2], yAxis[2], zAxis[2]];
    const points = mesh.points.map(([ux, uy, uz, nx, ny, nz, cap]) => {
      const x = ux * scale[0], y = uy * scale[1], z = uz * scale[2] + cap * size[2];
      const p = move([0, 1, 2].map((k) => body.place[k] + x * xAxis[k] + y * yAxis[k] + z * zAxis[k]));
      const d = sub(p, eye), n = unit([nx / scale[0], ny / scale[1], nz / scale[2]]);
      const light = 0.58 + 0.37 * Math.max(0, dot(n, lamp)) + 0.1 * dot(n, top);
      return [dot(d, right), dot(d, up), dot(d, forward), light];
    });
    for (const [a, b, c] of mesh.faces) this.clip([points[a], points[b], points[c]], shade, cull);
  }

  // Cuts off what lies behind the eye, then draws the one or two triangles that are left.
  clip(corners, shade, cull) {
    const kept = [];
    for (let k = 0; k < 3; k++) {
      const a = corners[k], b = corners[(k + 1) % 3], share = (this.near - a[2]) / (b[2] - a[2]);
      if (a[2] >= this.near) kept.push(a);
      if ((a[2] >= this.near) !== (b[2] >= this.near)) kept.push(a.map((x, i) => x + share * (b[i] - x)));
    }
    const shown = kept.map(([x, y, z, light]) =>
      [this.width / 2 + this.focus * x / z, this.height / 2 - this.focus * y / z, 1 / z, light]);
    for (let k = 2; k < shown.length; k++) this.fill(shown[0], shown[k - 1], shown[k], shade, cull);
  }

  fill(a, b, c, shade, cull) {
    const bx = b[0] - a[0], by = b[1] - a[1], cx = c[0] - a[0], cy = c[1] - a[1], area = bx * cy - cx * by;
    if (cull ? area >= 0 : area === 0) return; // outward faces turn clockwise on a screen whose y points down
    const slope = (k) => [
      ((b[k] - a[k]) * cy - (c[k] - a[k]) * by) / area,
      ((c[k] - a[k]) * bx - (b[k] - a[k]) * cx) / area,
    ];
    const [depthX, depthY] = slope(2), [lightX, lightY] = slope(3), edges = [[a, b], [b, c], [c, a]];
    const first = Math.max(0, Math.ceil(Math.min(a[1], b[1], c[1]) - 0.5));
    const end = Math.min(this.height, Math.ceil(Math.max(a[1], b[1], c[1]) - 0.5));
    for (let y = first; y < end; y++) {
      const v = y + 0.5;
      let left = Infinity, right = -Infinity;
      for (const [p, q] of edges) {
        if ((p[1] <= v) === (q[1] <= v)) continue;
        const x = p[0] + (v - p[1]) * (q[0] - p[0]) / (q[1] - p[1]);
        if (x < left) left = x;
        if (x > right) right = x;
      }
      const from = Math.max(0, Math.ceil(left - 0.5)), to = Math.min(this.width, Math.ceil(right - 0.5));
      let inverse = a[2] + (from + 0.5 - a[0]) * depthX + (v - a[1]) * depthY;
      let light = a[3] + (from + 0.5 - a[0]) * lightX + (v - a[1]) * lightY;
      for (let i = y * this.width + from; i < y * this.width + to; i++) {
        shade(i, inverse, light);
        inverse += depthX;
        light += lightX;
      }
    }
  }
}

// Bodies of size 1: points [x, y, z, normal (3), end of a capsule that the point belongs to], faces seen from outside.
function meshes(around, along) {
  const turn = (j) => [Math.cos(2 * Math.PI * j / around), Math.sin(2 * Math.PI * j / around)];
  const ball = [], tube = [];
  for (let i = 0; i <= along; i++) {
    const high = -Math.cos(Math.PI * i / along), wide = Math.sin(Math.PI * i / along);
    ball.push(turnAll((c, s) => [wide * c, wide * s, high, wide * c, wide * s, high, 0]));
  }
  for (const [wide, high, out, lift] of [[0, -1, 0, -1], [1, -1, 0, -1], [1, -1, 1, 0], [1, 1, 1, 0], [1, 1, 0, 1], [0, 1, 0, 1]]) {
    tube.push(turnAll((c, s) => [wide * c, wide * s, high, out * c, out * s, lift, 0]));
  }
  const half = along / 2, end = (ring, cap) => ring.map((p) => [...p.slice(0, 6), cap]);
  const capsule = [...ball.slice(0, half + 1).map((r) => end(r, -1)), ...ball.slice(half).map((r) => end(r, 1))];
  return { ellipsoid: rings(ball), capsule: rings(capsule), cylinder: rings(tube), box: boxMesh() };

  function turnAll(point) {
    return Array.from({ length: around }, (_, j) => point(...turn(j)));
  }

  function rings(list) {
    const faces = [];
    for (let i = 0; i + 1 < list.length; i++) {
      for (let j = 0; j < around; j++) {
        const a = i * around + j, b = i * around + (j + 1) % around;
        faces.push([a, b, b + around], [a, b + around, a + around]);
      }
    }
    return { points: list.flat(), faces };
  }
}

function boxMesh() {
  const points = [], faces = [];
  for (const axis of [0, 1, 2]) {
    for (const sign of [-1, 1]) {
      const base = points.length;
      for (const [u, v] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
        const p = [0, 0, 0], n = [0, 0, 0];
        p[axis] = n[axis] = sign;
        p[(axis + 1) % 3] = u * sign;
        p[(axis + 2) % 3] = v;
        points.push([...p, ...n, 0]);
      }
      faces.push([base, base + 1, base + 2], [base, base + 2, base + 3]);
    }
  }
  return { points, faces };
}

// The three axes of a body from its place [position, quaternion with w first].
function axes(place) {
  const [w, x, y, z] = unit(Array.from(place.slice(3, 7)));
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
}

function rgb(r, g, b) {
  const byte = (x) => (x < 0 ? 0 : x > 255 ? 255 : x | 0);
  return (255 << 24 | byte(b) << 16 | byte(g) << 8 | byte(r)) >>> 0;
}

function dot(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

function sub(a, b) {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function unit(a) {
  const length = Math.hypot(...a) || 1;
  return a.map((x) => x / length);
}

function clamp(x, low, high) {
  return Math.max(low, Math.min(high, x));
}

for (const figure of document.querySelectorAll(".replay")) mount(figure);
