/*
 * Draws the scenes of a report. Nothing is loaded: each element of class "scene" holds its scene as JSON (scene.py) and a
 * still picture, which stays where a browser cannot draw. scene_surface.js stands before this file.
 */

const USED = [0.16, 0.5, 0.85], LEFT_OUT = [0.6, 0.6, 0.6], CHOSEN = [1.0, 0.62, 0.1], PATH = [0.16, 0.5, 0.85];
const OUTSIDE = 0.36; /* tangent of half of what is seen from outside, downwards */

/* Elements of the page. */

function element(name, attributes, ...inside) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made[key] = value;
  made.append(...inside);
  return made;
}

function choice(words, attributes) {
  const input = element("input", attributes);
  return [input, element("label", {}, input, ` ${words}`)];
}

function group(title, ...inside) {
  return element("fieldset", {}, element("legend", { textContent: title }), ...inside);
}

class Viewer {
  constructor(root, told, number) {
    this.root = root;
    this.told = told;
    this.pictures = new Map(told.pictures.map((picture) => [picture.name, picture]));
    this.canvas = element("canvas", { tabIndex: 0 });
    this.canvas.setAttribute("role", "application");
    this.canvas.setAttribute("aria-label", "The surface in three dimensions. Arrow keys turn it, plus and minus come " +
      "nearer and go away, Home goes back to the first view.");
    const gl = this.gl = this.canvas.getContext("webgl2", { antialias: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    this.mesh = program(gl, MESH);
    this.plain = program(gl, PLAIN);
    this.surfaces = [];
    this.layerName = `scene-layer-${number}`;
    this.build();
    this.choose(0);
    this.listen();
  }

  build() {
    this.surface = element("select", {});
    this.told.surfaces.forEach((s, i) => this.surface.append(element("option", { value: i, textContent: s.title })));
    this.layers = group("Colour");
    this.shown = group("Shown");
    this.legend = element("div", { className: "scene-legend" });
    this.note = element("p", { className: "scene-note" });
    this.ride = element("input", { type: "range", min: 0, step: 0.05, value: 0 });
    this.back = element("button", { type: "button", textContent: "From outside", disabled: true });
    this.keyframe = element("select", {});
    this.picture = element("figure", { className: "scene-picture", hidden: true });
    this.picture.setAttribute("aria-live", "polite");
    const which = element("label", { className: "scene-which", hidden: this.told.surfaces.length < 2 }, "Surface ", this.surface);
    this.path = group("Path", element("label", {}, "Ride inside ", this.ride), this.back,
      element("label", {}, "Keyframe ", this.keyframe));
    this.root.append(
      element("p", { className: "scene-how", textContent: "Drag to turn, wheel or two fingers to come nearer, Shift and " +
        `drag to move${this.told.surfaces.some((s) => s.poses.length) ? "; a click on a camera shows its picture" : ""}.` }),
      element("div", { className: "scene-view" }, this.canvas, this.picture),
      this.legend,
      element("div", { className: "scene-controls" }, which, this.layers, this.shown, this.path),
      this.note);
  }

  /* Shows another surface, as it is looked at first. */
  choose(index) {
    this.now = this.surfaces[index] = this.surfaces[index] || new Shown(this.gl, this.told.surfaces[index]);
    const told = this.now.told, of = told.triangles_made, poses = this.now.poses;
    this.layer = 0;
    this.layers.replaceChildren(this.layers.firstChild, ...told.layers.map((layer, i) => {
      const [input, label] = choice(layer.title, { type: "radio", name: this.layerName, checked: i === 0 });
      input.addEventListener("change", () => { this.layer = i; this.explain(); this.redraw(); });
      return label;
    }));
    const kinds = ["Surface", "Look through the near wall", "Cameras", "Path", ...told.clouds.map((c) => c.title)];
    const shown = poses.length ? ["Surface", "Cameras", "Path"] : ["Surface"];
    this.visible = kinds.map((title) => shown.includes(title));
    this.shown.replaceChildren(this.shown.firstChild, ...kinds.map((title, i) => {
      const [input, label] = choice(title, { type: "checkbox", checked: this.visible[i] });
      label.hidden = !poses.length && ["Cameras", "Path"].includes(title);
      input.addEventListener("change", () => { this.visible[i] = input.checked; this.redraw(); });
      if (i < 4) return label;
      const swatch = element("span", { className: "scene-swatch" });
      swatch.style.background = `rgb(${told.clouds[i - 4].color.join(",")})`;
      label.append(" ", swatch);
      return label;
    }));
    this.keyframe.replaceChildren(element("option", { value: -1, textContent: "none" }), ...poses.flatMap((pose, i) => {
      const more = this.pictures.has(pose.name) ? "" : " (no picture here)";
      return [element("option", { value: i, textContent: `${pose.name}${more}` })];
    }));
    this.path.hidden = !poses.length;
    this.ride.max = Math.max(poses.length - 1, 0);
    this.ride.value = 0;
    const drawn = this.now.count / 3;
    this.note.textContent = (drawn < of ? `Shown with ${drawn} of ${of} triangles; the files have all.`
      : `All ${of} triangles are shown.`) + (told.points_of > 1 ? ` One in ${told.points_of} points is shown.` : "");
    this.select(-1);
    this.reset();
    this.explain();
  }

  reset() {
    this.axes = rows(this.now.told.axes);
    [this.target, this.distance] = this.whole();
    this.inside = null;
    this.back.disabled = true;
    this.redraw();
  }

  /* From where the whole surface and its cameras are in sight: the place looked at, and the distance from it. */
  whole() {
    const { places, poses, extent } = this.now, centers = poses.map((pose) => pose.center);
    const near = centers.filter((center) => Math.hypot(...center) < extent), low = [], high = [];
    const seen = (place) => this.axes.forEach((axis, k) => {
      const far = dot(axis, place);
      low[k] = Math.min(low[k] ?? far, far);
      high[k] = Math.max(high[k] ?? far, far);
    });
    for (let i = 0; i < places.length; i += 3) seen(places.subarray(i, i + 3));
    near.forEach(seen);
    const half = minus(high, low).map((side) => side / 2), tangent = OUTSIDE;
    const aspect = this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1) || 1;
    const middle = this.axes.reduce((sum, axis, k) => along(sum, (low[k] + high[k]) / 2, axis), [0, 0, 0]);
    return [middle, half[2] + 1.06 * Math.max(half[0] / (tangent * aspect), half[1] / tangent, 1e-6 * extent)];
  }

  enter(place) {
    if (this.inside === null) this.look = [0, 0];
    this.inside = Math.min(Math.max(place, 0), this.now.poses.length - 1);
    this.ride.value = this.inside;
    this.ride.setAttribute("aria-valuetext", `keyframe ${this.now.poses[Math.round(this.inside)].name}`);
    this.back.disabled = false;
    this.redraw();
  }

  /* What the colours of the surface mean. */
  explain() {
    const { legend, palette } = this.now.told.layers[this.layer];
    this.legend.replaceChildren();
    if (!legend.length) return;
    const found = numbers(palette), count = found.length / 3;
    const color = (i) => `rgb(${found.slice(3 * i, 3 * i + 3).join(",")})`;
    if (count > 16) {
      const bar = element("span", { className: "scene-bar" });
      const stops = [0, 1, 2, 3, 4, 5, 6, 7, 8].map((k) => color(Math.round((k * (count - 1)) / 8)));
      bar.style.background = `linear-gradient(to right, ${stops.join(",")})`;
      const marks = element("span", { className: "scene-marks" });
      for (const [, words] of legend) marks.append(element("span", { textContent: words }));
      this.legend.append(bar, marks);
      return;
    }
    for (const [place, words] of legend) {
      const swatch = element("span", { className: "scene-swatch" });
      swatch.style.background = color(Math.round(place * (count - 1)));
      this.legend.append(element("span", {}, swatch, ` ${words}`));
    }
  }

  /* Shows the picture of a keyframe; -1 is none. */
  select(index) {
    this.selected = index;
    this.keyframe.value = index;
    const pose = this.now.poses[index];
    this.picture.hidden = !pose;
    if (pose) {
      const found = this.pictures.get(pose.name), inside = [];
      const said = [];
      for (const [key, words] of [["image", "image"], ...Object.entries(this.told.kinds)]) {
        if (!found || !found[key]) continue;
        const data = found[key].uint8.replace(/-/g, "+").replace(/_/g, "/");
        inside.push(element("img", { alt: `Keyframe ${pose.name}: ${words}`, src: `data:image/jpeg;base64,${data}` }));
        said.push(words);
      }
      const state = pose.used ? "" : ", left out of the surface";
      const words = said.join("; ") || "no picture of it is kept on this page";
      this.picture.replaceChildren(...inside, element("figcaption", { textContent: `${pose.name}${state}: ${words}` }));
    }
    this.redraw();
  }

  camera() {
    const aspect = this.canvas.width / this.canvas.height;
    if (this.inside === null) {
      const eye = along(this.target, -this.distance, this.axes[2]);
      const reach = Math.hypot(...eye) + 2 * this.now.extent, tangent = OUTSIDE;
      return { axes: this.axes, eye, aspect, tangent, near: Math.max(0.005 * this.distance, 1e-4 * reach), far: reach };
    }
    const { axes, eye } = this.now.riding(this.inside), [x, y] = this.now.told.tangents;
    const tangent = Math.min(Math.max(y, x / aspect), 1.8);
    return { axes: turned(axes, ...this.look), eye, aspect, tangent, near: 0.25 * this.now.size, far: 4 * this.now.extent };
  }

  redraw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => { this.asked = false; this.draw(); });
  }

  draw() {
    const { gl, now, canvas } = this, ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height || gl.isContextLost()) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    const seen = this.camera();
    const view = viewMatrix(seen.axes, seen.eye), projection = projectionMatrix(seen.tangent, seen.aspect, seen.near, seen.far);
    const use = (chosen) => {
      gl.useProgram(chosen);
      gl.uniformMatrix4fv(gl.getUniformLocation(chosen, "view"), false, view);
      gl.uniformMatrix4fv(gl.getUniformLocation(chosen, "projection"), false, projection);
    };
    const feed = (chosen, name, data, kind) => {
      const place = gl.getAttribLocation(chosen, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, data);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, kind, kind === gl.UNSIGNED_BYTE, 0, 0);
      return place;
    };
    const [surface, through, cameras, path, ...clouds] = this.visible;
    if (surface) {
      use(this.mesh);
      feed(this.mesh, "position", now.vertices, gl.FLOAT);
      const others = [feed(this.mesh, "normal", now.normals, gl.FLOAT),
        feed(this.mesh, "color", now.layers[this.layer], gl.UNSIGNED_BYTE)];
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, now.triangles);
      if (through) gl.enable(gl.CULL_FACE); /* fronts face the cameras: from outside, the near wall is a back */
      gl.drawElements(gl.TRIANGLES, now.count, now.kind, 0);
      gl.disable(gl.CULL_FACE);
      others.forEach((place) => gl.disableVertexAttribArray(place));
    }
    use(this.plain);
    const put = (data, count, mode, color, size) => {
      if (!count) return;
      feed(this.plain, "position", data, gl.FLOAT);
      gl.uniform3fv(gl.getUniformLocation(this.plain, "color"), color);
      gl.uniform1f(gl.getUniformLocation(this.plain, "size"), size * ratio);
      gl.uniform1i(gl.getUniformLocation(this.plain, "round"), mode === gl.POINTS ? 1 : 0);
      gl.drawArrays(mode, 0, count);
    };
    now.clouds.forEach((cloud, i) => clouds[i] && put(cloud.data, cloud.count, gl.POINTS, cloud.color, 4));
    if (path) put(now.path, now.poses.length, gl.LINE_STRIP, PATH, 1);
    if (cameras && this.inside === null) { /* inside, they would stand in the way */
      gl.disable(gl.DEPTH_TEST); /* else the wall, around which they are, would hide them */
      put(now.lines[0].data, now.lines[0].count, gl.LINES, USED, 1);
      put(now.lines[1].data, now.lines[1].count, gl.LINES, LEFT_OUT, 1);
      if (this.selected >= 0) {
        const lines = buffer(gl, gl.ARRAY_BUFFER, new Float32Array(now.frusta[this.selected]));
        put(lines, now.frusta[this.selected].length / 3, gl.LINES, CHOSEN, 1);
        put(lines, 1, gl.POINTS, CHOSEN, 7);
        gl.deleteBuffer(lines);
      }
    }
  }

  /* The keyframe whose camera is drawn at a place of the canvas (CSS pixels), -1 if none is within 16. */
  at(x, y) {
    if (!this.visible[2] || this.inside !== null) return -1;
    const { axes, eye, aspect, tangent, near } = this.camera();
    const [w, h] = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
    let found = -1, closest = 16;
    this.now.poses.forEach((pose, i) => {
      for (const ahead of [0, 0.5, 1]) {
        const place = minus(along(pose.center, ahead * this.now.size, pose.axes[2]), eye), depth = dot(axes[2], place);
        if (depth < near) continue;
        const u = w + (w * dot(axes[0], place)) / (depth * tangent * aspect), v = h + (h * dot(axes[1], place)) / (depth * tangent);
        const away = Math.hypot(u - x, v - y);
        if (away < closest) [found, closest] = [i, away];
      }
    });
    return found;
  }

  turn(dx, dy) {
    const angle = 4 / Math.max(this.canvas.clientHeight, 1);
    if (this.inside === null) this.axes = turned(this.axes, -angle * dx, -angle * dy);
    else this.look = [this.look[0] + (angle * dx) / 2, Math.min(Math.max(this.look[1] + (angle * dy) / 2, -1.5), 1.5)];
    this.redraw();
  }

  move(dx, dy) {
    if (this.inside !== null) return;
    const pixel = (2 * this.distance * OUTSIDE) / Math.max(this.canvas.clientHeight, 1);
    this.target = along(along(this.target, -pixel * dx, this.axes[0]), -pixel * dy, this.axes[1]);
    this.redraw();
  }

  /* Nearer by a factor, or on along the path. */
  nearer(factor) {
    if (this.inside !== null) return this.enter(this.inside + 2 * Math.log(factor));
    this.distance = Math.min(Math.max(this.distance / factor, 0.01 * this.now.extent), 6 * this.now.extent);
    this.redraw();
  }

  listen() {
    const { canvas } = this, fingers = new Map();
    let moved = 0;
    const spread = () => {
      const [a, b] = [...fingers.values()];
      return { length: Math.hypot(a[0] - b[0], a[1] - b[1]) || 1, x: (a[0] + b[0]) / 2, y: (a[1] + b[1]) / 2 };
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      moved = fingers.size > 1 ? 99 : 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId);
      if (!last) return;
      const before = fingers.size === 2 && spread(), dx = event.clientX - last[0], dy = event.clientY - last[1];
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      moved += Math.hypot(dx, dy);
      if (before) {
        const after = spread();
        this.nearer(after.length / before.length);
        this.move(after.x - before.x, after.y - before.y);
      } else if (event.shiftKey || event.buttons === 2) this.move(dx, dy);
      else if (moved > 3) this.turn(dx, dy);
    });
    const lifted = (event) => {
      if (event.type === "pointerup" && fingers.has(event.pointerId) && moved <= 3) {
        const found = this.at(event.offsetX, event.offsetY);
        if (found >= 0) this.select(found);
      }
      fingers.delete(event.pointerId);
    };
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, lifted);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.nearer(Math.exp((-event.deltaY * (event.deltaMode === 1 ? 30 : 1)) / 600));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const keys = { ArrowLeft: () => this.turn(-20, 0), ArrowRight: () => this.turn(20, 0), ArrowUp: () => this.turn(0, -20),
        ArrowDown: () => this.turn(0, 20), "+": () => this.nearer(1.15), "-": () => this.nearer(1 / 1.15), Home: () => this.reset() };
      if (!keys[event.key] || event.ctrlKey || event.metaKey) return;
      event.preventDefault();
      keys[event.key]();
    });
    canvas.addEventListener("webglcontextlost", () => fallBack(this.root, "the drawing was stopped by the browser"));
    this.surface.addEventListener("change", () => this.choose(Number(this.surface.value)));
    this.ride.addEventListener("input", () => this.enter(Number(this.ride.value)));
    this.back.addEventListener("click", () => this.reset());
    this.keyframe.addEventListener("change", () => this.select(Number(this.keyframe.value)));
    new ResizeObserver(() => this.redraw()).observe(canvas);
  }
}

/* The still picture in place of a scene, and why. */
function fallBack(root, why) {
  root.querySelectorAll(":scope > :not(.scene-still, script, noscript)").forEach((child) => child.remove());
  root.querySelector(".scene-still").hidden = false;
  root.append(element("p", { className: "scene-note", textContent: `A still picture, because ${why}.` }));
}

document.querySelectorAll(".scene").forEach((root, number) => {
  try {
    new Viewer(root, JSON.parse(root.querySelector("script").textContent), number);
    root.querySelector(".scene-still").hidden = true;
  } catch (error) {
    fallBack(root, error.message);
  }
});
