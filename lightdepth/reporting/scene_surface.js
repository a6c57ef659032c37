/*
 * What scene_viewer.js draws with: numbers from the JSON that scene.py writes, vectors, WebGL 2, and a surface in buffers.
 *
 * Axes are those of cameras, as the rows right, down, forward in the frame of the map; places are about the middle of the
 * surface shown. report.py puts both files into one strict function.
 */

const MESH = [
  `#version 300 es
  in vec3 position; in vec3 normal; in vec3 color;
  uniform mat4 view, projection;
  out vec3 at, facing, tint;
  void main() {
    vec4 seen = view * vec4(position, 1.0);
    at = seen.xyz; facing = mat3(view) * normal; tint = color;
    gl_Position = projection * seen;
  }`,
  `#version 300 es
  precision highp float;
  in vec3 at, facing, tint;
  out vec4 shown;
  void main() { /* light comes from where the camera is, and walls have two sides */
    float lit = abs(dot(normalize(facing), normalize(at)));
    shown = vec4(tint * (0.3 + 0.7 * lit), 1.0);
  }`,
];
const PLAIN = [
  `#version 300 es
  in vec3 position;
  uniform mat4 view, projection;
  uniform float size;
  void main() { gl_Position = projection * view * vec4(position, 1.0); gl_PointSize = size; }`,
  `#version 300 es
  precision highp float;
  uniform vec3 color;
  uniform bool round;
  out vec4 shown;
  void main() {
    if (round && distance(gl_PointCoord, vec2(0.5)) > 0.5) discard;
    shown = vec4(color, 1.0);
  }`,
];

/* Numbers from the JSON. */

function bytes(text) {
  const raw = atob(text.replace(/-/g, "+").replace(/_/g, "/"));
  const found = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) found[i] = raw.charCodeAt(i);
  return found;
}

function numbers(packed) {
  if (packed.uint32 !== undefined) return new Uint32Array(bytes(packed.uint32).buffer);
  if (packed.uint16 !== undefined) return new Uint16Array(bytes(packed.uint16).buffer);
  return bytes(packed.uint8);
}

function places(packed, middle) {
  const steps = numbers(packed), found = new Float32Array(steps.length);
  for (let i = 0; i < steps.length; i++) {
    found[i] = packed.low[i % 3] + packed.step[i % 3] * steps[i] - middle[i % 3];
  }
  return found;
}

function colors(layer, count) {
  const values = layer.values && numbers(layer.values);
  if (!layer.palette) return values;
  const palette = numbers(layer.palette), found = new Uint8Array(3 * count);
  for (let i = 0; i < found.length; i++) {
    found[i] = palette[3 * (values ? values[Math.floor(i / 3)] : 0) + (i % 3)];
  }
  return found;
}

function normals(vertices, triangles) {
  const found = new Float32Array(vertices.length);
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => vertices.subarray(3 * triangles[t + k], 3 * triangles[t + k] + 3));
    const normal = cross(minus(b, a), minus(c, a));
    for (let k = 0; k < 9; k++) found[3 * triangles[t + Math.floor(k / 3)] + (k % 3)] += normal[k % 3];
  }
  return found;
}

