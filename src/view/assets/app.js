// The page: what is shown when.

import { fetchSkins } from "./bodies.js";
import { Template } from "./body.js";
import { Charts } from "./charts.js";
import { colour } from "./colours.js";
import { Figures } from "./figures.js";
import { RANK, cameraLight, isNodeSilent, levelOf, nodeLight, setExpected, strangers } from "./lights.js";
import { NEXT, inLoop, press } from "./loop.js";
import { Decoder } from "./messages.js";
import { Panes, drawOver } from "./panes.js";
import { View } from "./scene.js";
import { Live, Recording } from "./sources.js";
import { Store } from "./store.js";
import { Through } from "./through.js";

const $ = (id) => document.getElementById(id);
const PARENTS = [-1];
const SPEEDS = [...$("speed").options].map(({ value }) => Number(value));

const { about, messages } = await (await fetch("about.json")).json();
setExpected(about.expected, about.used_again);
const isLive = about.shows === "live";
const overview = isLive ? undefined : await (await fetch("overview.json")).json();
const store = new Store(new Decoder(messages), about.node ?? undefined, overview?.node);
const source = isLive ? new Live(store, about) : new Recording(store, overview);
const view = new View($("canvas"), $("labels"));
/** Performers are bones until the template is here. */
async function fetchTemplate() {
  try {
    view.setTemplate(new Template(await (await fetch("body.json")).json()));
  } catch {
    setTimeout(fetchTemplate, 2000);
  }
}
fetchTemplate();
const panes = new Panes($("panes"), (name) => lookThrough(view.through?.lens.name === name ? undefined : name));
/** The scene as a camera sees it, or free again. */
function lookThrough(name) {
  if (view.error) return;
  const lens = view.lenses?.find((one) => one.name === name);
  view.lookThrough(lens && new Through(lens));
  panes.setThrough(lens?.name);
  ask();
}
const charts = new Charts($("charts"));
const figures = new Figures($("figures"));

/** What the user chose. */
const chosen = { playing: true, time: 0, speed: 1, loop: undefined, provisional: isLive };
$("name").textContent = about.name;
document.title = `${about.name} · bundlemocap`;
$("speed").parentElement.hidden = isLive;
/** Asks for what is seen: with a calibration, only for the cameras whose panes are in sight, and the one to look through. */
function ask() {
  const cameras = new Set([...panes.inSight, ...(view.through ? [view.through.lens.name] : [])]);
  for (const name of store.came.keys()) if (!cameras.has(name)) store.came.delete(name);
  source.want(chosen.provisional, store.rig ? [...cameras] : undefined);
}
panes.sightChanged = ask;
ask();

let [shownRig, framed, lastPicture, opened] = [undefined, false, performance.now(), performance.now()];
goToHash();

if (isLive) await import("./takes.js").then(({ takes }) => setInterval(takes(store, source, lookOf, (x, y) => view.floorAt(x, y)), 250));

/** The performers who are there; live, who left or has another name now is not. */
const present = () => [...store.performers.values()].filter(({ name, poses }) =>
  !isLive || (poses.times.length > 0 && (!store.stage || store.lifeOf(name) !== undefined)));

/** Names of performers that are not drawn. */
const hidden = new Set();

/** How a performer is shown: its label's name and colour, if there are any. */
function lookOf({ name, number }) {
  const { display_name, colour: own, locked } = store.labelOf(name);
  return { name, shown: display_name || name, tint: own || colour(number), locked };
}

/** Of the performers at a time, those who are drawn. */
const drawn = (people) => people.filter(({ name }) => !hidden.has(name));

/** The performers at a time, as scene and panes draw them. */
function peopleAt(time, channel) {
  const people = [];
  const unknown = isLive && chosen.playing && isNodeSilent(store) ? { state: "lost" } : {};
  for (const one of store.performers.values()) {
    const pose = one[channel].shown(time);
    if (!pose) continue;
    const parents = one.skeleton?.parents ?? PARENTS;
    const head = one.skeleton?.joint_names.indexOf("head") ?? -1;
    if (parents.length * 3 !== pose.joints.length) continue;
    const points = one.points.shown(time);
    const skin = pose.rotations.length === 4 * parents.length ? one.skin : undefined;
    people.push({ ...pose, ...unknown, ...lookOf(one), points, skin, parents, head });
  }
  return people;
}

