"use strict";
/* The column at the side: hands, what colours them, and the numbers of every joint. */

const FINGERS = ["thumb", "index", "middle", "ring", "little"];

function element(tag, content = "", attributes = {}) {
  const made = document.createElement(tag);
  made.append(...[content].flat());
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  return made;
}

/* Buttons of which one is chosen. */
function choice(place, options, onChoose) {
  const buttons = options.map(([value, label]) => {
    const button = element("button", label, { type: "button" });
    button.onclick = () => onChoose(value);
    return [value, button];
  });
  place.replaceChildren(...buttons.map(([, button]) => button));
  return (chosen) => buttons.forEach(([value, button]) => button.setAttribute("aria-pressed", value === chosen));
}

class Panel {
  constructor(state, refresh) {
    this.state = state;
    this.title();
    this.hands = take.hands.map((hand, index) => this.hand(hand, index, refresh));
    document.getElementById("hands").replaceChildren(...this.hands.map((hand) => hand.row));
    const options = [[null, "Side"], ...MEASURES.map((measure) => [measure, measure.label])];
    this.choose = choice(document.getElementById("measures"), jointWeights ? options : options.slice(1), (measure) => {
      state.measure = measure;
      refresh();
    });
    document.getElementById("measures").parentElement.hidden = MEASURES.length === 0;
    document.getElementById("trust").hidden = MEASURES.length === 0;
    for (const [id, field] of [["show-pictures", "pictures"], ["show-keypoints", "keypoints"]])
      document.getElementById(id).onchange = (event) => { state[field] = event.target.checked; refresh(); };
    document.getElementById("show-keypoints").parentElement.hidden = arrays.keypoints_px === null;
    document.getElementById("opacity").oninput = (event) => { state.opacity = +event.target.value; refresh(); };
  }

  title() {
    document.getElementById("title").textContent = take.title;
    document.getElementById("subtitle").textContent = take.subtitle;
    document.getElementById("facts").replaceChildren(
      ...take.facts.map(([label, value]) => element("div", [element("dt", label), element("dd", value)])));
  }

  hand(hand, index, refresh) {
    const swatch = element("i"), note = element("small"), box = element("input", "", { type: "checkbox" });
    swatch.style.background = css(hand.rgb);
    const name = hand.name[0].toUpperCase() + hand.name.slice(1).replace("_", " ") + " hand";
    box.checked = true;
    box.onchange = () => { this.state.hidden[box.checked ? "delete" : "add"](index); refresh(); };
    const label = element("label", [swatch, element("span", [element("b", name), note]), box]);
    return { row: element("li", label), note, name };
  }

  draw() {
    const { frame, camera, measure } = this.state;
    this.choose(measure);
    this.hands.forEach(({ note }, hand) => { note.textContent = this.noteOf(frame, hand, camera); });
    const shown = measure || MEASURES[0];
    if (!shown) return;
    document.getElementById("scale").replaceChildren(...this.scale(measure));
    const from = shown.of === overViews && cameras.length ? (camera === null ? ", mean of the cameras" : `, ${cameras[camera].name}`) : "";
    document.getElementById("trust-title").textContent = shown.title + from;
    document.getElementById("joints").replaceChildren(
      ...take.hands.map((_, hand) => this.table(shown, frame, hand, camera)));
  }

  /* What a hand's line says of it at this moment. */
  noteOf(frame, hand, camera) {
    if (!isThere(frame, hand)) return "not in this frame";
    const parts = MEASURES.map((measure) => {
      const value = mean(valuesOf(measure, frame, hand, camera));
      const unit = { sigma: "mm sigma", error: "px off", confidence: "% sure" }[measure.name];
      return isNaN(value) ? null : `${written(measure, value)} ${unit}`;
    }).filter((part) => part);
    if (take.bridged[frame][hand]) parts.unshift("not seen, bridged");
    return parts.join(", ") || "reconstructed";
  }

  scale(measure) {
    if (measure === null) return [];
    const best = measure.best || 0, bar = element("div");
    bar.style.background = `linear-gradient(to right, ${STOPS.map((rgb) => css(rgb)).join(", ")})`;
    const ends = [best, measure.worst].map((value, end) => {
      const plain = +(value * measure.factor).toFixed(3);
      return element("span", `${plain} ${measure.unit}${end && !measure.best ? " and more" : ""}`);
    });
    return [bar, element("p", ends)];
  }

  table(measure, frame, hand, camera) {
    const there = isThere(frame, hand);
    const values = there ? valuesOf(measure, frame, hand, camera) : new Float32Array(JOINTS).fill(NaN);
    const cell = (j) => {
      const made = element("td", written(measure, values[j]), { title: take.joints[j].replace("_", " ") });
      if (!isNaN(values[j])) {
        made.style.background = css(colourOf(measure, values[j]));
        made.style.color = "#111";
      }
      return made;
    };
    const rows = FINGERS.map((finger, f) =>
      element("tr", [element("th", finger), ...[1, 2, 3, 4].map((k) => cell(4 * f + k))]));
    const wrist = element("tr", [element("th", "wrist"), cell(0)]);
    return element("table", [element("caption", this.hands[hand].name), ...rows, wrist]);
  }
}
