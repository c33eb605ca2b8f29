"use strict";
/* The take: names, and numbers that are unpacked where they are used. Metres, world frame. */

const UNKNOWN = -32768;
const take = JSON.parse(document.getElementById("take").textContent);

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

/* An array (frame, hand, ...) of whole numbers that stand for multiples of a step; NaN where unknown. */
class Numbers {
  constructor(stored) {
    this.offset = stored.offset;
    this.step = stored.step;
    this.hands = stored.shape[1];
    this.size = stored.shape.slice(2).reduce((a, b) => a * b, 1);
    this.whole = new Int16Array(bytesOf(stored.numbers).buffer);
  }

  of(frame, hand) {
    const first = (frame * this.hands + hand) * this.size;
    const values = new Float32Array(this.size);
    for (let i = 0; i < this.size; i++) {
      const whole = this.whole[first + i];
      values[i] = whole === UNKNOWN ? NaN : this.offset + this.step * whole;
    }
    return values;
  }
}

const arrays = {};
for (const [name, stored] of Object.entries(take.arrays)) arrays[name] = stored && new Numbers(stored);

const faces = {};
for (const [side, stored] of Object.entries(take.faces)) faces[side] = new Uint16Array(bytesOf(stored).buffer);

const jointWeights = take.joint_weights && bytesOf(take.joint_weights);
const JOINTS = take.joints.length;

/* The numbers of a hand in a frame: null where nobody has them. */
function numbersOf(name, frame, hand) {
  return arrays[name] && arrays[name].of(frame, hand);
}

function isThere(frame, hand) {
  const vertices = arrays.vertices_world;
  return vertices !== null && vertices.whole[(frame * vertices.hands + hand) * vertices.size] !== UNKNOWN;
}

/* The values (joint) of one view of an array (view, joint), or with view null their mean over the views. */
function overViews(values, view) {
  if (view !== null) return values.slice(view * JOINTS, (view + 1) * JOINTS);
  const means = new Float32Array(JOINTS).fill(NaN);
  for (let j = 0; j < JOINTS; j++) {
    let sum = 0, known = 0;
    for (let i = j; i < values.length; i += JOINTS) if (!isNaN(values[i])) { sum += values[i]; known++; }
    if (known) means[j] = sum / known;
  }
  return means;
}

function mean(values) {
  let sum = 0, known = 0;
  for (const value of values) if (!isNaN(value)) { sum += value; known++; }
  return known ? sum / known : NaN;
}
