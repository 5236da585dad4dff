// The camera images: detected keypoints, and the solved bodies over them.

import { lensOf, project } from "./lens.js";
import { colour } from "./colours.js";

export class Panes {
  /** `choose(index)` is called with the index of a camera that was clicked. */
  constructor(root, choose) {
    this.root = root;
    this.choose = choose;
    this.panes = new Map();
  }

  setRig(rig) {
    this.lenses = new Map(rig.cameras.map((camera) => [camera.name, lensOf(camera)]));
    this.setCameras(rig.cameras.map(({ name }) => name));
  }

  setCameras(names) {
    for (const [name, pane] of this.panes) {
      if (names.includes(name)) continue;
      pane.button.remove();
      this.panes.delete(name);
    }
    names.forEach((name, index) => {
      if (this.panes.has(name)) return;
      const button = document.createElement("button");
      button.type = "button";
      button.dataset.camera = name;
      button.title = `look through ${name}`;
      const canvas = button.appendChild(document.createElement("canvas"));
      const caption = button.appendChild(document.createElement("span"));
      caption.className = "caption";
      const light = caption.appendChild(document.createElement("span"));
      const count = caption.appendChild(document.createElement("span"));
      light.className = "light";
      light.textContent = name;
      button.addEventListener("click", () => this.choose(index));
      this.root.append(button);
      this.panes.set(name, { button, canvas, light, count, context: canvas.getContext("2d") });
    });
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
      const frame = store.keypoints.get(name)?.at(time, 0.12);
      const [width, height] = lens ? [lens.width, lens.height] : (frame?.size ?? [16, 9]);
      const wide = Math.round(pane.canvas.clientWidth * Math.min(devicePixelRatio, 2)) || 200;
      const high = Math.round((wide * height) / Math.max(width, 1));
      if (pane.canvas.width !== wide || pane.canvas.height !== high) [pane.canvas.width, pane.canvas.height] = [wide, high];
      const { context } = pane;
      const scale = wide / width;
      context.clearRect(0, 0, wide, high);
      if (lens) for (const one of people) drawBody(context, lens, one, scale);
      let points = 0;
      for (const person of frame?.people ?? []) points += drawPoints(context, person, scale);
      const text = frame ? `${points} points` : store.keypoints.size > 0 ? "no frame" : "";
      if (pane.count.textContent !== text) pane.count.textContent = text;
    }
  }
}

function drawPoints(context, points, scale) {
  let count = 0;
  context.fillStyle = "#fff";
  for (let k = 0; k + 2 < points.length; k += 3) {
    const confidence = points[k + 2];
    if (!(confidence > 0)) continue;
    count++;
    context.globalAlpha = Math.min(1, 0.2 + confidence);
    context.fillRect(points[k] * scale - 1.5, points[k + 1] * scale - 1.5, 3, 3);
  }
  context.globalAlpha = 1;
  return count;
}

function drawBody(context, lens, { joints, parents, number, state }, scale) {
  const at = parents.map((_, j) => project(lens, joints[3 * j], joints[3 * j + 1], joints[3 * j + 2]));
  context.strokeStyle = state === "tracking" ? colour(number) : "#8a8f98";
  context.lineWidth = 1.5;
  context.beginPath();
  parents.forEach((parent, j) => {
    if (parent < 0 || !at[j] || !at[parent]) return;
    context.moveTo(at[parent][0] * scale, at[parent][1] * scale);
    context.lineTo(at[j][0] * scale, at[j][1] * scale);
  });
  context.stroke();
}
