"use strict";
/* What is known of how far to trust each joint, and its colours: calm where trust is due, warm where not. */

const STOPS = [[58, 137, 145], [128, 184, 144], [238, 211, 122], [231, 146, 84], [196, 66, 66]];
const NO_COLOUR = [140, 148, 158];
const MEASURES = [
  {
    name: "sigma", label: "Uncertainty", unit: "mm", factor: 1000, digits: 1, array: "sigma_m", least: 0.005,
    title: "Uncertainty per joint, mm (one sigma)", of: (values) => values,
  },
  {
    name: "error", label: "Error", unit: "px", factor: 1, digits: 1, array: "error_px", least: 10,
    title: "From key point to joint, px", of: overViews,
  },
  {
    name: "confidence", label: "Confidence", unit: "%", factor: 100, digits: 0, array: "confidence",
    title: "Borne out by the pictures, %", of: overViews, best: 1,
  },
].filter((measure) => arrays[measure.array] !== null);

for (const measure of MEASURES) measure.worst = measure.best ? 0 : Math.max(worstOf(arrays[measure.array]), measure.least);

/* The warmest colour begins at `worst`: never at a value that is good by itself (`least`), and else at a
   round value that nineteen of twenty values of the whole take do not exceed: frames compare by colour. */
function worstOf(numbers) {
  const known = Float32Array.from(numbers.whole.filter((whole) => whole !== UNKNOWN)).sort();
  const high = known.length ? known[Math.floor(0.95 * (known.length - 1))] * numbers.step : 1;
  const power = 10 ** Math.floor(Math.log10(Math.max(high, 1e-9)));
  return [1, 1.5, 2, 3, 5, 7, 10].find((digit) => digit * power >= high * 0.999) * power;
}

/* The measure's values (joint) of a hand, as seen by one view or, with view null, by all. */
function valuesOf(measure, frame, hand, view) {
  return measure.of(arrays[measure.array].of(frame, hand), view);
}

function written(measure, value) {
  return isNaN(value) ? "–" : (value * measure.factor).toFixed(measure.digits);
}

/* The colour, 0 to 255, of a value. */
function colourOf(measure, value) {
  if (isNaN(value)) return NO_COLOUR;
  const best = measure.best || 0;
  const share = Math.min(Math.max((value - best) / (measure.worst - best), 0), 1) * (STOPS.length - 1);
  const low = Math.min(Math.floor(share), STOPS.length - 2);
  return STOPS[low].map((from, c) => from + (share - low) * (STOPS[low + 1][c] - from));
}

function css(rgb, alpha = 1) {
  return `rgb(${rgb.map(Math.round).join(" ")} / ${alpha})`;
}

/* The colours (vertex, 3), 0 to 1, of a mesh whose joints have these values. */
function vertexColours(measure, values) {
  const vertices = jointWeights.length / JOINTS;
  const colours = new Float32Array(3 * vertices);
  for (let v = 0; v < vertices; v++) {
    let sum = 0, weight = 0;
    for (let j = 0; j < JOINTS; j++) {
      const share = jointWeights[v * JOINTS + j];
      if (share && !isNaN(values[j])) { sum += share * values[j]; weight += share; }
    }
    const rgb = colourOf(measure, weight ? sum / weight : NaN);
    for (let c = 0; c < 3; c++) colours[3 * v + c] = rgb[c] / 255;
  }
  return colours;
}
