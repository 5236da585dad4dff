// The camera images: detected keypoints, and the solved bodies over them.

import { fit } from "./charts.js";
import { colour } from "./colours.js";
import { project } from "./lens.js";
import { median } from "./store.js";

/** A detected person farther from a body than this part of the image's diagonal, in the median, is somebody else. */
const NEAR = 0.04;

export class Panes {
  /** `choose(name)` is called with the camera that was clicked. */
  constructor(root, choose) {
    this.root = root;
    this.choose = choose;
    this.panes = new Map();
    /** Names of the cameras whose panes are in sight. */
    this.inSight = new Set();
    this.observer = new IntersectionObserver((changes) => {
      for (const { target, isIntersecting } of changes) {
        if (isIntersecting) this.inSight.add(target.dataset.camera);
        else this.inSight.delete(target.dataset.camera);
      }
      this.sightChanged?.();
    });
  }

  setRig(lenses) {
    this.lenses = new Map(lenses.map((lens) => [lens.name, lens]));
    this.setCameras(lenses.map(({ name }) => name));
  }

  setCameras(names) {
    for (const [name, pane] of this.panes) {
      if (names.includes(name)) continue;
      this.observer.unobserve(pane.button);
      pane.button.remove();
      this.panes.delete(name);
      this.inSight.delete(name);
    }
    for (const name of names) {
      if (this.panes.has(name)) continue;
      const button = document.createElement("button");
      button.type = "button";
      button.dataset.camera = name;
      button.title = `look through ${name}`;
      button.setAttribute("aria-pressed", "false");
      const canvas = button.appendChild(document.createElement("canvas"));
      const caption = button.appendChild(document.createElement("span"));
      caption.className = "caption";
      const swatch = caption.appendChild(document.createElement("span"));
      swatch.className = "swatch";
      const light = caption.appendChild(document.createElement("span"));
      const count = caption.appendChild(document.createElement("span"));
      light.className = "light";
      light.textContent = name;
      button.addEventListener("click", () => this.choose(name));
      this.observer.observe(button);
      this.panes.set(name, { button, canvas, swatch, light, count, context: canvas.getContext("2d") });
    }
    if (names.join("\n") === this.order) return;
    this.order = names.join("\n");
    names.forEach((name, number) => {
      const { button, swatch } = this.panes.get(name);
      // Its colour in the charts.
      swatch.style.background = colour(number);
      if (this.root.children[number] !== button) this.root.insertBefore(button, this.root.children[number]);
    });
  }

  /** The camera to look through, if there is one. */
  setThrough(name) {
    for (const [of, { button }] of this.panes) button.setAttribute("aria-pressed", String(of === name));
  }

  setLight(name, level, words) {
    const pane = this.panes.get(name);
    if (!pane) return;
    pane.light.className = `light ${level}`;
    pane.light.textContent = name;
    pane.button.title = words || `look through ${name}`;
  }

  draw(store, time, people) {
    for (const [name, pane] of this.panes) {
      const lens = this.lenses?.get(name);
      const frame = store.keypoints.get(name)?.shown(time);
      const [width, height] = lens ? [lens.width, lens.height] : (frame?.size ?? [16, 9]);
      const wide = Math.round(pane.canvas.clientWidth * Math.min(devicePixelRatio, 2)) || 200;
      const high = Math.round((wide * height) / Math.max(width, 1));
      if (pane.canvas.width !== wide || pane.canvas.height !== high) [pane.canvas.width, pane.canvas.height] = [wide, high];
      const { context } = pane;
      const scale = wide / width;
      context.clearRect(0, 0, wide, high);
      if (lens) for (const one of people) drawBody(context, lens, one, scale);
      const errors = drawKeypoints(context, lens, frame, people, store.usualOf(name, time), scale);
      const text = !frame ? (store.keypoints.size > 0 ? "no frame" : "") : errors.length > 0 ? `${median(errors).toFixed(1)} px` : "";
      if (pane.count.textContent !== text) pane.count.textContent = text;
    }
  }
}