/** Times from the due time of a pose to its picture, ms, of the newest poses. */
const toScreen = [];
let lastDue = 0;
/** The clocks are one only on the node's computer. */
const IS_HERE = isLive && ["localhost", "127.0.0.1", "[::1]"].includes(location.hostname);
/** If the page's clock and the node's are farther apart, ms, they are those of two computers. */
const SAME_CLOCK = 20;

function measureScreen(people) {
  const due = Math.max(...people.map(({ due = 0 }) => due));
  if (!IS_HERE || store.apart > SAME_CLOCK || !chosen.playing || due <= lastDue) return;
  lastDue = due;
  toScreen.push(performance.timeOrigin + performance.now() - due);
  if (toScreen.length > 120) toScreen.shift();
}

/** Pictures that were drawn, and how long the script ran for each of the last ones, ms. */
let pictures = 0;
const scripts = [];

function frame(now) {
  requestAnimationFrame(frame);
  const begin = performance.now();
  const passed = Math.min(0.2, (now - lastPicture) / 1000);
  lastPicture = now;
  const [start, end] = source.span;
  if (chosen.playing && isLive) chosen.time = end;
  else if (chosen.playing && source.isReady(chosen.time)) {
    chosen.time += passed * chosen.speed;
    chosen.time = inLoop(chosen.loop, chosen.time);
    if (chosen.time >= end) play(chosen.loop?.length === 2, end);
  }
  chosen.time = Math.min(Math.max(chosen.time, start), end);
  source.prepare(chosen.time);
  if (store.rig !== shownRig) {
    shownRig = store.rig;
    view.setRig(shownRig);
    panes.setRig(view.lenses);
    lookThrough(view.through?.lens.name);
  } else if (!shownRig) panes.setCameras([...store.keypoints.keys()].sort());
  const people = peopleAt(chosen.time, "poses");
  // Live they are ahead; what is looked at again is beside the final pose of the same time.
  const isAhead = isLive && chosen.playing;
  const newest = isAhead ? Math.max(...[...store.performers.values()].map((one) => one.provisional.last ?? 0)) : chosen.time;
  const ghosts = chosen.provisional ? peopleAt(newest, "provisional") : [];
  if (!framed && shownRig && (people.length > 0 || now - opened > 3000)) {
    framed = true;
    view.frameAll(people);
  }
  view.draw(drawn(people), drawn(ghosts));
  drawOver($("over"), view.through, store, chosen.time, drawn(people));
  panes.draw(store, chosen.time, drawn(people));
  measureScreen(people);
  pictures++;
  scripts.push(performance.now() - begin);
  if (scripts.length > 120) scripts.shift();
}

/** What changes slowly: lists, lights, charts, the timeline. */
function tick() {
  const begin = performance.now();
  source.prepare(chosen.time);
  fetchSkins(store);
  const people = peopleAt(chosen.time, "poses");
  showNode(people);
  showCameras();
  showPerformers(people);
  showOthers();
  showReceivers();
  showEvents();
  showTimeline();
  const [start, end] = source.span;
  const shown = people.find(({ name }) => name === view.followed) ?? people[0];
  const first = store.performers.get(shown?.name);
  charts.draw(store, source, chosen.time, first);
  $("empty").textContent = emptyState(people);
  $("play").textContent = chosen.playing ? "Pause" : isLive ? "Resume" : "Play";
  document.body.dataset.tick = (performance.now() - begin).toFixed(1);
}

