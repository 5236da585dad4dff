// Plays the take of a report in 3D.

import { Template, metres, numbers } from "./body.js";
import { colour, numberOf } from "./colours.js";
import { NEXT, inLoop, press } from "./loop.js";
import { View } from "./scene.js";
import { Quaternion } from "./three.js";

const $ = (id) => document.getElementById(id);
const take = JSON.parse($("take").textContent);
const template = new Template(take.body);
const { parents } = template;

const performers = take.performers.map((one, number) => ({
  name: one.name,
  tint: colour(numberOf(one.name, number)),
  seconds: numbers(one.seconds, Float32Array),
  states: numbers(one.states, Uint8Array),
  roots: numbers(one.root_mm, Int32Array),
  rotations: Float32Array.from(numbers(one.rotations, Int16Array), (x) => x / 32767),
  skin: { rest: metres(numbers(one.rest, Int16Array)), offsets: one.offsets },
}));
for (const one of performers) {
  const steps = Array.from(one.seconds.subarray(1), (at, k) => at - one.seconds[k]).sort((a, b) => a - b);
  one.step = steps[steps.length >> 1] ?? 0;
  // Farther apart than this, seconds, are the poses beside a gap. Long takes have fewer poses.
  one.gap = Math.max(0.5, 2.5 * one.step);
}
const step = Math.min(...performers.map((one) => one.step).filter((seconds) => seconds > 0), 1);
const end = Math.max(...performers.map(({ seconds }) => seconds.at(-1) ?? 0));
const view = new View($("canvas"), $("labels"));
for (const camera of take.rig.cameras) camera.lens = camera.lens === "fisheye" ? 2 : 1;
if (view.error) $("labels").textContent = view.error;
view.setRig(take.rig);
view.setTemplate(template);

// At the first pose, which may be later than the first frame of the take.
const first = Math.min(...performers.map(({ seconds }) => seconds[0] ?? end));
let [time, playing, last, framed] = [first, false, performance.now(), false];
/** The ends of the stretch that is repeated, as far as they are set. */
let loop;
const speed = $("speed");
$("time").max = end;

/** The quaternions of a pose, between pose `low`, 0, and pose `next`, 1. */
function rotationsAt({ rotations }, low, next, share) {
  const [n, out] = [parents.length, new Float32Array(4 * parents.length)];
  for (let j = 0; j < n; j++) {
    Quaternion.slerpFlat(out, 4 * j, rotations, 4 * (low * n + j), rotations, 4 * (next * n + j), share);
  }
  return out;
}

/** The performers at a time, between the poses around it. */
function peopleAt(at) {
  return performers.flatMap((one) => {
    const { name, tint, seconds, states, roots, skin } = one;
    let [low, high] = [0, seconds.length - 1];
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (seconds[middle] <= at + 1e-4) low = middle;
      else high = middle - 1;
    }
    const next = Math.min(low + 1, seconds.length - 1);
    const gap = seconds[next] - seconds[low];
    if (at < seconds[low] - 0.1 || at > seconds[low] + Math.max(1, one.gap)) return [];
    const share = gap > 0 && gap < one.gap ? Math.min(1, Math.max(0, (at - seconds[low]) / gap)) : 0;
    const root = [0, 1, 2].map((k) => ((1 - share) * roots[3 * low + k] + share * roots[3 * next + k]) / 1000);
    const rotations = rotationsAt(one, low, next, share);
    const joints = template.forward(skin.offsets, root, rotations);
    return [{ name, shown: name, tint, state: take.states[states[low]], joints, rotations, skin, parents, head: take.head }];
  });
}

function show(now) {
  if (playing) time += Math.min(0.2, (now - last) / 1000) * Number(speed.value);
  last = now;
  if (playing) time = inLoop(loop, time);
  if (time >= end) [time, playing] = [end, false];
  const people = peopleAt(time);
  if (!framed && people.length > 0) {
    framed = true;
    view.frameAll(people);
  }
  view.draw(people, []);
  $("time").value = time;
  $("clock").textContent = `${time.toFixed(2)} of ${end.toFixed(2)} s`;
  $("play").textContent = playing ? "Pause" : "Play";
  document.body.dataset.people = people.length;
  document.body.dataset.time = time.toFixed(2);
  requestAnimationFrame(show);
}

function goToHash() {
  const at = Number(/t=([\d.]+)/.exec(location.hash)?.[1]);
  if (Number.isFinite(at)) [time, playing] = [at, false];
}

function play() {
  playing = !playing;
  if (playing && time >= end) time = first;
}

function go(to) {
  [time, playing] = [Math.min(end, Math.max(0, to)), false];
}

function repeat() {
  loop = press(loop, time, end);
  $("loop").textContent = NEXT[loop?.length ?? 0];
}

function faster(by) {
  speed.selectedIndex = Math.min(speed.options.length - 1, Math.max(0, speed.selectedIndex + by));
}

/** The keys of the live page. */
const KEYS = {
  " ": play,
  ArrowLeft: () => go(time - step),
  ArrowRight: () => go(time + step),
  "[": () => faster(-1),
  "]": () => faster(1),
  l: repeat,
};
addEventListener("keydown", (event) => {
  const { key, target, ctrlKey, metaKey, altKey } = event;
  if (ctrlKey || metaKey || altKey || target.closest("input, select") || (key === " " && target.closest("button"))) return;
  const action = KEYS[key.length === 1 ? key.toLowerCase() : key];
  if (!action) return;
  event.preventDefault();
  action();
});
$("play").addEventListener("click", play);
$("loop").addEventListener("click", repeat);
$("time").addEventListener("input", ({ target }) => go(Number(target.value)));
addEventListener("hashchange", goToHash);
goToHash();
requestAnimationFrame(show);
