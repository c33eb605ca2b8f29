"use strict";
/* What is drawn over the scene: key points of the camera that is looked through, and names of cameras. */

const RING_PX = 3;

class Marks {
  constructor(canvas) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
  }

  begin(width, height, ratio) {
    const w = Math.round(width * ratio), h = Math.round(height * ratio);
    if (this.canvas.width !== w || this.canvas.height !== h) [this.canvas.width, this.canvas.height] = [w, h];
    this.pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.pen.clearRect(0, 0, width, height);
  }

  /* The names of the cameras, above their pictures in the room. */
  names(view, quads, colour) {
    this.pen.font = "11px system-ui, sans-serif";
    this.pen.textAlign = "center";
    this.pen.fillStyle = colour;
    cameras.forEach((camera, index) => {
      const corners = quads[index].map((corner) => projected(view, corner));
      if (corners.includes(null)) return;
      const x = corners.reduce((sum, at) => sum + at[0], 0) / corners.length;
      this.pen.fillText(camera.name, x, Math.min(...corners.map((at) => at[1])) - 6);
    });
  }

  /* Key points as rings on thin bones; from each a line to where the joint of the mesh lies, a dot. */
  hand(view, place, keypoints, joints, rgb) {
    const at = (j) => (isNaN(keypoints[2 * j]) ? null : place(keypoints[2 * j], keypoints[2 * j + 1]));
    const pen = this.pen, seen = take.joints.map((_, j) => at(j));
    pen.lineWidth = 1.2;
    pen.strokeStyle = css(rgb, 0.9);
    for (const [a, b] of take.bones) if (seen[a] && seen[b]) this.line(seen[a], seen[b]);
    seen.forEach((ring, j) => {
      if (!ring) return;
      const joint = joints && projected(view, [joints[3 * j], joints[3 * j + 1], joints[3 * j + 2]]);
      if (joint) {
        pen.strokeStyle = pen.fillStyle = "#fff";
        this.line(ring, joint);
        this.dot(joint, 1.7);
        pen.fill();
      }
      this.dot(ring, RING_PX);
      pen.fillStyle = css(rgb);
      pen.strokeStyle = "#fff";
      pen.fill();
      pen.stroke();
    });
  }

  line(a, b) {
    this.pen.beginPath();
    this.pen.moveTo(...a);
    this.pen.lineTo(...b);
    this.pen.stroke();
  }

  dot(at, radius) {
    this.pen.beginPath();
    this.pen.arc(...at, radius, 0, 2 * Math.PI);
  }
}

/* Edges of the cameras' frames in the room, and the corners of their pictures. */
function cameraFrames(share) {
  const lines = [], quads = [];
  for (const camera of cameras) {
    const depth = share * Math.hypot(...plus(camera.position, take.view.look_at, -1));
    const corners = [[0, 0], [1, 0], [1, 1], [0, 1]].map(([x, y]) =>
      unprojected(camera, x * camera.width, y * camera.height, depth));
    corners.forEach((corner, i) => lines.push(camera.position, corner, corner, corners[(i + 1) % 4]));
    quads.push(corners);
  }
  return { lines, quads };
}

/* A level grid of 10 cm below the hands of the whole take. */
function gridBelow() {
  const up = unit(take.view.up);
  let lowest = Infinity;
  take.frames.forEach((_, frame) => take.hands.forEach((_, hand) => {
    if (!isThere(frame, hand)) return;
    const points = arrays.vertices_world.of(frame, hand);
    for (let i = 0; i < points.length; i += 30) lowest = Math.min(lowest, dot(points.slice(i, i + 3), up));
  }));
  if (!isFinite(lowest)) return [];
  const along = unit(cross(up, Math.abs(up[0]) < 0.8 ? [1, 0, 0] : [0, 1, 0])), across = cross(up, along);
  const middle = plus(take.view.look_at, up, lowest - 0.05 - dot(take.view.look_at, up));
  const lines = [];
  for (let i = -5; i <= 5; i++)
    for (const [a, b] of [[along, across], [across, along]])
      lines.push(plus(plus(middle, a, i / 10), b, -0.5), plus(plus(middle, a, i / 10), b, 0.5));
  return lines;
}