function showNode(people) {
  const { level, words } = isLive ? nodeLight(store, source.connected) : recordingLight();
  $("node").className = `light ${level}`;
  // Live, all are expected who have not left; in a recording, those with a pose.
  const isNow = isLive && chosen.playing;
  const expected = isNow ? present().filter(({ name }) => store.lifeOf(name) !== "left").length : people.length;
  setText($("node"), `${isLive ? "node" : "file"} ${level}${words.length > 0 ? `: ${words.join("; ")}` : ""}`);
  figures.show(store, {
    time: isLive ? Infinity : chosen.time, shown: chosen.time, isLive, people, present: present().length, expected, toScreen,
  });
  $("node").title = words.join("\n");
  Object.assign(document.body.dataset, view.figures);
  const script = [...scripts].sort((a, b) => a - b);
  const [p50, p99] = [0.5, 0.99].map((share) => script[Math.floor(share * script.length)]?.toFixed(1));
  Object.assign(document.body.dataset, { pictures, script: `${p50}, ${p99}`, bytes: source.bytes });
  document.body.dataset.people = drawn(people).length;
  document.body.dataset.through = view.through?.lens.name ?? "";
  document.body.dataset.view = view.camera.position.toArray().map((metres) => metres.toFixed(2)).join(" ");
  document.body.dataset.time = chosen.time.toFixed(3);
  document.body.dataset.pelvis = Array.from(people[0]?.joints.subarray(0, 3) ?? [], (metres) => metres.toFixed(3)).join(" ");
}

function recordingLight() {
  const { damage } = source.overview;
  const { verdict } = store.historyAt(chosen.time).at(-1)?.status ?? {};
  const wrong = source.error || verdict;
  return { level: wrong ? "bad" : damage.length > 0 ? "warn" : "ok", words: wrong ? [wrong] : damage };
}

function showCameras() {
  // With a calibration the page asks for its cameras alone; of others the node tells.
  const found = isLive && store.rig ? strangers(store) : store.keypoints.keys();
  const names = new Set([...(store.rig?.cameras.map(({ name }) => name) ?? []), ...found]);
  const lights = [...names].map((name) => ({ name, ...cameraLight(store, name, isLive ? Infinity : chosen.time, about.advice) }));
  lights.sort((a, b) => RANK[b.level] - RANK[a.level]);
  const items = lights.map(({ name, level, words, advice, counters }) => {
    panes.setLight(name, level, words.join("\n"));
    const item = document.createElement("li");
    item.dataset.camera = name;
    item.dataset.level = level;
    const row = element("div", "", "row");
    row.append(element("span", level === "unknown" ? name : `${name} ${level}`, `light ${level}`));
    if (counters) row.append(element("span", `${(counters.rate_hz ?? 0).toFixed(1)} Hz`));
    if (counters?.residual_px > 0) row.append(element("span", `${counters.residual_px.toFixed(1)} px`));
    if (counters?.residual_px > 0) row.append(element("span", `${Math.round(100 * (counters.near ?? 0))} %`));
    item.append(row);
    if (words.length > 0) item.append(element("div", words.slice(0, 3).join("; "), "words"));
    item.title = [...words, ...advice].join("\n");
    return item;
  });
  replace($("cameras"), items);
  // A list of its own: the one above is made anew each second, and would lose clicks and the focus.
  const moved = lights.filter(({ counters }) => isLive && counters?.moved);
  replace($("moved"), moved.map(({ name, counters }) => {
    const item = document.createElement("li");
    const mend = element("button", `Mend ${name}`);
    mend.type = "button";
    mend.dataset.mend = name;
    mend.title = "Correct the calibration to the camera's new pose";
    item.append(mend, element("div", counters.moved, "words"));
    return item;
  }));
}

/** The row of each performer. It stays the same element, so that its buttons can be pressed while the text changes. */
const rows = new Map();

function performerRow(name) {
  const button = (text, action, style = "") => {
    const made = element("button", text, style);
    made.type = "button";
    made.dataset[action] = name;
    return made;
  };
  const [item, swatch, shown, state] = [element("li", ""), element("span", "", "swatch"), element("span", ""), element("span", "")];
  const [who, edit, hide] = [button("", "follow", "who"), button("edit", "label"), button("hide", "hide")];
  const [row, words] = [element("div", "", "row"), element("div", "locked: Reset body does not change it", "words")];
  edit.hidden = !isLive;
  who.append(swatch, shown);
  const tools = element("span", "", "tools");
  tools.append(state, edit, hide);
  row.append(who, tools);
  item.append(row, words);
  return { item, swatch, shown, state, who, edit, hide, words };
}

