"use strict";
/* The strip of cameras: their pictures of this frame; a click looks through one. */

const TILE_HEIGHT = 74;
const FREE_VIEW_SVG = `<svg width="26" height="26" viewBox="0 0 26 26" fill="none" stroke="currentColor"
  stroke-width="1.5"><path d="M13 3l9 5v10l-9 5-9-5V8zM4 8l9 5 9-5M13 13v10"/></svg>`;

class CameraStrip {
  constructor(onChoose) {
    const free = element("button", "", { type: "button", class: "free" });
    free.innerHTML = FREE_VIEW_SVG;
    free.append("Free view");
    free.onclick = () => onChoose(null);
    this.free = free;
    this.tiles = cameras.map((camera, index) => this.tile(camera, index, onChoose));
    document.getElementById("cameras").replaceChildren(free, ...this.tiles.map((tile) => tile.button));
  }

  tile(camera, index, onChoose) {
    const canvas = element("canvas"), note = element("small");
    const width = Math.round(Math.min((TILE_HEIGHT * camera.width) / camera.height, 150));
    [canvas.width, canvas.height] = [2 * width, 2 * TILE_HEIGHT];
    canvas.style.width = `${width}px`;
    canvas.style.height = `${TILE_HEIGHT}px`;
    const button = element("button", [canvas, element("span", [camera.name, note])], { type: "button" });
    button.setAttribute("aria-label", `Look through ${camera.name}`);
    button.onclick = () => onChoose(index);
    return { button, canvas, note, pen: canvas.getContext("2d"), camera };
  }

  draw(state, bitmaps) {
    this.free.setAttribute("aria-pressed", state.camera === null);
    this.tiles.forEach((tile, index) => {
      tile.button.setAttribute("aria-pressed", state.camera === index);
      tile.note.textContent = this.errorOf(state.frame, index);
      if (!bitmaps) return;
      tile.pen.clearRect(0, 0, tile.canvas.width, tile.canvas.height);
      const bitmap = bitmaps[index];
      if (bitmap) tile.pen.drawImage(bitmap, 0, 0, tile.canvas.width, tile.canvas.height);
      this.skeletons(state, tile);
    });
  }

  /* The hands as lines between their joints. */
  skeletons(state, { pen, canvas, camera }) {
    const view = { width: canvas.width, height: canvas.height };
    view.clip = product(clipFromCam(camera.focal * (canvas.width / camera.width), canvas.width, canvas.height, 0.02, 100), camera.T);
    take.hands.forEach((hand, index) => {
      const joints = isThere(state.frame, index) && !state.hidden.has(index) && numbersOf("joints_world", state.frame, index);
      if (!joints) return;
      const places = take.joints.map((_, j) => projected(view, [joints[3 * j], joints[3 * j + 1], joints[3 * j + 2]]));
      pen.strokeStyle = css(hand.rgb);
      pen.lineWidth = 2.2;
      pen.beginPath();
      for (const [a, b] of take.bones) if (places[a] && places[b]) { pen.moveTo(...places[a]); pen.lineTo(...places[b]); }
      pen.stroke();
    });
  }

  errorOf(frame, camera) {
    if (arrays.error_px === null) return "";
    const means = take.hands.map((_, hand) => mean(overViews(arrays.error_px.of(frame, hand), camera)));
    const error = mean(means);
    return isNaN(error) ? "" : `${error.toFixed(1)} px`;
  }
}
