// Plays the take of a report in 3D.

import { View } from "./scene.js";

const $ = (id) => document.getElementById(id);
const take = JSON.parse($("take").textContent);
const JOINTS = take.parents.length;

/** The numbers in a text of base64, as `Type`. */
function numbers(text, Type) {
  const bytes = Uint8Array.from(atob(text), (one) => one.charCodeAt(0));
  return new Type(bytes.buffer);
}

const performers = take.performers.map((one, number) => ({
  name: one.name,
  number,
  seconds: numbers(one.seconds, Float32Array),
  states: numbers(one.states, Uint8Array),
  joints: numbers(one.joints_mm, Int16Array),
}));
const end = Math.max(...performers.map(({ seconds }) => seconds.at(-1) ?? 0));
const view = new View($("canvas"), $("labels"));
for (const camera of take.rig.cameras) camera.lens = camera.lens === "fisheye" ? 2 : 1;
view.setRig(take.rig);

let [time, playing, last, framed] = [0, false, performance.now(), false];
$("time").max = end;

/** The performers at a time, between the poses around it. */
function peopleAt(at) {
  return performers.flatMap(({ name, number, seconds, states, joints }) => {
    let [low, high] = [0, seconds.length - 1];
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (seconds[middle] <= at + 1e-4) low = middle;
      else high = middle - 1;
    }
    const next = Math.min(low + 1, seconds.length - 1);
    const gap = seconds[next] - seconds[low];
    if (at < seconds[low] - 0.1 || at > seconds[low] + 1) return [];
    const share = gap > 0 && gap < 0.5 ? Math.min(1, Math.max(0, (at - seconds[low]) / gap)) : 0;
    const mixed = Float32Array.from({ length: 3 * JOINTS }, (_, k) => {
      const [from, to] = [low, next].map((pose) => joints[pose * 3 * JOINTS + k] / 1000);
      return from + share * (to - from);
    });
    return [{ name, number, state: take.states[states[low]], joints: mixed, parents: take.parents, head: take.head }];
  });
}

function show(now) {
  if (playing) time += Math.min(0.2, (now - last) / 1000);
  last = now;
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

$("play").addEventListener("click", () => {
  playing = !playing;
  if (playing && time >= end) time = 0;
});
$("time").addEventListener("input", ({ target }) => ([time, playing] = [Number(target.value), false]));
addEventListener("hashchange", goToHash);
goToHash();
requestAnimationFrame(show);