function showPerformers(people) {
  const all = present();
  for (const [name, { item }] of rows) {
    if (all.some((one) => one.name === name)) continue;
    item.remove();
    rows.delete(name);
  }
  for (const one of all) {
    const { name, shown, tint, locked } = lookOf(one);
    if (!rows.has(name)) rows.set(name, performerRow(name));
    const row = rows.get(name);
    if (!row.item.isConnected) $("performers").append(row.item);
    const life = ["lost", "left"].find((life) => isLive && store.lifeOf(name) === life);
    const live = isLive ? store.statusOf.get(name)?.tracker_state : undefined;
    const silent = isLive && isNodeSilent(store) ? "no news" : undefined;
    setText(row.state, silent ?? life ?? people.find((shownNow) => shownNow.name === name)?.state ?? live ?? "no pose");
    row.state.className = `light ${LEVELS[row.state.textContent] ?? "unknown"}`;
    setText(row.shown, shown);
    setText(row.hide, hidden.has(name) ? "show" : "hide");
    row.who.title = shown === name ? `follow ${name}` : `follow ${shown}, ${name} on the bus`;
    row.who.setAttribute("aria-pressed", String(view.followed === name));
    for (const button of [row.edit, row.hide]) button.setAttribute("aria-label", `${button.textContent} ${shown}`);
    row.swatch.style.background = tint;
    row.words.hidden = !locked;
  }
}

/** How good the states of performers are. */
const LEVELS = { tracking: "ok", coasting: "warn", lost: "bad" };

/** How many more people the node sees. */
function showOthers() {
  const others = isLive ? (store.stage?.others ?? 0) : 0;
  $("others").hidden = others === 0;
  $("choose").hidden = !isLive || (store.stage?.performers.some(({ name }) => name === store.node) ?? true);
  setText($("others"), `${others} more ${others === 1 ? "is" : "are"} seen, and not solved`);
}

/** What the topics of a performer are called. */
const KINDS = new Map([
  ["pose", "poses"],
  ["pose/provisional", "provisional poses"],
  ["skeleton", "bodies"],
  ["keyframe", "keyframes"],
  ["**", "everything"],
]);

/** A pattern of topics of performers in words. */
function inWords(pattern) {
  const parts = pattern.split("/");
  if (parts.slice(0, 4).includes("**")) return "everything";
  const [actor, topic] = [parts[3], parts.slice(4).join("/")];
  return `${KINDS.get(topic) ?? topic}${actor === "*" ? "" : ` of ${actor}`}`;
}

function showReceivers() {
  const { receivers } = source;
  $("receivers").previousElementSibling.hidden = receivers === undefined;
  if (receivers === undefined) return;
  const items = receivers.map(({ program, computer, session, patterns }) => {
    const item = element("li", `${program} on ${computer}`);
    item.append(element("div", [...new Set(patterns.map(inWords))].join(", "), "words"));
    item.title = [`process ${session.split(".")[0]}`, ...patterns].join("\n");
    return item;
  });
  const { received } = source;
  const isKnown = receivers.some(({ patterns }) => patterns.some((pattern) => /(^|\/)(pose|\*\*)$|\/actor\/[^/]+\/\*$/.test(pattern)));
  if (received && !isKnown) items.push(element("li", "an unknown program: poses"));
  const nobody = received === false ? "nobody receives poses" : "no other program is known";
  replace($("receivers"), items.length > 0 ? items : [element("li", nobody)]);
}

/** The event whose tick was pressed last, and the one that the list shows. */
let [pressedTick, listedTick] = [undefined, undefined];

