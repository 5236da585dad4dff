// A light for each camera and for the node: ok, warn or bad, and why in words.

import { median } from "./store.js";

/** Higher is worse. */
export const RANK = { unknown: -1, ok: 0, warn: 1, bad: 2 };
/** A status of this age, seconds, says nothing of now. */
const OLD = 4;
/** For how long an event keeps a light on, seconds. */
const KEPT = 30;
/** With a smaller share of its points near the body a camera tells little. */
const FEW = 0.5;
/** A residual this many times the usual one is not usual any more. */
const CLEARLY = 1.7;
/** A clock of the cameras with which poses cannot be timed as they should, in words. */
const OF_CLOCK = {
  drifting: "the cameras' clock drifts",
  ahead: "the cameras' clock is ahead",
  behind: "the cameras' clock is behind",
  foreign: "the cameras' clock has another epoch",
};
const BAD = ["camera_moved", "conflict", "dropped", "lost", "overdue", "rig_refused", "silent", "unusable"];
let [expected, usedAgain] = [[], []];

/** Sets the kinds of events that belong to a good run, and how the words begin when a camera is used again. */
export function setExpected(kinds, words) {
  [expected, usedAgain] = [kinds, words];
}

/** Kinds of events that hold until one of these comes, however long that is. */
const LASTING = ["camera_moved", "clock_offset"];

/** How bad an event is. */
export function levelOf({ kind, detail }) {
  // Of these kinds not all belong to a good run.
  if (kind === "clock" && !detail.includes("the cameras use")) return "warn";
  if (kind === "solver" && detail.includes("no solver is there")) return "warn";
  if (expected.includes(kind) || usedAgain.some((words) => detail.startsWith(words))) return "ok";
  return BAD.includes(kind) ? "bad" : "warn";
}

/** Events of the node that its light tells of, in words. */
const OF_NODE = {
  second_node: "another node publishes on the same topics",
  rig_refused: "a calibration from the bus was refused",
  clock_jump: "the cameras' clock jumped",
  overdue: "windows were not solved in time",
};

class Light {
  constructor(level) {
    this.level = level;
    this.words = [];
    this.advice = [];
  }

  add(level, words, advice) {
    if (RANK[level] > RANK[this.level]) this.level = level;
    this.words.push(words);
    if (advice) this.advice.push(advice);
  }
}

/** The difference of a counter over the last seconds of the history. */
export function recent(history, read) {
  const last = history.at(-1);
  const first = history.find(({ at, status }) => last.at - at <= 5 && status.run_id === last.status.run_id);
  const counts = [first, last].map(({ status }) => Number(read(status) ?? 0n));
  return counts[1] - counts[0];
}

/** The events of a camera that still count: recent ones (the clock may have jumped), silence until the camera returns, and the last one of each lasting kind. */
function eventsOf(store, name, time) {
  const now = time === Infinity ? (store.historyAt(time).at(-1)?.seconds ?? store.newest) : time;
  const mine = store.events.filter(({ camera, at }) => camera === name && at <= time);
  const last = (wanted) => mine.findLast(({ kind }) => kind === wanted);
  // A node that starts anew judges the clocks anew.
  const run = store.historyAt(now).at(-1)?.status.run_id;
  const isOfRun = (event) => event && (event.kind === "camera_moved" || !event.run || run === undefined || event.run === run);
  const [lasting, returned] = [LASTING.map(last).filter(isOfRun), last("returned")?.at ?? -Infinity];
  const isOver = ({ kind, at }) => LASTING.includes(kind) || (kind === "silent" && at <= returned) || Math.abs(now - at) >= KEPT;
  return mine.filter((event) => lasting.includes(event) || !isOver(event));
}

/** The rate that most cameras have, Hz. */
function usualRate(cameras) {
  return median(cameras.map((camera) => camera.rate_hz ?? 0).filter((rate) => rate > 0)) ?? 0;
}

/** What is wrong with the size of a camera's images. */
function wrongSize(store, name) {
  const camera = store.rig?.cameras.find((one) => one.name === name);
  const [width, height] = store.keypoints.get(name)?.items.at(-1)?.size ?? [0, 0];
  if (!camera || width === 0 || (width === camera.width && height === camera.height)) return undefined;
  return `its images are ${width} x ${height}, the calibration's ${camera.width} x ${camera.height}`;
}

