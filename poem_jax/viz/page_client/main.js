"use strict";
/* The page's state, what changes it, and what is drawn of it. */

const FRAME_SHARE = 0.25; // Where a camera's picture stands on the way to the hands.
const state = {
  frame: 0, camera: null, measure: jointWeights || !MEASURES.length ? null : MEASURES[0],
  hidden: new Set(), pictures: true, keypoints: true, opacity: 0.75, playing: false,
};
const stage = document.getElementById("stage");
const orbit = new Orbit(), lens = new Lens();
const { lines: frameLines, quads } = cameraFrames(FRAME_SHARE);
const scene = new Scene(document.getElementById("scene"), { frames: frameLines, grid: gridBelow() }, quads);
const marks = new Marks(document.getElementById("marks"));
const pictures = new Pictures(refresh);
const panel = new Panel(state, refresh);
const strip = new CameraStrip(look);
const player = new Player(state, refresh, (frame) => pictures.load(frame));
let pending = false, meshesOf = "", bitmaps = null;

function refresh() {
  if (pending) return;
  pending = true;
  requestAnimationFrame(() => { pending = false; drawAll(); });
}

function look(camera) {
  state.camera = camera;
  lens.reset();
  refresh();
}

function palette() {
  const style = getComputedStyle(document.documentElement);
  const of = (name) => style.getPropertyValue(`--${name}`).trim();
  const numbers = (name) => [1, 3, 5].map((i) => parseInt(of(name).slice(i, i + 2), 16) / 255);
  return { stage: numbers("stage"), grid: numbers("grid"), frame: numbers("frame"), soft: of("soft"), line: of("line") };
}

function drawAll() {
  const colours = palette(), { clientWidth: width, clientHeight: height } = stage;
  bitmaps = pictures.of(state.frame) || bitmaps;
  const camera = state.camera === null ? null : cameras[state.camera];
  const view = camera ? lens.view(camera, width, height) : orbit.view(width, height);
  const ratio = window.devicePixelRatio || 1;
  if (scene.works && width && height) drawScene(view, ratio, colours);
  marks.begin(width, height, ratio);
  if (camera && state.keypoints) drawKeypoints(view, camera);
  if (!camera && state.pictures) marks.names(view, quads, colours.soft);
  words(camera);
  panel.draw();
  strip.draw(state, bitmaps);
  player.draw(colours);
}

function drawScene(view, ratio, colours) {
  const key = [state.frame, state.camera, state.measure && state.measure.name, ...state.hidden].join();
  if (key !== meshesOf) scene.setMeshes(meshes());
  meshesOf = key;
  if (bitmaps) scene.setPictures(bitmaps);
  scene.begin(view.width, view.height, ratio, colours.stage);
  if (state.camera !== null) {
    const camera = cameras[state.camera];
    const corners = CORNERS.map(([x, y]) => lens.place(camera, view.width, view.height, x * camera.width, y * camera.height));
    if (state.pictures) scene.drawBehind(view, state.camera, corners);
    scene.drawMeshes(view, state.opacity);
    return;
  }
  scene.drawLines(view, "grid", colours.grid);
  if (state.pictures) {
    scene.drawLines(view, "frames", colours.frame);
    scene.drawInRoom(view);
  }
  scene.drawMeshes(view, 1);
}

function shownHands() {
  return take.hands.map((_, hand) => hand).filter((hand) => isThere(state.frame, hand) && !state.hidden.has(hand));
}

function meshes() {
  return shownHands().map((hand) => {
    const points = arrays.vertices_world.of(state.frame, hand);
    return { points, faces: faces[take.hands[hand].side], colours: coloursOf(hand, points.length / 3) };
  });
}

function coloursOf(hand, vertices) {
  if (state.measure !== null && jointWeights)
    return vertexColours(state.measure, valuesOf(state.measure, state.frame, hand, state.camera));
  const rgb = take.hands[hand].rgb;
  return Float32Array.from({ length: 3 * vertices }, (_, i) => rgb[i % 3] / 255);
}

function drawKeypoints(view, camera) {
  for (const hand of shownHands()) {
    const all = numbersOf("keypoints_px", state.frame, hand);
    if (!all) continue;
    const seen = all.slice(2 * JOINTS * state.camera, 2 * JOINTS * (state.camera + 1));
    const place = (u, v) => lens.place(camera, view.width, view.height, u, v);
    marks.hand(view, place, seen, numbersOf("joints_world", state.frame, hand), take.hands[hand].rgb);
  }
}

function words(camera) {
  const missing = camera && take.pictures[state.frame][state.camera] === null ? ", which has no picture here" : "";
  document.getElementById("where").replaceChildren(
    ...(camera ? ["Through ", element("b", camera.name), missing] : ["Free view"]));
  document.getElementById("hint").textContent = camera
    ? "Wheel: enlarge. Escape: free view."
    : "Drag: turn. Right drag: move. Wheel: nearer. Double click: as at first. Grid: 10 cm.";
  stage.classList.toggle("through", camera !== null);
}

/* Pointers: one turns, or moves with another button or a key held; two move and zoom. */
const pointers = new Map();
stage.addEventListener("pointerdown", (event) => {
  stage.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
});
for (const name of ["pointerup", "pointercancel"])
  stage.addEventListener(name, (event) => pointers.delete(event.pointerId));
stage.addEventListener("pointermove", (event) => {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const now = [event.clientX, event.clientY], dx = now[0] - before[0], dy = now[1] - before[1];
  const other = [...pointers].find(([id]) => id !== event.pointerId);
  pointers.set(event.pointerId, now);
  if (other) {
    const apart = (at) => Math.hypot(at[0] - other[1][0], at[1] - other[1][1]);
    zoom(apart(now) / Math.max(apart(before), 1), now);
  }
  if (state.camera !== null) lens.pan(dx, dy);
  else if (other || event.buttons !== 1 || event.shiftKey || event.ctrlKey) orbit.pan(dx, dy, stage.clientHeight);
  else orbit.rotate(dx, dy);
  refresh();
});
stage.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(-event.deltaY * 0.0015), [event.clientX, event.clientY]);
  refresh();
}, { passive: false });
stage.addEventListener("contextmenu", (event) => event.preventDefault());
stage.addEventListener("dblclick", () => { (state.camera === null ? orbit : lens).reset(); refresh(); });

function zoom(factor, [x, y]) {
  const box = stage.getBoundingClientRect();
  if (state.camera === null) orbit.zoom(factor);
  else lens.zoom(factor, [x - box.left - box.width / 2, y - box.top - box.height / 2]);
}

document.addEventListener("keydown", (event) => {
  const field = event.target.matches("input:not([type=checkbox]), select");
  if (event.key === "Escape") look(null);
  else if (field || event.ctrlKey || event.metaKey || event.altKey) return;
  else if (event.key === " " && !event.target.matches("button, input")) {
    event.preventDefault();
    player.play(!state.playing);
  }
  else if (event.key === "ArrowLeft") player.step(-1);
  else if (event.key === "ArrowRight") player.step(1);
});

if (!scene.works) {
  const notice = document.getElementById("notice");
  notice.textContent = "This browser offers no WebGL 2, so hands and pictures cannot be drawn; the numbers are all here.";
  notice.hidden = false;
}
new ResizeObserver(refresh).observe(stage);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", refresh);
refresh();