function showEvents() {
  const past = isLive && !pressedTick ? store.events : store.events.filter(({ at }) => at <= chosen.time + 1);
  const list = (store.events.length <= 60 ? store.events : past).slice(-60).reverse();
  const key = `${store.events.length} ${list.length} ${list[0]?.at} ${pressedTick?.at}`;
  if ($("events").dataset.key === key) return;
  $("events").dataset.key = key;
  $("events").replaceChildren(...list.map((event) => {
    const { at, kind, camera, actor, detail, count } = event;
    const item = document.createElement("li");
    const where = [camera, actor].filter(Boolean).join(", ");
    const times = count > 1 ? ` x ${count}` : "";
    const button = element("button", `${at.toFixed(2)} s  ${kind.replaceAll("_", " ")}${times}${where ? ` (${where})` : ""}  ${detail}`, `light ${levelOf(event)}`);
    button.type = "button";
    button.addEventListener("click", () => goTo(at));
    if (event === pressedTick) button.setAttribute("aria-current", "true");
    item.append(button);
    return item;
  }));
  if (pressedTick !== listedTick) $("events").querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
  listedTick = pressedTick;
}

const SHADES = { tracking: 1, coasting: 0.45, lost: 0.12 };

function showTimeline() {
  const [start, end] = source.span;
  const length = Math.max(end - start, 1e-6);
  const place = (time) => (100 * (time - start)) / length;
  $("cursor").style.left = `${place(chosen.time)}%`;
  const behind = end - chosen.time;
  setText($("clock"), isLive
    ? (chosen.playing ? "live" : `${behind.toFixed(2)} s ago`)
    : `${chosen.time.toFixed(2)} of ${end.toFixed(2)} s`);
  const bar = $("timeline");
  bar.setAttribute("aria-valuemax", length.toFixed(2));
  bar.setAttribute("aria-valuenow", (chosen.time - start).toFixed(2));
  bar.setAttribute("aria-valuetext", $("clock").textContent);
  drawRuns($("runs"), place);
  const ticks = store.events.filter(({ at }) => at >= start && at <= end);
  const key = `${ticks.length} ${start.toFixed(1)}`;
  if ($("ticks").dataset.key === key) return;
  $("ticks").dataset.key = key;
  // The worst of those in one place.
  const worst = new Map();
  for (const event of ticks) {
    const column = Math.round(10 * place(event.at));
    if (!worst.has(column) || RANK[levelOf(event)] > RANK[levelOf(worst.get(column))]) worst.set(column, event);
  }
  $("ticks").replaceChildren(...Array.from(worst.values(), (event) => {
    const { at, kind, detail } = event;
    const tick = element("i", "", levelOf(event));
    tick.title = `${at.toFixed(2)} s ${kind.replaceAll("_", " ")}: ${detail}`;
    tick.style.left = `${place(at)}%`;
    return tick;
  }));
}

/** The states of the performers over time, a line each: solid is tracking, pale is coasting or lost. */
function drawRuns(canvas, place) {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, width, height);
  if (chosen.loop) {
    const [left, right] = [chosen.loop[0], chosen.loop[1] ?? chosen.time].map((time) => (place(time) / 100) * width);
    context.fillStyle = "#8a8f9866";
    context.fillRect(Math.min(left, right), 0, Math.max(1, Math.abs(right - left)), height);
  }
  const all = present();
  const line = Math.min(6, (height - 8) / Math.max(all.length, 1));
  all.forEach((one, row) => {
    context.fillStyle = lookOf(one).tint;
    for (const { from, to, state } of isLive ? liveRuns(one.poses) : source.overview.performers[one.name] ?? []) {
      context.globalAlpha = SHADES[state];
      const [left, right] = [from, to].map((time) => (place(time) / 100) * width);
      context.fillRect(left, 8 + row * line, Math.max(1, right - left), Math.max(1, line - 1));
    }
  });
  context.globalAlpha = 1;
}

function liveRuns({ times, items }) {
  const runs = [];
  times.forEach((time, k) => {
    const last = runs.at(-1);
    const { state } = items[k];
    if (last && last.state === state && time - last.to < 0.2) last.to = time;
    else runs.push({ from: time, to: time, state });
  });
  return runs;
}