/** Draws the keypoints of a camera over the scene that is seen through it. */
export function drawOver(canvas, through, store, time, people) {
  canvas.hidden = through === undefined;
  if (!through) return;
  const [{ lens, scale, corner }, context] = [through, canvas.getContext("2d")];
  fit(canvas, context);
  context.translate(...corner);
  context.strokeStyle = "#8a8f98";
  context.strokeRect(0, 0, lens.width * scale, lens.height * scale);
  const frame = store.keypoints.get(lens.name)?.shown(time);
  drawKeypoints(context, lens, frame, people, store.usualOf(lens.name, time), scale);
}

/** Detected and solved keypoints; returns the distances between them, pixels. */
function drawKeypoints(context, lens, frame, people, usual, scale) {
  const detected = frame?.people ?? [];
  for (const person of detected) drawPoints(context, person, scale);
  return lens ? people.flatMap((one) => drawErrors(context, lens, one, detected, usual, scale)) : [];
}

/**
 * The body's keypoints as rings, with a line to what was detected; red beyond three times the camera's usual
 * residual. Returns the distances, pixels.
 */
function drawErrors(context, lens, { points, tint, state }, people, usual, scale) {
  if (!points || state !== "tracking") return [];
  const seen = [];
  for (let k = 0; k < points.length; k += 4) {
    const at = project(lens, points[k + 1], points[k + 2], points[k + 3]);
    if (at) seen.push([points[k], at]);
  }
  const errorsOf = (person) => {
    const errors = [];
    for (const [index, [u, v]] of seen) {
      const [x, y] = [person[3 * index], person[3 * index + 1]];
      if (person[3 * index + 2] > 0) errors.push([x, y, u, v, Math.hypot(x - u, y - v)]);
    }
    return errors;
  };
  let best;
  for (const person of people) {
    const errors = errorsOf(person);
    if (errors.length < 3) continue;
    const error = median(errors.map(([, , , , distance]) => distance));
    if (!best || error < best.error) best = { error, errors };
  }
  // Somebody else, where this performer is not detected.
  if (!best || best.error > NEAR * Math.hypot(lens.width, lens.height)) return [];
  context.lineWidth = 1.5;
  for (const [x, y, u, v, distance] of best.errors) {
    context.strokeStyle = usual > 0 && distance > 3 * usual ? "#ff5349" : tint;
    context.beginPath();
    context.arc(u * scale, v * scale, 2.5, 0, 2 * Math.PI);
    context.moveTo(u * scale, v * scale);
    context.lineTo(x * scale, y * scale);
    context.stroke();
  }
  return best.errors.map(([, , , , distance]) => distance);
}

function drawPoints(context, points, scale) {
  [context.fillStyle, context.strokeStyle, context.lineWidth] = ["#fff", "#0c0e10", 0.5];
  for (let k = 0; k + 2 < points.length; k += 3) {
    const confidence = points[k + 2];
    if (!(confidence > 0)) continue;
    context.globalAlpha = Math.min(1, 0.2 + confidence);
    context.fillRect(points[k] * scale - 1.5, points[k + 1] * scale - 1.5, 3, 3);
    context.strokeRect(points[k] * scale - 2, points[k + 1] * scale - 2, 4, 4);
  }
  context.globalAlpha = 1;
}

function drawBody(context, lens, { joints, parents, tint, state }, scale) {
  const at = parents.map((_, j) => project(lens, joints[3 * j], joints[3 * j + 1], joints[3 * j + 2]));
  context.strokeStyle = state === "tracking" ? tint : "#8a8f98";
  context.lineWidth = 1.5;
  context.beginPath();
  parents.forEach((parent, j) => {
    if (parent < 0 || !at[j] || !at[parent]) return;
    context.moveTo(at[parent][0] * scale, at[parent][1] * scale);
    context.lineTo(at[j][0] * scale, at[j][1] * scale);
  });
  context.stroke();
}
