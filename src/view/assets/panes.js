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
      const pane = { button, canvas, swatch, light, count, context: canvas.getContext("2d") };
      canvas.addEventListener("contextrestored", () => (pane.isOld = true));
      this.panes.set(name, pane);
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

  /** Draws what has changed, where it is in sight. */
  draw(store, time, people) {
    const isShown = (one, k) => ["joints", "points", "tint", "state"].every((key) => one[key] === this.shown[k][key]);
    const areSame = this.shown?.length === people.length && people.every(isShown);
    this.shown = people;
    for (const [name, pane] of this.panes) {
      if (!areSame) pane.isOld = true;
      const lens = this.lenses?.get(name);
      const frame = store.keypoints.get(name)?.shown(time);
      const [width, height] = lens ? [lens.width, lens.height] : (frame?.size[0] > 0 ? frame.size : [1920, 1080]);
      const wide = Math.round(pane.canvas.clientWidth * Math.min(devicePixelRatio, 2)) || 200;
      const high = Math.round((wide * height) / Math.max(width, 1));
      const isResized = pane.canvas.width !== wide || pane.canvas.height !== high;
      if (isResized) [pane.canvas.width, pane.canvas.height, pane.isOld] = [wide, high, true];
      if (!this.inSight.has(name)) continue;
      const usual = store.usualOf(name, time);
      const isAny = store.keypoints.size > 0;
      const isNew = pane.lens !== lens || pane.frame !== frame || pane.usual !== usual || pane.isAny !== isAny;
      if (!pane.isOld && !isNew) continue;
      Object.assign(pane, { isOld: false, lens, frame, usual, isAny });
      const { context } = pane;
      const scale = wide / width;
      context.clearRect(0, 0, wide, high);
      if (lens) for (const one of people) drawBody(context, lens, one, scale);
      const error = drawKeypoints(context, lens, frame, people, usual, scale);
      const text = !frame ? (isAny ? "no frame" : "") : error > 0 ? `${error.toFixed(1)} px` : "";
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

/** Numbers in memory that is kept, so that pictures leave less garbage. */
class Numbers {
  constructor() {
    this.all = new Float64Array(64);
    this.count = 0;
  }

  push(value) {
    if (this.count === this.all.length) {
      const more = new Float64Array(2 * this.count);
      more.set(this.all);
      this.all = more;
    }
    this.all[this.count++] = value;
  }

  /** The middle value, `undefined` of none. */
  get median() {
    return median(this.all.subarray(0, this.count));
  }
}

/** A pixel; index and pixel of each keypoint of a body that a camera sees; distances to one person, and to all. */
const [at, seen, far, errors] = [[0, 0], new Numbers(), new Numbers(), new Numbers()];

/** Draws detected and solved keypoints; returns the median distance between them, pixels, if there are some. */
function drawKeypoints(context, lens, frame, people, usual, scale) {
  const detected = frame?.people ?? [];
  for (const person of detected) drawPoints(context, person, scale);
  errors.count = 0;
  if (lens) for (const one of people) drawErrors(context, lens, one, detected, usual, scale);
  return errors.median;
}

/**
 * The body's keypoints as rings, with a line to what was detected; red beyond three times the camera's usual
 * residual. The distances are added to `errors`.
 */
function drawErrors(context, lens, { points, tint, state }, people, usual, scale) {
  if (!points || state !== "tracking") return;
  seen.count = 0;
  for (let k = 0; k < points.length; k += 4) {
    if (!project(lens, points[k + 1], points[k + 2], points[k + 3], at)) continue;
    seen.push(points[k]);
    seen.push(at[0]);
    seen.push(at[1]);
  }
  const keypoints = seen.all;
  // NaN where the point is not detected.
  const distanceTo = (person, k) => {
    const index = 3 * keypoints[k];
    return person[index + 2] > 0 ? Math.hypot(person[index] - keypoints[k + 1], person[index + 1] - keypoints[k + 2]) : NaN;
  };
  // Farther is somebody else, where this performer is not detected.
  let [best, least] = [undefined, NEAR * Math.hypot(lens.width, lens.height)];
  for (const person of people) {
    far.count = 0;
    for (let k = 0; k < seen.count; k += 3) {
      const distance = distanceTo(person, k);
      if (distance >= 0) far.push(distance);
    }
    const error = far.count < 3 ? Infinity : far.median;
    if (error <= least) [best, least] = [person, error];
  }
  if (!best) return;
  context.lineWidth = 1.5;
  for (let k = 0; k < seen.count; k += 3) {
    const distance = distanceTo(best, k);
    if (!(distance >= 0)) continue;
    errors.push(distance);
    const [index, u, v] = [3 * keypoints[k], keypoints[k + 1], keypoints[k + 2]];
    context.strokeStyle = usual > 0 && distance > 3 * usual ? "#ff5349" : tint;
    context.beginPath();
    context.arc(u * scale, v * scale, 2.5, 0, 2 * Math.PI);
    context.moveTo(u * scale, v * scale);
    context.lineTo(best[index] * scale, best[index + 1] * scale);
    context.stroke();
  }
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
  seen.count = 0;
  for (let j = 0; j < 3 * parents.length; j += 3) {
    const isSeen = project(lens, joints[j], joints[j + 1], joints[j + 2], at);
    seen.push(isSeen ? at[0] * scale : NaN);
    seen.push(isSeen ? at[1] * scale : NaN);
  }
  context.strokeStyle = state === "tracking" ? tint : "#8a8f98";
  context.lineWidth = 1.5;
  context.beginPath();
  for (let j = 0; j < parents.length; j++) {
    const parent = parents[j];
    if (parent < 0 || Number.isNaN(seen.all[2 * j] + seen.all[2 * parent])) continue;
    context.moveTo(seen.all[2 * parent], seen.all[2 * parent + 1]);
    context.lineTo(seen.all[2 * j], seen.all[2 * j + 1]);
  }
  context.stroke();
}