function emptyState(people) {
  if (source.error && (people.length === 0 || !source.connected)) return source.error;
  if (view.error) return view.error;
  if (people.length > 0) return "";
  if (!isLive) return store.performers.size === 0 ? "This recording has no poses.\nRun `bundlemocap solve` on it." : "";
  if (!source.connected) return "No connection. It is tried again.";
  if (performance.now() - opened < 2500) return "";
  if (store.keypoints.size === 0) {
    source.lookAround();
    const others = [...store.otherStages];
    const cameras = (count) => `${count} camera${count === 1 ? "" : "s"}`;
    const words = others.map(([name, all]) => `mocap/${name}, ${cameras(all.size)}`);
    const seen = words.length > 0 ? ` Seen: ${words.join("; ")}.` : "";
    return `No keypoints on mocap/${about.name}.${seen}\nStart the detectors, or check the stage and the address in their settings.`;
  }
  if (!store.rig) return `Keypoints of ${store.keypoints.size} cameras.\nWaiting for a calibration: publish it, or start the node with --rig.`;
  if (store.statusCame === undefined) return "Keypoints and a calibration are here, but no node answers.\nStart `bundlemocap run`.";
  return "Nobody is tracked. The node finds a person within a second if two cameras see the person. The settings may limit the place and the size.";
}

function element(tag, text, className) {
  const one = document.createElement(tag);
  if (text) one.textContent = text;
  if (className) one.className = className;
  return one;
}

function setText(one, text) {
  if (one.textContent !== text) one.textContent = text;
}

/** Replaces the items of a list if they differ. */
function replace(list, items) {
  const html = items.map((item) => item.outerHTML).join("");
  if (list.dataset.html === html) return;
  list.dataset.html = html;
  list.replaceChildren(...items);
}

function play(on, from) {
  const [start, end] = source.span;
  chosen.playing = on;
  if (on) pressedTick = undefined;
  if (on && !isLive && (from ?? chosen.time) >= end) chosen.time = start;
  remember();
}

function goTo(time) {
  const [start, end] = source.span;
  chosen.playing = false;
  chosen.time = Math.min(Math.max(time, start), end);
  remember();
}

/** The next pose of a performer in a direction; without poses, the next keypoints of a camera. */
function step(direction) {
  chosen.playing = false;
  const longest = (all) => all.map(({ times }) => times).sort((a, b) => b.length - a.length)[0] ?? [];
  const poses = longest([...store.performers.values()].map((one) => one.poses));
  const times = poses.length > 0 ? poses : longest([...store.keypoints.values()]);
  const next = direction > 0 ? times.find((time) => time > chosen.time + 1e-4) : times.findLast((time) => time < chosen.time - 1e-4);
  if (next !== undefined) chosen.time = next;
  remember();
}

let [remembered, remembering] = [-Infinity, undefined];
/** Notes the time in the address, at most a few times a second: browsers refuse more. */
function remember() {
  if (isLive || remembering) return;
  const wait = remembered + 250 - performance.now();
  if (wait > 0) {
    remembering = setTimeout(() => {
      remembering = undefined;
      remember();
    }, wait);
    return;
  }
  remembered = performance.now();
  history.replaceState(null, "", `#t=${chosen.time.toFixed(2)}`);
}

function goToHash() {
  const time = Number(/t=([\d.]+)/.exec(location.hash)?.[1]);
  if (isLive || !Number.isFinite(time)) return;
  [chosen.playing, chosen.time] = [false, time];
}

function setSpeed(speed) {
  chosen.speed = speed;
  $("speed").value = String(speed);
}

/** Bodies, or bones. */
function showBodies(on) {
  view.showSkins = on;
  $("bodies").setAttribute("aria-pressed", String(on));
}

function showProvisional(on) {
  chosen.provisional = on;
  $("provisional").setAttribute("aria-pressed", String(on));
  ask();
}

function showAll() {
  lookThrough();
  view.frameAll(drawn(peopleAt(chosen.time, "poses")));
}

function loop() {
  if (isLive) return;
  chosen.loop = press(chosen.loop, chosen.time, source.span[1]);
  setText($("loop"), NEXT[chosen.loop?.length ?? 0]);
}

/** Follows a performer, or nobody. */
function follow(name) {
  view.followed = view.followed === name ? undefined : name;
}

