// Curves over time: residuals of the cameras, latencies, solve times, knees and elbows.

import { colour } from "./colours.js";

/** Most rows of names below the title of a plot. More cameras have their colours in the panes. */
const ROWS = 3;

const ANGLES = [
  ["left knee", "l_hip", "l_knee", "l_ankle"], ["right knee", "r_hip", "r_knee", "r_ankle"],
  ["left elbow", "l_shoulder", "l_elbow", "l_wrist"], ["right elbow", "r_shoulder", "r_elbow", "r_wrist"],
];

/** The flexion at `b` between `a` and `c`, degrees; 0 is straight. */
function flexion(joints, [a, b, c]) {
  const part = (p, q) => [0, 1, 2].map((k) => joints[3 * q + k] - joints[3 * p + k]);
  const [u, v] = [part(a, b), part(b, c)];
  const dot = u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
  return (Math.acos(Math.max(-1, Math.min(1, dot / (Math.hypot(...u) * Math.hypot(...v))))) * 180) / Math.PI;
}

/** Flexions of a live performer: time, seconds, and one for each of ANGLES; at most 600. */
export function anglesOf(performer) {
  const names = performer?.skeleton?.joint_names;
  if (!names) return [];
  const of = ANGLES.map(([, ...joints]) => joints.map((joint) => names.indexOf(joint)));
  const { times, items } = performer.poses;
  const every = Math.max(1, Math.ceil(times.length / 600));
  const chosen = times.filter((_, k) => k % every === 0);
  return chosen.map((time, k) => [time, ...of.map((joints) => flexion(items[k * every].joints, joints))]);
}

/** Name, place among the colours, and what it is of a status. */
const LATENCIES = [
  ["declared", 0, ({ declared_latency_ns }) => Number(declared_latency_ns ?? 0) / 1e6],
  ["window p50", 2, ({ windows }) => windows?.age_p50_ms],
  ["p99", 5, ({ windows }) => windows?.age_p99_ms],
];
const COSTS = [["p50", 0, ({ windows }) => windows?.cost_p50]];
const SOLVES = [
  ["p50", 0, ({ windows }) => windows?.solve_p50_ms],
  ["p99", 5, ({ windows }) => windows?.solve_p99_ms],
];

function curve(name, index, statuses, read) {
  const points = statuses.map(({ seconds, status }) => [seconds, read(status) ?? 0]);
  return { name, colour: colour(index), gap: 3, points: points.filter(([, y]) => y > 0) };
}

/** Clears a canvas whose pixels are those of the screen; its context draws in the units of the page. */
export function fit(canvas, context) {
  const ratio = Math.min(devicePixelRatio, 2);
  const size = [canvas.clientWidth, canvas.clientHeight].map((pixels) => Math.round(pixels * ratio));
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
}

export class Charts {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
  }

  /** Draws the span of the source with a cursor at `time`. `performer`: whose angles. */
  draw(store, source, time, performer) {
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const { context } = this;
    fit(this.canvas, context);
    this.ink = getComputedStyle(this.canvas).color;
    context.font = "11px system-ui, sans-serif";
    const { statuses, angles } = source.curves(performer);
    const cameras = store.rig?.cameras.map(({ name }) => name) ?? [];
    const residual = (name) => (status) => status.cameras.find(({ camera }) => camera === name)?.residual_px;
    const plots = [
      ["residual, px", cameras.map((name, index) => curve(name, index, statuses, residual(name)))],
      ["latency, ms", LATENCIES.map(([name, index, read]) => curve(name, index, statuses, read))],
      ["solve of a window, ms", SOLVES.map(([name, index, read]) => curve(name, index, statuses, read))],
      ["window cost", COSTS.map(([name, index, read]) => curve(name, index, statuses, read))],
      ["knees, elbows, degrees", ANGLES.map(([name], k) => {
        return { name, colour: colour(k), gap: 0.2, points: angles.map((at) => [at[0], at[k + 1]]) };
      })],
    ];
    // The files of `solve` have no times.
    const seen = plots.filter(([, curves]) => curves.some(({ points }) => points.length > 0));
    const shown = seen.length > 0 ? seen : plots;
    const wide = Math.floor((width - 16 * (shown.length - 1)) / shown.length);
    shown.forEach(([title, curves], place) => {
      this.plot([place * (wide + 16), 0, wide, height], source.span, time, title, curves);
    });
  }

  /** The names of the curves below the title, each with its row and its place in it, pixels. */
  rowsOf(curves, width) {
    const placed = [];
    let [row, x] = [0, 0];
    for (const { name, colour: tint } of curves) {
      const wide = this.context.measureText(name).width + 12;
      if (x > 0 && x + wide > width) [row, x] = [row + 1, 0];
      if (row === ROWS) break;
      placed.push({ name, tint, row, x });
      x += wide + 10;
    }
    return placed;
  }

  plot([left, top, width, height], [from, to], time, title, curves) {
    const { context } = this;
    context.fillStyle = this.ink;
    context.globalAlpha = 0.75;
    context.fillText(title, left, top + 9, width);
    context.globalAlpha = 1;
    const seen = curves.flatMap(({ points }) => points.filter(([t]) => t >= from && t <= to).map(([, y]) => y));
    const rows = this.rowsOf(curves, width);
    const begin = top + 20 + 12 * (rows.at(-1)?.row ?? 0);
    const [bottom, room] = [top + height - 2, top + height - begin - 12];
    if (seen.length === 0) {
      context.globalAlpha = 0.6;
      context.fillText("nothing here", left, top + 40);
      context.globalAlpha = 1;
      return;
    }
    const [low, high] = [Math.min(...seen), Math.max(...seen)];
    const reach = Math.max(high - low, 1e-3);
    const x = (t) => left + 34 + ((t - from) / Math.max(to - from, 1e-6)) * (width - 34);
    const y = (value) => bottom - 2 - ((value - low) / reach) * (room - 6);
    context.fillText(high.toFixed(high < 20 ? 1 : 0), left, begin + 18);
    context.fillText(low.toFixed(high < 20 ? 1 : 0), left, bottom);
    for (const { name, tint, row, x: at } of rows) {
      context.fillStyle = tint;
      context.fillRect(left + at, top + 15 + 12 * row, 8, 8);
      context.fillStyle = this.ink;
      context.fillText(name, left + at + 11, top + 23 + 12 * row);
    }
    for (const { colour: tint, gap, points } of curves) {
      // Long recordings have fewer points.
      const usual = points.length > 1 ? (points.at(-1)[0] - points[0][0]) / (points.length - 1) : 0;
      context.strokeStyle = tint;
      context.beginPath();
      let last;
      for (const [t, value] of points) {
        if (t < from || t > to) continue;
        if (last !== undefined && t >= last && t - last < Math.max(gap, 3 * usual)) context.lineTo(x(t), y(value));
        else context.moveTo(x(t), y(value));
        last = t;
      }
      context.stroke();
    }
    context.strokeStyle = this.ink;
    context.beginPath();
    context.moveTo(x(time), begin + 10);
    context.lineTo(x(time), bottom);
    context.stroke();
  }
}