/** The light of a camera at a time: of its counters in the status, of its own past, and of its events. */
export function cameraLight(store, name, now, advice) {
  const history = store.historyAt(now);
  const newest = history.at(-1);
  const isOld = now === Infinity ? performance.now() - store.statusCame > OLD * 1000 : now - newest?.seconds > OLD;
  const last = isOld ? undefined : newest;
  const cameras = last?.status.cameras ?? [];
  const mine = (status) => status.cameras.find(({ camera }) => camera === name);
  const counters = last && mine(last.status);
  const light = new Light(counters ? "ok" : "unknown");
  const calibrated = store.rig?.cameras.some((camera) => camera.name === name);
  if (store.rig && !calibrated) light.add("bad", "not in the calibration");
  const wrong = wrongSize(store, name);
  if (wrong) light.add("bad", wrong);
  if (counters) {
    const rate = counters.rate_hz ?? 0;
    const age = counters.age_s ?? 0;
    const frame = counters.unusable > 0 ? "usable frame" : "frame";
    const isSilent = counters.silent || rate === 0;
    if (isSilent) light.add("bad", age > 0 ? `no ${frame} for ${age.toFixed(1)} s` : `no ${frame} yet`);
    else if (rate < 0.8 * usualRate(cameras)) {
      light.add("warn", `${rate.toFixed(1)} of ${usualRate(cameras).toFixed(0)} frames a second`);
    }
    if (counters.waited_for !== true && !isSilent) light.add("warn", "not waited for");
    for (const kind of ["unusable", "late", "missing", "duplicate", "dropped"]) {
      const count = recent(history, (status) => mine(status)?.[kind]);
      if (count > 0) {
        const level = kind === "unusable" || kind === "dropped" ? "bad" : "warn";
        light.add(level, `${counted(count, "frame")} ${kind} in 5 s`, advice[kind]);
      }
    }
    if (counters.verdict) light.add("bad", counters.verdict);
    const near = counters.near ?? 0;
    if (counters.residual_px > 0 && near < FEW) light.add("warn", `only ${Math.round(100 * near)} % of its points are near the body`);
    const [usual, px] = [counters.usual_px ?? 0, counters.residual_px ?? 0];
    if (usual > 0 && px > CLEARLY * usual) {
      light.add(px > 3 * usual ? "bad" : "warn", `residual ${px.toFixed(1)} px, usually ${usual.toFixed(1)}`);
    }
  }
  const events = eventsOf(store, name, now).filter((event) => levelOf(event) !== "ok");
  events.sort((a, b) => RANK[levelOf(b)] - RANK[levelOf(a)] || b.at - a.at);
  for (const event of events.slice(0, 1)) {
    const since = LASTING.includes(event.kind) ? timeOfDay(store.nanoseconds(event.at)) : "";
    const kind = event.kind.replaceAll("_", " ");
    const words = event.detail.startsWith("of ") ? `${kind} ${event.detail}` : event.detail || kind;
    light.add(levelOf(event), words + (since && `, since ${since}`));
  }
  return { ...light, counters };
}

/** After this time without a status, ms, nobody knows what the node does. */
const UNKNOWN = 3000;

/** Whether there was a status of the node, and there is none any more. */
export const isNodeSilent = (store) => store.statusCame !== undefined && performance.now() - store.statusCame > UNKNOWN;

/** The cameras that are not in the calibration, and of which the node told in the last seconds. */
export function strangers(store) {
  const now = store.historyAt(Infinity).at(-1)?.seconds ?? store.newest;
  const isKnown = (name) => store.rig.cameras.some((camera) => camera.name === name);
  const told = store.events.slice(-200).filter(({ kind, camera, at }) => kind === "unusable" && camera && Math.abs(now - at) < KEPT);
  return [...new Set(told.map(({ camera }) => camera))].filter((name) => !isKnown(name));
}

/** The light of the node, of what it says of itself. */
export function nodeLight(store, connected) {
  const light = new Light("ok");
  const history = store.historyAt(Infinity);
  if (!connected) light.add("bad", "no connection to the page's server; it is tried again");
  if (store.statusCame === undefined) {
    if (connected) light.add("warn", "no status of a node yet");
    return light;
  }
  const age = (performance.now() - store.statusCame) / 1000;
  if (isNodeSilent(store)) light.add("bad", `no status for ${age.toFixed(0)} s: the node is stopped or not reached`);
  if (history.length > 1) {
    const missed = recent(history, (status) => status.playout?.missed);
    if (missed > 0) light.add("bad", `${counted(missed, "pose")} too late in 5 s`);
    const lost = recent(history, (status) => status.windows?.lost);
    if (lost > 0) light.add("warn", `${counted(lost, "window")} fitted badly in 5 s`);
    const coasted = recent(history, (status) => status.playout?.coasted);
    if (coasted > 0 && missed <= 0) light.add("warn", `${counted(coasted, "pose")} extrapolated in 5 s`);
    const effort = history.at(-1).status.effort?.level ?? 0;
    if (effort > 0) light.add("warn", `overload: effort lowered to level ${effort}`);
    const { verdict, clock: kind } = history.at(-1).status;
    if (verdict) light.add("bad", verdict);
    const clock = OF_CLOCK[kind];
    if (clock) light.add("warn", clock);
    const full = recent(history, (status) => status.queue_dropped);
    if (full > 0) light.add("bad", `${full} messages were not read: too many, or too large`);
    for (const [kind, words] of Object.entries(OF_NODE)) {
      const count = recent(history, ({ events }) => events.find((one) => one.kind === kind)?.count);
      if (count > 0) light.add(levelOf({ kind, detail: "" }), words);
    }
  }
  return light;
}

/** The time of day of a capture time, hours and minutes; empty if the cameras' clock is not that of a day. */
export function timeOfDay(ns, options = { hour: "2-digit", minute: "2-digit" }) {
  const ms = Number(ns) / 1e6;
  return ms > Date.UTC(2001) ? new Date(ms).toLocaleTimeString("en-GB", options) : "";
}

function counted(count, what) {
  return `${count} ${what}${count === 1 ? "" : "s"}`;
}