/* Vectors of three numbers, and axes. */

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const along = (a, length, b) => [a[0] + length * b[0], a[1] + length * b[1], a[2] + length * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => along([0, 0, 0], 1 / (Math.hypot(...a) || 1), a);
const between = (a, b, share) => along(a, share, minus(b, a));

function upright(down, forward) {
  const ahead = unit(forward), right = unit(cross(down, ahead));
  return [right, cross(ahead, right), ahead];
}

/* Turned to the left by `left` and upwards by `up`, radians. */
function turned([right, down, forward], left, up) {
  const ahead = along(along([0, 0, 0], Math.cos(left), forward), -Math.sin(left), right);
  return upright(along(along([0, 0, 0], Math.cos(up), down), Math.sin(up), ahead),
    along(along([0, 0, 0], Math.cos(up), ahead), -Math.sin(up), down));
}

const rows = (nine) => nine.map((row) => row.slice());

function viewMatrix([r, d, f], eye) {
  return [r[0], -d[0], -f[0], 0, r[1], -d[1], -f[1], 0, r[2], -d[2], -f[2], 0,
    -dot(r, eye), dot(d, eye), dot(f, eye), 1];
}

function projectionMatrix(tangent, aspect, near, far) {
  return [1 / (tangent * aspect), 0, 0, 0, 0, 1 / tangent, 0, 0,
    0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0];
}

/* WebGL. */

function program(gl, [vertex, fragment]) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.bindAttribLocation(made, 0, "position");
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

function buffer(gl, target, data) {
  const made = gl.createBuffer();
  gl.bindBuffer(target, made);
  gl.bufferData(target, data, gl.STATIC_DRAW);
  return made;
}

/* The middle and the largest side of a box around a surface and its cameras, as far as these are not far away. */
function around(told) {
  const low = told.vertices.low.slice(), high = low.map((l, k) => l + 65535 * told.vertices.step[k]);
  const reach = Math.max(...minus(high, low)), least = low.map((l) => l - reach), most = high.map((h) => h + reach);
  for (const { center } of told.poses) {
    if (center.some((c, k) => c < least[k] || c > most[k])) continue;
    center.forEach((c, k) => { [low[k], high[k]] = [Math.min(low[k], c), Math.max(high[k], c)]; });
  }
  return [between(low, high, 0.5), Math.max(...minus(high, low)) || 1];
}

/* What is drawn of one surface, in buffers. */
class Shown {
  constructor(gl, told) {
    [this.middle, this.extent] = around(told);
    this.gl = gl;
    this.told = told;
    const vertices = places(told.vertices, this.middle), triangles = numbers(told.triangles);
    this.count = triangles.length;
    this.kind = told.triangles.uint16 === undefined ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT;
    this.places = vertices;
    this.vertices = buffer(gl, gl.ARRAY_BUFFER, vertices);
    this.normals = buffer(gl, gl.ARRAY_BUFFER, normals(vertices, triangles));
    this.triangles = buffer(gl, gl.ELEMENT_ARRAY_BUFFER, triangles);
    this.layers = told.layers.map((layer) => buffer(gl, gl.ARRAY_BUFFER, colors(layer, vertices.length / 3)));
    this.clouds = told.clouds.map((cloud) => {
      const points = places(cloud.points, this.middle);
      return { data: buffer(gl, gl.ARRAY_BUFFER, points), count: points.length / 3, color: cloud.color.map((c) => c / 255) };
    });
    this.poses = told.poses.map((pose) => ({ ...pose, center: minus(pose.center, this.middle) }));
    const steps = this.poses.slice(1).map((pose, i) => Math.hypot(...minus(pose.center, this.poses[i].center)));
    const typical = steps.sort((a, b) => a - b)[Math.floor(steps.length / 2)] || 0;
    this.size = Math.min(Math.max(0.4 * typical, 0.008 * this.extent), 0.05 * this.extent);
    this.frusta = this.poses.map((pose) => this.frustum(pose));
    this.lines = [true, false].map((used) => {
      const found = this.frusta.flatMap((lines, i) => (this.poses[i].used === used ? lines : []));
      return { data: buffer(gl, gl.ARRAY_BUFFER, new Float32Array(found)), count: found.length / 3 };
    });
    this.path = buffer(gl, gl.ARRAY_BUFFER, new Float32Array(this.poses.flatMap((pose) => pose.center)));
  }

  /* A camera as eight lines: from its centre to the corners of what it sees, and around those. */
  frustum(pose) {
    const [x, y] = this.told.tangents.map((tangent) => Math.min(tangent, 1.2));
    const [right, down, forward] = pose.axes;
    const corners = [[-x, -y], [x, -y], [x, y], [-x, y]].map(([u, v]) =>
      along(pose.center, this.size, along(along(forward, u, right), v, down)));
    return corners.flatMap((corner, k) => [...pose.center, ...corner, ...corner, ...corners[(k + 1) % 4]]);
  }

  /* The camera at a place of the path, the number of a pose and a share of the way to the next. */
  riding(place) {
    const first = Math.min(Math.floor(place), this.poses.length - 1), second = Math.min(first + 1, this.poses.length - 1);
    const a = this.poses[first], b = this.poses[second], share = place - first;
    const axes = upright(between(a.axes[1], b.axes[1], share), between(a.axes[2], b.axes[2], share));
    return { axes, eye: between(a.center, b.center, share) };
  }
}
