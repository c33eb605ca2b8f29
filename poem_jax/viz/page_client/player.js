"use strict";
/* Time: play, the slider by frame or by time, and lanes that show when each hand is there. */

const SECONDS_PER_FRAME = 0.25; // Where the frames' times are not known.
const LONGEST_WAIT_S = 1; // Between frames: a gap in a take is not sat through.
const PLAY = "M3 1.5v11l9-5.5z", PAUSE = "M2.5 1.5h3v11h-3zM8.5 1.5h3v11h-3z";

class Player {
  constructor(state, refresh, prepare) {
    this.state = state;
    this.refresh = refresh;
    this.prepare = prepare;
    this.last = take.frames.length - 1;
    this.slider = document.getElementById("slider");
    document.getElementById("player").hidden = this.last === 0;
    document.getElementById("play").onclick = () => this.play(!state.playing);
    document.getElementById("back").onclick = () => this.step(-1);
    document.getElementById("forward").onclick = () => this.step(1);
    document.getElementById("speed").onchange = (event) => { this.speed = +event.target.value; };
    this.speed = 1;
    this.slider.oninput = () => { this.play(false); this.show(this.frameAt(+this.slider.value)); };
    this.byTime = take.times_s !== null;
    document.getElementById("axis").hidden = !this.byTime;
    this.chooseAxis = choice(document.getElementById("axis"), [[false, "Frames"], [true, "Time"]], (byTime) => {
      this.byTime = byTime;
      this.setRange();
      this.refresh();
    });
    this.setRange();
    this.mark = (symbol, label) => {
      const button = document.getElementById("play");
      button.innerHTML = `<svg width="14" height="14" fill="currentColor"><path d="${symbol}"/></svg>`;
      button.setAttribute("aria-label", label);
    };
    this.mark(PLAY, "Play");
  }

  setRange() {
    this.slider.min = this.placeOf(0);
    this.slider.max = this.placeOf(this.last);
    this.slider.step = this.byTime ? "any" : 1;
    this.chooseAxis(this.byTime);
  }

  placeOf(frame) { return this.byTime ? take.times_s[frame] : frame; }

  /* The frame nearest to a place of the slider. */
  frameAt(place) {
    let best = 0;
    for (let f = 1; f <= this.last; f++)
      if (Math.abs(this.placeOf(f) - place) < Math.abs(this.placeOf(best) - place)) best = f;
    return best;
  }

  show(frame) {
    this.state.frame = Math.min(Math.max(frame, 0), this.last);
    this.refresh();
  }

  step(by) { this.play(false); this.show(this.state.frame + by); }

  play(playing) {
    if (playing === this.state.playing || this.last === 0) return;
    this.state.playing = playing;
    this.mark(playing ? PAUSE : PLAY, playing ? "Pause" : "Play");
    if (!playing) return;
    if (this.state.frame === this.last) this.show(0);
    this.then = performance.now();
    this.waited = 0;
    requestAnimationFrame((now) => this.tick(now));
  }

  /* How long a frame stays, in seconds of the take; the last one as long as the one before. */
  staying(frame) {
    if (take.times_s === null) return SECONDS_PER_FRAME;
    const f = Math.min(frame, this.last - 1);
    return Math.min(take.times_s[f + 1] - take.times_s[f], LONGEST_WAIT_S);
  }

  tick(now) {
    if (!this.state.playing) return;
    this.waited += Math.max(0, now - this.then) / 1000 * this.speed;
    this.then = now;
    let frame = this.state.frame;
    for (let n = 0; n <= this.last && this.waited >= this.staying(frame); n++) {
      this.waited -= this.staying(frame);
      frame = frame === this.last ? 0 : frame + 1;
    }
    if (frame !== this.state.frame) this.show(frame);
    this.prepare(frame === this.last ? 0 : frame + 1);
    requestAnimationFrame((later) => this.tick(later));
  }

  draw(colours) {
    const { frame } = this.state;
    this.slider.value = this.placeOf(frame);
    const time = take.times_s === null ? "" : `${take.times_s[frame].toFixed(2)} s, `;
    document.getElementById("moment").replaceChildren(
      element("b", `Frame ${take.frames[frame]}`), " ", element("small", `${time}${frame + 1} of ${take.frames.length}`));
    this.lanes(colours);
  }

  /* One lane a hand: full where it is there, pale where it is bridged, empty where it is not. */
  lanes({ line }) {
    const canvas = document.getElementById("lanes"), ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight, pen = canvas.getContext("2d");
    [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    pen.scale(ratio, ratio);
    const thumb = 8, span = this.placeOf(this.last) - this.placeOf(0) || 1;
    const x = (place) => thumb + ((place - this.placeOf(0)) / span) * (width - 2 * thumb);
    const lane = height / take.hands.length;
    take.hands.forEach((hand, h) => {
      pen.fillStyle = line;
      pen.fillRect(x(this.placeOf(0)), h * lane, width - 2 * thumb, lane - 2);
      take.frames.forEach((_, f) => {
        if (!isThere(f, h)) return;
        const from = f ? (this.placeOf(f - 1) + this.placeOf(f)) / 2 : this.placeOf(0);
        const to = f < this.last ? (this.placeOf(f) + this.placeOf(f + 1)) / 2 : this.placeOf(this.last);
        pen.fillStyle = css(hand.rgb, take.bridged[f][h] ? 0.35 : 1);
        pen.fillRect(x(from), h * lane, x(to) - x(from) + 0.3, lane - 2);
      });
    });
  }
}
