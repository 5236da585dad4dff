// Curves over time: residuals of the cameras, solve times, knees and elbows.

import { colour } from "./colours.js";

const ANGLES = [
  ["left knee", "l_hip", "l_knee", "l_ankle"], ["right knee", "r_hip", "r_knee", "r_ankle"],
  ["left elbow", "l_shoulder", "l_elbow", "l_wrist"], ["right elbow", "r_shoulder", "r_elbow", "r_wrist"],
];

/** The angle at `b` between `a` and `c`, degrees; 180 is straight. */
function angle(joints, [a, b, c]) {
  const part = (p, q) => [0, 1, 2].map((k) => joints[3 * p + k] - joints[3 * q + k]);
  const [u, v] = [part(a, b), part(c, b)];
  const dot = u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
  return (Math.acos(Math.max(-1, Math.min(1, dot / (Math.hypot(...u) * Math.hypot(...v))))) * 180) / Math.PI;
}

export class Charts {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
  }

  /** Draws the span `[from, to]` with a cursor at `time`. `angles`: of this performer. */
  draw(store, [from, to], time, performer) {
    const ratio = Math.min(devicePixelRatio, 2);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      [this.canvas.width, this.canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    }
    const { context } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const style = getComputedStyle(this.canvas);
    this.ink = style.color;
    context.font = "11px system-ui, sans-serif";
    const third = Math.floor((width - 32) / 3);
    const plots = [
      ["residual, px", this.residuals(store)],
      ["solve of a window, ms", this.solves(store)],
      ["knees, elbows, degrees", this.angles(performer)],
    ];
    plots.forEach(([title, curves], place) => {
      this.plot([place * (third + 16), 0, third, height], [from, to], time, title, curves);
    });
  }

  residuals(store) {
    const names = store.rig?.cameras.map(({ name }) => name) ?? [];
    return names.map((name, index) => {
      const points = [];
      for (const { seconds, status } of store.statuses.items) {
        const px = status.cameras.find(({ camera }) => camera === name)?.residual_px;
        if (px > 0) points.push([seconds, px]);
      }
      return { name, colour: colour(index), points };
    });
  }

  solves(store) {
    const curve = (name, index, read) => {
      const points = store.statuses.items.map(({ seconds, status }) => [seconds, read(status.windows ?? {}) ?? 0]);
      return { name, colour: colour(index), points: points.filter(([, ms]) => ms > 0) };
    };
    return [curve("p50", 0, ({ solve_p50_ms }) => solve_p50_ms), curve("p99", 5, ({ solve_p99_ms }) => solve_p99_ms)];
  }

  angles(performer) {
    const names = performer?.skeleton?.joint_names;
    if (!names) return [];
    const { times, items } = performer.poses;
    const every = Math.max(1, Math.ceil(times.length / 600));
    return ANGLES.map(([name, ...joints], index) => {
      const of = joints.map((joint) => names.indexOf(joint));
      const points = [];
      for (let k = 0; k < times.length; k += every) points.push([times[k], angle(items[k].joints, of)]);
      return { name, colour: colour(index), points };
    });
  }

  plot([left, top, width, height], [from, to], time, title, curves) {
    const { context } = this;
    context.fillStyle = this.ink;
    context.globalAlpha = 0.75;
    context.fillText(title, left, top + 10);
    context.globalAlpha = 1;
    const seen = curves.flatMap(({ points }) => points.filter(([t]) => t >= from && t <= to).map(([, y]) => y));
    const [bottom, room] = [top + height - 2, height - 18];
    if (seen.length === 0) {
      context.globalAlpha = 0.6;
      context.fillText("nothing here", left, top + 30);
      context.globalAlpha = 1;
      return;
    }
    const [low, high] = [Math.min(...seen), Math.max(...seen)];
    const reach = Math.max(high - low, 1e-3);
    const x = (t) => left + 34 + ((t - from) / Math.max(to - from, 1e-6)) * (width - 34);
    const y = (value) => bottom - 2 - ((value - low) / reach) * (room - 6);
    context.fillText(high.toFixed(high < 20 ? 1 : 0), left, top + 24);
    context.fillText(low.toFixed(high < 20 ? 1 : 0), left, bottom);
    let at = left + context.measureText(title).width + 12;
    for (const { name, colour: tint, points } of curves) {
      context.fillStyle = context.strokeStyle = tint;
      if (at + context.measureText(name).width + 12 < left + width) {
        context.fillRect(at, top + 3, 8, 8);
        context.fillStyle = this.ink;
        context.fillText(name, at + 11, top + 10);
        at += context.measureText(name).width + 22;
      }
      context.beginPath();
      let last;
      for (const [t, value] of points) {
        if (t < from || t > to) continue;
        if (last !== undefined && t - last < 3) context.lineTo(x(t), y(value));
        else context.moveTo(x(t), y(value));
        last = t;
      }
      context.stroke();
    }
    context.strokeStyle = this.ink;
    context.beginPath();
    context.moveTo(x(time), top + 16);
    context.lineTo(x(time), bottom);
    context.stroke();
  }
}