$("performers").addEventListener("click", ({ target }) => {
  const { follow: followed, hide } = target.closest("button")?.dataset ?? {};
  if (followed !== undefined) follow(followed);
  if (hide !== undefined && !hidden.delete(hide)) hidden.add(hide);
  tick();
});
$("play").addEventListener("click", () => play(!chosen.playing));
$("back").addEventListener("click", () => step(-1));
$("forward").addEventListener("click", () => step(1));
$("speed").addEventListener("change", ({ target }) => setSpeed(Number(target.value)));
$("loop").addEventListener("click", loop);
$("all").addEventListener("click", showAll);
$("bodies").addEventListener("click", () => showBodies(!view.showSkins));
$("provisional").addEventListener("click", () => showProvisional(!chosen.provisional));
$("provisional").setAttribute("aria-pressed", String(chosen.provisional));
function help() {
  $("help").showModal();
  $("keys").setAttribute("aria-expanded", "true");
}
$("keys").addEventListener("click", help);
$("help").addEventListener("close", () => $("keys").setAttribute("aria-expanded", "false"));
// Space and arrows are for the picture, not for the button that a pointer has pressed last.
addEventListener("click", ({ detail, target }) => {
  if (detail > 0 && !target.closest("dialog")) target.closest("button")?.blur();
}, { capture: true });
$("loop").hidden = isLive;
addEventListener("hashchange", goToHash);

const bar = $("timeline");
let pressedAt = 0;
function scrub({ clientX, buttons, type }) {
  if (type === "pointerdown") pressedAt = clientX;
  else if (buttons === 0 || (pressedTick && Math.abs(clientX - pressedAt) < 5)) return;
  const { left, width } = bar.getBoundingClientRect();
  const [start, end] = source.span;
  const timeAt = (x) => start + Math.min(1, Math.max(0, (x - left) / width)) * (end - start);
  const time = timeAt(clientX);
  const far = ({ at }) => Math.abs(at - time);
  const nearest = store.events.reduce((best, event) => (best && far(best) <= far(event) ? best : event), undefined);
  // Its words are shown in the list, for there is no tooltip under a finger.
  const isPressed = type === "pointerdown" && nearest && far(nearest) < timeAt(clientX + 5) - timeAt(clientX - 5);
  pressedTick = isPressed ? nearest : undefined;
  goTo(pressedTick?.at ?? time);
}
bar.addEventListener("pointerdown", (event) => {
  bar.setPointerCapture(event.pointerId);
  scrub(event);
});
bar.addEventListener("pointermove", scrub);
$("canvas").addEventListener("dblclick", ({ clientX, clientY }) => {
  follow(view.pick(clientX, clientY, drawn(peopleAt(chosen.time, "poses"))));
});

const KEYS = {
  " ": () => play(!chosen.playing),
  ArrowLeft: () => step(-1),
  ArrowRight: () => step(1),
  "[": () => setSpeed(SPEEDS[Math.max(0, SPEEDS.indexOf(chosen.speed) - 1)]),
  "]": () => setSpeed(SPEEDS[Math.min(SPEEDS.length - 1, SPEEDS.indexOf(chosen.speed) + 1)]),
  f: showAll,
  m: () => showBodies(!view.showSkins),
  p: () => showProvisional(!chosen.provisional),
  l: loop,
  "?": help,
};
/** What Page Up and Page Down go on or back, seconds. */
const LONG_STEP = 1;
/** Keys of the timeline. */
const OF_TIMELINE = {
  Home: () => goTo(source.span[0]),
  End: () => (isLive ? play(true) : goTo(source.span[1])),
  PageUp: () => goTo(chosen.time + LONG_STEP),
  PageDown: () => goTo(chosen.time - LONG_STEP),
};
addEventListener("keydown", (event) => {
  const { key, target, ctrlKey, metaKey, altKey } = event;
  if (ctrlKey || metaKey || altKey || target.closest("input, select, dialog") || (key === " " && target.closest("button"))) return;
  const keys = target === bar ? { ...KEYS, ...OF_TIMELINE } : KEYS;
  const act = /^[0-9]$/.test(key) ? () => lookThrough(store.rig?.cameras[Number(key) - 1]?.name) : keys[key.length === 1 ? key.toLowerCase() : key];
  if (!act) return;
  event.preventDefault();
  act();
});

requestAnimationFrame(frame);
setInterval(tick, 250);
tick();
