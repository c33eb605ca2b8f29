"use strict";
/* Cameras with OpenCV's axes (x right, y down, z forward). Matrices are rows of 16; GL gets them transposed. */

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((x) => x / n); };

function product(a, b) {
  const c = new Float64Array(16);
  for (let i = 0; i < 4; i++)
    for (let j = 0; j < 4; j++)
      for (let k = 0; k < 4; k++) c[4 * i + j] += a[4 * i + k] * b[4 * k + j];
  return c;
}

/* Turn a vector about a unit axis (Rodrigues). */
function turned(a, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return plus(plus(a.map((x) => c * x), cross(axis, a), s), axis, (1 - c) * dot(axis, a));
}

function rigidRows(x, y, z, origin) {
  return Float64Array.from([...x, -dot(x, origin), ...y, -dot(y, origin), ...z, -dot(z, origin), 0, 0, 0, 1]);
}

/* Clip space from a pinhole's camera space, its centre moved by `shift` (pixels of the window). */
function clipFromCam(focal, width, height, near, far, shift = [0, 0]) {
  const depth = (far + near) / (far - near);
  return Float64Array.from([
    (2 * focal) / width, 0, (2 * shift[0]) / width, 0,
    0, (-2 * focal) / height, (-2 * shift[1]) / height, 0,
    0, 0, depth, (-2 * far * near) / (far - near),
    0, 0, 1, 0,
  ]);
}

/* Where a world point lies in a window, [x, y], or null behind the eye. */
function projected(view, point) {
  const m = view.clip, [x, y, z] = point;
  const w = m[12] * x + m[13] * y + m[14] * z + m[15];
  if (!(w > 1e-6)) return null;
  return [
    (((m[0] * x + m[1] * y + m[2] * z + m[3]) / w + 1) / 2) * view.width,
    ((1 - (m[4] * x + m[5] * y + m[6] * z + m[7]) / w) / 2) * view.height,
  ];
}

/* Cameras of the take, with where they stand. */
const cameras = take.cameras.map((stored) => {
  const T = Float64Array.from(stored.T_cam_from_world.flat());
  const axes = [0, 4, 8].map((row) => [T[row], T[row + 1], T[row + 2]]);
  const position = axes.reduce((sum, axis, i) => plus(sum, axis, -T[4 * i + 3]), [0, 0, 0]);
  return { name: stored.name, T, axes, position, focal: stored.focal_px, height: stored.hw[0], width: stored.hw[1] };
});

/* The world point at pixel (u, v) of a camera's picture and a depth. */
function unprojected(camera, u, v, depth) {
  const x = ((u - camera.width / 2) / camera.focal) * depth, y = ((v - camera.height / 2) / camera.focal) * depth;
  return plus(plus(plus(camera.position, camera.axes[0], x), camera.axes[1], y), camera.axes[2], depth);
}

/* The eye of the free view: it circles a target, and `up` stays up. */
class Orbit {
  constructor() { this.reset(); }

  reset() {
    this.target = [...take.view.look_at];
    this.offset = plus(take.view.position, this.target, -1);
    this.up = unit(take.view.up);
  }

  axes() {
    const z = unit(this.offset.map((x) => -x));
    const x = unit(cross(z, this.up));
    return [x, cross(z, x), z];
  }

  view(width, height) {
    const position = plus(this.target, this.offset), far = Math.hypot(...this.offset);
    const focal = height / 2 / Math.tan(take.view.fov / 2);
    const T = rigidRows(...this.axes(), position);
    const clip = product(clipFromCam(focal, width, height, far * 0.02, far * 50), T);
    return { clip, eye: position, width, height };
  }

  rotate(dx, dy) {
    const [x] = this.axes();
    const tilt = Math.acos(Math.min(1, Math.max(-1, dot(unit(this.offset), this.up))));
    const angle = Math.min(Math.max(tilt - dy * 0.008, 0.05), Math.PI - 0.05) - tilt;
    this.offset = turned(turned(this.offset, x, angle), this.up, -dx * 0.008);
  }

  pan(dx, dy, height) {
    const scale = (2 * Math.hypot(...this.offset) * Math.tan(take.view.fov / 2)) / height;
    const [x, y] = this.axes();
    this.target = plus(plus(this.target, x, -dx * scale), y, -dy * scale);
  }

  zoom(factor) { this.offset = this.offset.map((x) => x / factor); }
}

/* The view through a camera: its picture fits the window, and may be enlarged and moved. */
class Lens {
  constructor() { this.reset(); }

  reset() { this.factor = 1; this.shift = [0, 0]; }

  scale(camera, width, height) { return this.factor * Math.min(width / camera.width, height / camera.height); }

  view(camera, width, height) {
    const focal = camera.focal * this.scale(camera, width, height);
    const clip = product(clipFromCam(focal, width, height, 0.02, 100, this.shift), camera.T);
    return { clip, eye: camera.position, width, height };
  }

  /* The place in the window of a pixel of the picture. */
  place(camera, width, height, u, v) {
    const scale = this.scale(camera, width, height);
    return [
      width / 2 + this.shift[0] + scale * (u - camera.width / 2),
      height / 2 + this.shift[1] + scale * (v - camera.height / 2),
    ];
  }

  pan(dx, dy) { if (this.factor > 1) this.shift = [this.shift[0] + dx, this.shift[1] + dy]; }

  zoom(factor, at) {
    const before = this.factor;
    this.factor = Math.min(Math.max(before * factor, 1), 20);
    const change = this.factor / before;
    this.shift = this.factor === 1 ? [0, 0] : this.shift.map((s, i) => at[i] + (s - at[i]) * change);
  }
}
