// The page of recordings, reports and live stages.

import assert from "node:assert/strict";
import { readFileSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { join } from "node:path";
import { test } from "node:test";
import { McapIndexedReader } from "@mcap/core";
import { decompress as zstd } from "fzstd";
import protobuf from "protobufjs";
import descriptor from "protobufjs/ext/descriptor/index.js";
import { Template, metres } from "../../src/io/report/scene/body.js";
import { lensOf, project, ray } from "../../src/io/report/scene/lens.js";
import { folder, freePort, isSound, open, people, picture, root, run, shown, start, status, stop, until } from "./browser.mjs";

test("a recording plays, is scrubbed, and keeps its place in the address", async () => {
  run("solve", join(root, "recordings/walk.mcap"), "--out", join(folder, "walk"));
  const poses = join(folder, "walk/poses.mcap");
  const { child, match } = await start(["view", poses, "--listen", "127.0.0.1:0"], /open (\S+)/);
  const { page, said } = await open(`${match[1]}#t=1.50`);
  await people(page, 1);
  assert.equal((await shown(page)).time, "1.500");
  const skins = (wanted) => until(page, (count) => document.body.dataset.skins === count, wanted);
  await skins("1");
  await page.keyboard.press("m");
  await skins("0");
  await page.keyboard.press("m");
  await skins("1");
  await page.keyboard.press("ArrowRight");
  await until(page, () => document.body.dataset.time === "1.517");
  await until(page, () => location.hash === "#t=1.52");
  await page.keyboard.press("ArrowLeft");
  await until(page, () => document.body.dataset.time === "1.500");
  // What `solve` found out about the cameras.
  await until(page, () => document.querySelectorAll('#cameras [data-level="ok"]').length === 4);
  await picture(page, "recording");

  const bar = await page.locator("#timeline").boundingBox();
  await page.locator("#timeline").focus();
  for (const [key, time] of [["End", 3.98], ["PageDown", 2.98], ["Home", 0]]) {
    await page.keyboard.press(key);
    await until(page, (wanted) => Math.abs(Number(document.body.dataset.time) - wanted) < 0.03, time);
  }
  await page.mouse.click(bar.x + bar.width / 4, bar.y + bar.height / 2);
  await until(page, () => Math.abs(Number(document.body.dataset.time) - 1) < 0.02);
  await page.keyboard.press("]");
  assert.equal(await page.locator("#speed").inputValue(), "2");
  // It is dragged too.
  await page.mouse.move(bar.x + bar.width / 4, bar.y + bar.height / 2);
  await page.mouse.down();
  await page.mouse.move(bar.x + bar.width / 2, bar.y + bar.height / 2, { steps: 4 });
  await page.mouse.up();
  await until(page, () => Math.abs(Number(document.body.dataset.time) - 2) < 0.02);
  await page.keyboard.press("[");
  assert.equal(await page.locator("#speed").inputValue(), "1");
  await page.mouse.click(bar.x + bar.width / 4, bar.y + bar.height / 2);
  await page.keyboard.press(" ");
  await until(page, () => Number(document.body.dataset.time) > 2);
  await people(page, 1);
  // It ends by itself.
  await until(page, () => document.getElementById("play").textContent === "Play");

  const free = (await shown(page)).view;
  await page.keyboard.press("1");
  await until(page, () => document.body.dataset.through === "cam01");
  await page.locator("#over").waitFor();
  // A blank picture has less than a tenth of that.
  const seen = await page.screenshot({ clip: await page.locator("#scene").boundingBox() });
  assert.ok(seen.length > 15_000, `a picture of ${seen.length} bytes`);
  await picture(page, "through");
  await page.keyboard.press("0");
  await until(page, () => document.body.dataset.through === "");
  await page.locator('#panes [data-camera="cam02"]').click();
  await until(page, () => document.body.dataset.through === "cam02");
  await page.keyboard.press("1");
  await page.locator('#panes [data-camera="cam01"][aria-pressed="true"]').waitFor();
  await page.keyboard.press("f");
  await until(page, () => document.body.dataset.through === "");
  assert.equal(await page.locator('#panes [aria-pressed="true"]').count(), 0);
  // The wheel goes nearer, F shows everything again.
  const scene = await page.locator("#canvas").boundingBox();
  await page.mouse.move(scene.x + scene.width / 2, scene.y + scene.height / 2);
  await page.mouse.wheel(0, -600);
  await until(page, (before) => document.body.dataset.view !== before, free);
  await page.keyboard.press("f");
  await until(page, (before) => document.body.dataset.view === before, free);
  // A double click on a performer, whose name is above the head.
  const tag = await page.locator("#labels span", { hasText: "actor" }).boundingBox();
  await page.mouse.dblclick(tag.x + tag.width / 2, tag.y + tag.height / 2 + 12);
  await until(page, () => document.querySelector('[data-follow="actor"]').getAttribute("aria-pressed") === "true");
  await page.locator('[data-follow="actor"]').click();
  // L loops from one place to another.
  const loopText = () => page.locator("#loop").textContent();
  const goTo = async (share) => {
    await page.mouse.click(bar.x + bar.width * share, bar.y + bar.height / 2);
    await until(page, (at) => Math.abs(Number(document.body.dataset.time) - at) < 0.03, 4 * share);
  };
  await goTo(0.75);
  await page.keyboard.press("l");
  assert.equal(await loopText(), "Loop to here");
  await goTo(0.5);
  await page.keyboard.press("l");
  assert.equal(await loopText(), "End loop");
  await page.keyboard.press(" ");
  await until(page, () => Number(document.body.dataset.time) > 2.8);
  await until(page, () => Number(document.body.dataset.time) < 2.5);
  await page.keyboard.press(" ");
  await page.keyboard.press("l");
  assert.equal(await loopText(), "Loop from here");
  const event = page.locator("#events button").first();
  await event.click();
  const at = parseFloat(await event.textContent());
  await until(page, (wanted) => Math.abs(Number(document.body.dataset.time) - wanted) < 0.01, at);
  await isSound(page);
  await page.keyboard.press("?");
  await page.locator("#help[open]").waitFor();
  await isSound(page);
  await page.keyboard.press("Escape");
  assert.deepEqual(said, []);
  await page.close();

  const tablet = { viewport: { width: 820, height: 1180 }, hasTouch: true, colorScheme: "dark" };
  const dark = await open(`${match[1]}#t=2`, tablet);
  await people(dark.page, 1);
  const colours = await dark.page.evaluate(() => {
    const { color, backgroundColor } = getComputedStyle(document.body);
    return [color, backgroundColor].map((text) => Number(/\d+/.exec(text)[0]));
  });
  assert.ok(colours[0] > 180 && colours[1] < 60, `${colours}`);
  for (const count of ["0", "1"]) {
    await dark.page.locator("#bodies").tap();
    await until(dark.page, (wanted) => document.body.dataset.skins === wanted, count);
  }
  await dark.page.locator("#all").tap();
  await dark.page.locator('[data-follow="actor"]').tap();
  await until(dark.page, () => document.querySelector('[data-follow="actor"]').getAttribute("aria-pressed") === "true");
  await isSound(dark.page);
  await picture(dark.page, "tablet");
  assert.deepEqual(dark.said, []);
  await dark.page.close();

  // A phone: one below the other.
  const phone = await open(`${match[1]}#t=2`, { viewport: { width: 390, height: 844 }, hasTouch: true });
  await people(phone.page, 1);
  const { width, height } = await phone.page.locator("#scene").boundingBox();
  assert.ok(width > 350 && height > 350, `a scene of ${width} x ${height}`);
  await isSound(phone.page);
  await picture(phone.page, "phone");
  await phone.page.close();

  const first = () => {
    const { getContext } = HTMLCanvasElement.prototype;
    HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
      return kind.startsWith("webgl") ? null : getContext.call(this, kind, ...more);
    };
  };
  const flat = await open(`${match[1]}#t=2`, { first });
  await until(flat.page, () => document.getElementById("empty").textContent.includes("WebGL"));
  await until(flat.page, () => document.querySelectorAll("#cameras [data-level]").length === 4);
  await flat.page.keyboard.press("1");
  await flat.page.keyboard.press("ArrowRight");
  await until(flat.page, () => Number(document.body.dataset.time) > 2.01);
  assert.deepEqual(flat.said.filter((line) => !line.includes("WebGL")), []);
  await flat.page.close();

  run("solve", join(root, "recordings/walk.mcap"), "--out", join(folder, "walk"), "--overwrite");
  const changed = await open(match[1]);
  await until(changed.page, () => document.getElementById("node").textContent.includes("has changed since it was opened"));
  await changed.page.close();
  await stop(child);
});

test("a recording of a stage shows each camera's state, and README's picture is made", async () => {
  const { match } = await start(["view", join(root, "recordings/disturbed.mcap"), "--listen", "127.0.0.1:0"], /open (\S+)/);
  const { page, said } = await open(`${match[1]}#t=2`);
  await people(page, 1);
  await until(page, () => document.querySelectorAll("#cameras > *").length === 4);
  await until(page, () => /warn|bad/.test(document.getElementById("cameras").textContent));
  // The states of the seconds before are read by then.
  await until(page, () => /in 5 s/.test(document.getElementById("cameras").textContent));
  await until(page, () => document.querySelector("#panes .light.warn") && document.body.dataset.skins === "1");
  await picture(page, "view");
  await isSound(page);
  // A tick is pressed: its words are in the list.
  assert.match(await page.locator("#ticks i").nth(20).getAttribute("title"), /^\d+\.\d\d s [a-z ]+: ./);
  const tick = await page.locator("#ticks i").nth(20).boundingBox();
  await page.mouse.click(tick.x + 1, tick.y + 3);
  await until(page, () => {
    const event = document.querySelector('#events [aria-current="true"]');
    return Math.abs(parseFloat(event?.textContent) - Number(document.body.dataset.time)) < 0.006;
  });
  // Provisional poses of a recording are read when they are wanted.
  assert.equal((await shown(page)).ghosts, "0");
  await page.keyboard.press("p");
  await until(page, () => document.body.dataset.ghosts === "1");
  assert.deepEqual(said, []);
});

test("the skin of the page is the skin of the library", async () => {
  const { match } = await start(["view", join(folder, "walk/poses.mcap"), "--listen", "127.0.0.1:0"], /open (\S+)/);
  const wanted = JSON.parse(readFileSync(join(root, "tests/golden/skin.json"), "utf8"));
  const template = new Template(await (await fetch(`${match[1]}body.json`)).json());
  const answer = await fetch(`${match[1]}rest?offsets=${wanted.offsets}`);
  const rest = metres(new Int16Array(await answer.arrayBuffer()));
  const { joints, rotations, offsets } = wanted;
  const moved = template.forward(offsets, joints.slice(0, 3), rotations);
  joints.forEach((x, k) => assert.ok(Math.abs(moved[k] - x) < 2e-4, `joint ${k / 3}: ${moved[k]}, not ${x}`));
  const matrices = new Float32Array(16 * template.turns.length);
  template.pose(offsets, joints, rotations, matrices);
  for (const [vertex, at] of Object.entries(wanted.vertices)) {
    const sum = [0, 0, 0];
    for (let k = 4 * vertex; k < 4 * vertex + 4; k++) {
      const m = 16 * template.bones.array[k];
      const [x, y, z] = rest.subarray(3 * vertex, 3 * vertex + 3);
      const weight = template.weights.array[k] / 255;
      sum.forEach((_, row) => {
        sum[row] += weight * (matrices[m + row] * x + matrices[m + 4 + row] * y + matrices[m + 8 + row] * z + matrices[m + 12 + row]);
      });
    }
    const off = Math.hypot(...sum.map((x, row) => x - at[row]));
    // The page's weights have 8 bits.
    assert.ok(off < 2e-3, `vertex ${vertex}: ${off} m`);
  }
});

test("a light says what is wrong with a camera, and no longer than that", async () => {
  const { match } = await start(["view", join(folder, "walk/poses.mcap"), "--listen", "127.0.0.1:0"], /open (\S+)/);
  const { page, said } = await open(match[1]);
  await people(page, 1);
  const found = await page.evaluate(async () => {
    const { cameraLight } = await import("./lights.js");
    const events = [];
    const counters = { camera: "cam01", rate_hz: 60, age_s: 0, waited_for: true, residual_px: 5, usual_px: 5, near: 0.9 };
    const statuses = [{ at: 0, seconds: 0, status: { run_id: 7n, cameras: [counters], events: [] } }];
    const store = {
      events, rig: { cameras: [{ name: "cam01" }] }, keypoints: new Map(), statusCame: performance.now(),
      newest: 0, historyAt: () => statuses, nanoseconds: (at) => 1_800_000_000_000_000_000n + BigInt(at) * 1_000_000_000n,
    };
    const light = () => {
      const { level, words } = cameraLight(store, "cam01", Infinity, {});
      return [level, ...words];
    };
    const found = { fine: light() };
    counters.near = 0;
    found.far = light();
    counters.near = 0.9;
    counters.verdict = "turned by 3 degrees";
    found.judged = light();
    counters.verdict = "";
    const off = (detail, run) => events.push({ kind: "clock_offset", camera: "cam01", detail, run, at: -100 });
    off("+6.0 ms off from the other cameras, limit 4.2", 7n);
    found.off = light();
    off("in time again: +1.0 ms off from the other cameras, limit 4.2", 7n);
    found.again = light();
    off("+6.0 ms off from the other cameras, limit 4.2", 6n);
    found.ofEarlierRun = light();
    Object.assign(counters, { silent: true, age_s: 0.71 });
    found.silent = light();
    Object.assign(counters, { silent: false, age_s: 0 });
    const others = ["cam02", "cam03"].map((camera) => ({ ...counters, camera }));
    statuses[0].status.cameras.push(...others);
    counters.rate_hz = 30;
    found.slow = light();
    counters.rate_hz = 60;
    counters.residual_px = 10;
    found.worse = light();
    counters.residual_px = 20;
    found.bad = light();
    counters.residual_px = 5;
    Object.assign(store.rig.cameras[0], { width: 1280, height: 720 });
    store.keypoints.set("cam01", { items: [{ size: [640, 480] }] });
    found.size = light();
    store.rig.cameras[0].name = "cam02";
    found.stranger = light();
    return found;
  });
  for (const name of ["fine", "again", "ofEarlierRun"]) assert.equal(found[name][0], "ok", `${name}: ${found[name]}`);
  assert.match(found.far.join(" "), /^warn only 0 % of its points/);
  assert.deepEqual(found.judged, ["bad", "turned by 3 degrees"]);
  assert.match(found.off.join(" "), /^warn \+6\.0 ms off .*, since \d\d:\d\d$/);
  assert.match(found.silent.join(" "), /^bad no frame for 0\.7 s$/);
  assert.deepEqual(found.slow, ["warn", "30.0 of 60 frames a second"]);
  assert.deepEqual(found.worse, ["warn", "residual 10.0 px, usually 5.0"]);
  assert.deepEqual(found.bad, ["bad", "residual 20.0 px, usually 5.0"]);
  assert.deepEqual(found.size, ["bad", "its images are 640 x 480, the calibration's 1280 x 720"]);
  assert.deepEqual(found.stranger.slice(0, 2), ["bad", "not in the calibration"]);
  assert.deepEqual(said, []);
});

test("each figure at the top is judged", async () => {
  const { match } = await start(["view", join(folder, "walk/poses.mcap"), "--listen", "127.0.0.1:0"], /open (\S+)/);
  const { page } = await open(match[1]);
  const found = await page.evaluate(async () => {
    const { Figures } = await import("./figures.js");
    const list = document.createElement("dl");
    const figures = new Figures(list);
    const playout = {
      published: 100n, missed: 0n, coasted: 0n, deviation_bins_us: [100, 2000, 50_000], deviation_counts: [99, 1, 0, 0],
      provisional_bins_us: [10_000, 100_000], provisional_counts: [100, 0, 0],
    };
    const windows = { age_p50_ms: 150, age_p99_ms: 180, solve_p50_ms: 2, solve_p99_ms: 5 };
    const status = (more) => ({ run_id: 7n, cameras: [], events: [], declared_latency_ns: 200_000_000n, playout, windows, ...more });
    const poses = { items: Array.from({ length: 121 }, () => ({ late: 1 })), times: Array.from({ length: 121 }, (_, k) => k / 60) };
    poses.after = (time) => poses.times.filter((at) => at <= time).length;
    const shownOf = (last, people, times, expected = 2) => {
      const none = { ...playout, deviation_counts: [0, 0, 0, 0], provisional_counts: [0, 0, 0] };
      const history = [{ at: 0, seconds: 0, status: status({ playout: none }) }, { at: 1, seconds: 1, status: last }];
      const performers = new Map(["p1", "p2"].map((name) => [name, { poses }]));
      for (const one of poses.items) one.late = last.late ?? 1;
      const store = { performers, historyAt: () => history, nanoseconds: () => 0n, unreadable: 0, dropped: 0 };
      figures.show(store, { time: 1, shown: 1.5, isLive: true, people, present: 2, expected, toScreen: times });
      return Object.fromEntries(Array.from(list.children, ({ firstChild, lastChild }) => [
        firstChild.textContent, `${lastChild.className.replace("light ", "")} ${lastChild.textContent}`,
      ]));
    };
    const [p1, p2] = ["p1", "p2"].map((name) => ({ name, state: "tracking" }));
    const late = { ...playout, missed: 3n, deviation_counts: [99, 1, 0, 40], provisional_counts: [100, 0, 200] };
    const slow = { age_p50_ms: 150, age_p99_ms: 190, solve_p50_ms: 40, solve_p99_ms: 90 };
    return {
      fine: shownOf(status({}), [p1, p2], [20]),
      bad: shownOf(status({ playout: late, windows: slow }), [p1, { ...p2, state: "lost" }], [20, 400]),
      late: shownOf(status({ playout: { ...playout, coasted: 2n }, windows: { ...slow, age_p50_ms: 210, age_p99_ms: 300 }, late: 70 }), [], []),
      new: shownOf(status({ playout: undefined, windows: undefined }), [p1], [], 1),
      nobody: shownOf(status({}), [], [], 0),
    };
  });
  assert.deepEqual(found.fine, {
    tracking: "ok 2 of 2", latency: "ok 200 ms", poses: "ok 60.0 Hz", publishing: "ok ≤0.1 / ≤0.1 / ≤2 ms",
    provisional: "ok ≤10 / ≤10 / ≤10 ms", window: "ok 150 / 180 ms", solve: "ok 2.0 / 5.0 ms", network: "ok 1.0 / 1.0 ms",
    "to the screen": "ok 20.0 / 20.0 ms",
  });
  assert.deepEqual(found.bad, {
    tracking: "warn 1 of 2", latency: "warn 200 ms", poses: "bad 60.0 Hz", publishing: "warn ≤0.1 / >50 / >50 ms",
    provisional: "bad >100 / >100 / >100 ms", window: "ok 150 / 190 ms", solve: "warn 40.0 / 90.0 ms", network: "ok 1.0 / 1.0 ms",
    "to the screen": "bad 400.0 / 400.0 ms",
  });
  // Of late windows, the solve is not the cause. The clock of another computer may be wrong.
  assert.deepEqual(found.late, {
    tracking: "bad 0 of 2", latency: "bad 200 ms", poses: "warn 60.0 Hz", publishing: "ok ≤0.1 / ≤0.1 / ≤2 ms",
    provisional: "ok ≤10 / ≤10 / ≤10 ms", window: "bad 210 / 300 ms", solve: " 40.0 / 90.0 ms", network: "warn 70.0 / 70.0 ms",
  });
  assert.deepEqual(found.new, { tracking: "ok 1 of 2", latency: " 200 ms", poses: " 60.0 Hz", network: "ok 1.0 / 1.0 ms" });
  assert.equal(found.nobody.tracking, " 0 of 2");
});

test("a lens has a ray for each pixel", () => {
  const plain = { width: 1920, height: 1080, focal_px: [1100, 1120], centre_px: [1000, 500], skew_px: 1.5,
    camera_from_world_rotation: [0, 0, 0, 1], camera_from_world_translation_m: [0, 0, 0], lens: 1 };
  const lenses = [
    {}, { lens_coefficients: [-0.28, 0.09, 0.001, -0.002, -0.01] }, { lens: 2, lens_coefficients: [0.03, -0.01, 0.002, 0] },
  ];
  // This one folds: its corners show nothing, and what is far aside does not come back into the image.
  const folding = lensOf({ ...plain, skew_px: 0, lens_coefficients: [-0.2] });
  assert.equal(ray(folding, 1, 1), undefined);
  assert.ok(ray(folding, 300, 540)[0] < -0.6);
  assert.equal(project(folding, 6, 0, 3), undefined);
  assert.equal(project(lensOf({ ...plain, lens_coefficients: [-0.01] }), 29, 0, 3), undefined);
  assert.ok(project(folding, 1, 0, 3)[0] > 1300);
  for (const lens of lenses.map((one) => lensOf({ ...plain, ...one }))) {
    for (const [u, v] of [[1, 1], [1919, 1079], [1000, 500], [300, 900], [1700, 20]]) {
      const [x, y] = ray(lens, u, v);
      const [back, below] = project(lens, 3 * x, 3 * y, 3);
      assert.ok(Math.hypot(back - u, below - v) < 2e-3, `${lens.lens}: ${u}, ${v} gives ${back}, ${below}`);
    }
  }
});

test("the report of a solve plays the take, without a server", async () => {
  const { page, said } = await open(`file://${join(folder, "walk/report.html")}#t=1.00`);
  await people(page, 1);
  assert.equal((await shown(page)).time, "1.00");
  await page.locator("#play").click();
  await until(page, () => Number(document.body.dataset.time) > 1.3);
  const link = page.locator(".moments a").first();
  await link.click();
  await until(page, (text) => `${document.body.dataset.time} s` === text, await link.textContent());
  // The keys of the live page: a frame on, twice the speed, and two seconds again and again.
  await page.evaluate(() => (location.hash = "#t=1.00"));
  await until(page, () => document.body.dataset.time === "1.00");
  await page.keyboard.press("ArrowRight");
  await until(page, () => document.body.dataset.time === "1.02");
  await page.keyboard.press("]");
  assert.equal(await page.locator("#speed").inputValue(), "2");
  await page.keyboard.press("l");
  await page.keyboard.press("l");
  assert.equal(await page.locator("#loop").textContent(), "End loop");
  await page.keyboard.press(" ");
  await until(page, () => Number(document.body.dataset.time) > 1.9);
  await until(page, () => Number(document.body.dataset.time) < 0.5);
  await page.keyboard.press(" ");
  await picture(page, "report");
  await isSound(page);
  assert.deepEqual(said, []);
  await page.close();
});

test("four performers, and two solves of a take, are shown together", async () => {
  const take = join(folder, "four.mcap");
  run("synth", "--performers", "4", "--cameras", "4", "--seconds", "3", "--out", take);
  run("solve", take, "--performers", "auto", "--out", join(folder, "four"));
  const poses = join(folder, "four/poses.mcap");
  const { match } = await start(["view", poses, take, poses, "--listen", "127.0.0.1:0"], /open (\S+)/);
  const { page, said } = await open(`${match[1]}#t=1.5`);
  await people(page, 8);
  const names = await page.locator("#performers .who").allTextContents();
  assert.deepEqual(names.sort(), ["p1", "p1 (3)", "p2", "p2 (3)", "p3", "p3 (3)", "p4", "p4 (3)"]);
  // The bodies lie over the keypoints that they are from.
  const caption = "#panes .caption span:last-child";
  await until(page, (all) => Array.from(document.querySelectorAll(all)).filter((one) => /px$/.test(one.textContent)).length === 4, caption);
  const errors = await page.locator(caption).allTextContents();
  for (const text of errors) assert.ok(parseFloat(text) < 20, `a median of ${text}`);
  // A pane is drawn anew when something in it changes.
  const before = await page.locator("#panes canvas").first().evaluate((canvas) => canvas.toDataURL());
  const isDrawn = (wanted) => until(page, ([was, isSame]) => {
    return (document.querySelector("#panes canvas").toDataURL() === was) === isSame;
  }, [before, wanted]);
  await page.locator('[data-hide="p1 (3)"]').click();
  await people(page, 7);
  await isDrawn(false);
  await page.locator('[data-hide="p1 (3)"]').click();
  await people(page, 8);
  await isDrawn(true);
  await page.locator('[data-hide="p1 (3)"]').click();
  await people(page, 7);
  await page.locator('[data-follow="p2"]').click();
  await until(page, () => document.querySelector('[data-follow="p2"]').getAttribute("aria-pressed") === "true");
  await picture(page, "four");
  await isSound(page);
  assert.deepEqual(said, []);
  await page.close();
  const report = await open(`file://${join(folder, "four/report.html")}#t=1.50`);
  await people(report.page, 4);
  assert.deepEqual(report.said, []);
  await report.page.close();
});

test("a live stage: a pose moves, a dead camera is red, a node that restarts is found again", async () => {
  const [bus, http] = [await freePort(), await freePort()];
  const node = ["run", "--listen", `tcp/127.0.0.1:${bus}`, "--view", `127.0.0.1:${http}`];
  const first = await start(node, /the page is on (\S+)/);
  const { page, said } = await open(first.match[1]);
  await until(page, () => document.getElementById("empty").textContent.startsWith("No keypoints on mocap/stage."));
  // A take may begin before the cameras send. A key for the picture does not press the button again.
  await page.locator("#take-name").fill("early");
  await page.locator("#record").click();
  await page.keyboard.press(" ");
  await until(page, () => document.getElementById("play").textContent === "Resume");
  await page.keyboard.press(" ");
  await until(page, () => /^● early no frames Stop$/.test(document.getElementById("record").textContent));
  assert.match(await page.locator("#answers").textContent(), /no recorder is known/);
  await page.locator("#record").click();
  await until(page, () => document.getElementById("record").textContent === "Record");
  const play = (...cameras) => start([
    "play", join(root, "recordings/walk.mcap"), "--loop", "--connect", `tcp/127.0.0.1:${bus}`,
    ...cameras.flatMap((camera) => ["--camera", camera]),
  ]);
  const began = Date.now();
  await play("cam01", "cam02", "cam03");
  const fourth = await play("cam04");
  await people(page, 1);
  const { time, pelvis } = await shown(page);
  await until(page, (before) => Number(document.body.dataset.time) > before + 1, Number(time));
  await until(page, (before) => document.body.dataset.pelvis !== before && document.body.dataset.people === "1", pelvis);
  // Which light is on depends on the load of this computer; each camera has one.
  const judged = '#cameras :is([data-level="ok"], [data-level="warn"], [data-level="bad"])';
  await until(page, (lights) => document.querySelectorAll(lights).length === 4, judged);
  await picture(page, "live");

  // Looking back, while it goes on.
  await page.keyboard.press(" ");
  await until(page, () => /s ago$/.test(document.getElementById("clock").textContent));
  const { time: kept } = await shown(page);
  await page.keyboard.press("ArrowLeft");
  await until(page, (before) => Number(document.body.dataset.time) < before, Number(kept));
  await page.keyboard.press(" ");
  await until(page, () => document.getElementById("clock").textContent === "live");

  await until(page, () => document.getElementById("receivers").textContent === "nobody receives poses");

  // A take is recorded, and the next name is ready.
  const takes = join(folder, "takes");
  const recorder = await start(["record", `${takes}/`, "--connect", `tcp/127.0.0.1:${bus}`], /recording takes/);
  await until(page, () => document.getElementById("receivers").textContent.match(/^bundlemocap record on \S+everything$/));
  await until(page, () => /^\d+\.\d GB free$/.test(document.getElementById("free").textContent));
  await page.locator("#take-name").fill("");
  await page.keyboard.type("flip f 1".replaceAll(" ", "_"));
  assert.equal(await page.locator("#take-name").inputValue(), "flip_f_1");
  await page.locator("#take-name").fill("take_01");
  await page.locator("#record").click();
  await until(page, () => /^● take_01 00:0\d Stop$/.test(document.getElementById("record").textContent));
  await until(page, () => /node: .*recorder: |recorder: .*node: /.test(document.getElementById("answers").textContent));
  await picture(page, "take");
  // A page that is opened later knows it, and one that has ended it names the next one in both.
  const later = await open(first.match[1]);
  await until(later.page, () => /^● take_01 00:\d\d Stop$/.test(document.getElementById("record").textContent));
  await until(later.page, () => document.getElementById("noted").textContent === "take_01");
  await later.page.locator("#record").click();
  await until(later.page, () => document.getElementById("take-name").value === "take_02");
  await until(later.page, () => /take_01\.mcap: \d+ messages/.test(document.getElementById("answers").textContent));
  assert.deepEqual(later.said, []);
  await later.page.close();
  await until(page, () => document.getElementById("record").textContent === "Record");
  assert.equal(await page.locator("#take-name").inputValue(), "take_02");
  run("info", join(takes, "take_01.mcap"), "--check");
  await page.locator("#note").fill('a "good" one, with a turn');
  await page.locator("#good").click();
  await until(page, () => document.getElementById("answers").textContent.includes("noted for take_01"));
  const [header, line] = readFileSync(join(takes, "takes.csv"), "utf8").split("\n");
  assert.equal(header, "time,take,mark,note");
  assert.match(line, /^20\S+Z,"take_01","good","a ""good"" one, with a turn"$/);

  const died = Date.now();
  await stop(fourth.child);
  await until(page, () => {
    const light = document.querySelector('#cameras [data-camera="cam04"][data-level="bad"]');
    return /no (usable )?frame/.test(light?.textContent);
  });
  console.log(`a dead camera is red after ${Date.now() - died} ms, the end of its program included`);
  const levels = await page.locator("#cameras li").evaluateAll((all) => all.map((one) => one.dataset.level));
  assert.equal(levels[0], "bad");
  await picture(page, "dead-camera");
  await isSound(page);
  // In phase with the loop of the others, 4 s: else its clock seems wrong.
  await new Promise((resolve) => setTimeout(resolve, 4000 - ((Date.now() - began) % 4000)));
  await play("cam04");
  await until(page, () => {
    const light = document.querySelector('#cameras [data-camera="cam04"]');
    return /60\.\d Hz/.test(light?.textContent) && !/no (usable )?frame/.test(light.textContent);
  });
  assert.deepEqual(said, []);

  await stop(recorder.child, "SIGKILL");
  await until(page, () => document.getElementById("free").hidden, undefined, 20_000);

  await stop(first.child);
  await until(page, () => document.getElementById("node").textContent.includes("no connection"));
  await until(page, () => document.querySelector("#performers li").textContent.includes("no news"));
  await start(node, /the page is on (\S+)/);
  await until(page, () => !/no connection|no status/.test(document.getElementById("node").textContent));
  await people(page, 1);
  const { time: again } = await shown(page);
  await until(page, (before) => Number(document.body.dataset.time) > before, Number(again));
  // Chromium says that it found nobody meanwhile.
  assert.deepEqual(said.filter((line) => !line.includes("ERR_CONNECTION_REFUSED")), []);
  await page.close();
});

test("four performers live: each is shown, and one gets a name, a colour and a lock", async () => {
  const [bus, http] = [await freePort(), await freePort()];
  const config = join(folder, "four.toml");
  writeFileSync(config, '[stage]\nperformers = "auto"\n');
  const node = await start(["run", config, "--listen", `tcp/127.0.0.1:${bus}`, "--view", `127.0.0.1:${http}`], /the page is on (\S+)/);
  // Not a loop, in which people jump to other places and get new names.
  const take = join(folder, "four-long.mcap");
  run("synth", "--performers", "4", "--cameras", "4", "--seconds", "120", "--out", take);
  await start(["play", take, "--connect", `tcp/127.0.0.1:${bus}`]);
  const { page, said } = await open(node.match[1]);
  await people(page, 4);
  await until(page, () => document.body.dataset.skins === "4");
  await page.locator('[data-label="p2"]').click();
  await isSound(page);
  await page.locator("#shown").fill("the lead");
  await page.locator("#colour").fill("#c00000");
  await page.locator("#locked").check();
  await page.locator('#label [value="save"]').click();
  await until(page, () => document.querySelector('[data-follow="p2"]').textContent === "the lead");
  await until(page, () => document.querySelector("#performers .words:not([hidden])"));
  assert.equal(
    await page.locator('[data-follow="p2"] .swatch').evaluate((swatch) => swatch.style.background),
    "rgb(192, 0, 0)",
  );
  // Nothing is changed by a form that is left.
  await page.locator('[data-label="p2"]').click();
  await page.locator("#shown").fill("nobody");
  await page.keyboard.press("Escape");
  await page.locator("#reset").click();
  await until(page, () => document.getElementById("answers").textContent.includes("locked: p2"));
  assert.equal(await page.locator('[data-follow="p2"]').textContent(), "the lead");
  // One gets a name on the bus, and one is dropped.
  await page.locator('[data-label="p3"]').click();
  await page.locator("#named").fill("double");
  await page.locator('#label [value="save"]').click();
  await until(page, () => document.querySelector('[data-follow="double"]'));
  await page.locator('[data-label="p4"]').click();
  await page.locator("#dropped").check();
  await isSound(page);
  await page.locator('#label [value="save"]').click();
  await until(page, () => document.getElementById("others").textContent === "1 more is seen, and not solved");
  await people(page, 3);
  // The floor is pressed where nobody may be; the node says what it finds there.
  await page.locator("#choose").click();
  const scene = await page.locator("#canvas").boundingBox();
  await page.mouse.move(scene.x + 30, scene.y + scene.height - 60);
  await page.mouse.down();
  await page.mouse.move(scene.x + 90, scene.y + scene.height - 60, { steps: 4 });
  await page.mouse.up();
  assert.equal(await page.locator("#choose").getAttribute("aria-pressed"), "true", "a drag turns the view");
  await page.mouse.click(scene.x + scene.width / 2, scene.y + scene.height - 40);
  await until(page, () => /becomes a performer|nobody/.test(document.getElementById("answers").textContent));
  assert.equal(await page.locator("#choose").getAttribute("aria-pressed"), "false");
  await picture(page, "four-live");
  await isSound(page);
  assert.deepEqual(said, []);
  await page.close();
});

/** Reads a message of Protobuf's encoding by a schema that came with it, base64 both. */
function decoded(name, schema, payload) {
  const types = protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(Buffer.from(schema, "base64")));
  return types.lookupType(name).decode(Buffer.from(payload, "base64"));
}

test("Foxglove and Lichtblick get the performers and the cameras of a live stage, beside our own messages", async () => {
  const [bus, socket] = [await freePort(), await freePort()];
  await start(["run", "--listen", `tcp/127.0.0.1:${bus}`, "--foxglove", `127.0.0.1:${socket}`], /connect to ws:/);
  await start(["play", join(root, "recordings/walk.mcap"), "--loop", "--connect", `tcp/127.0.0.1:${bus}`]);
  // A page of another program on this computer; Chromium lets no other connect.
  const other = await anotherSite();
  const { page, said } = await open(other.url);
  const got = await page.evaluate(async (url) => {
    const client = new WebSocket(url, ["foxglove.sdk.v1"]);
    client.binaryType = "arraybuffer";
    const [topics, counts, last] = [new Map(), {}, {}];
    const wanted = {
      "/performers": 20, "/cameras": 3, "/tf": 20, "/tf/cameras": 3, "/events": 1,
      "/camera/cam01/calibration": 1, "/camera/cam04/keypoints": 20,
      "mocap/stage/actor/actor/pose": 20, "mocap/stage/actor/actor/pose/provisional": 20, "mocap/stage/actor/actor/keyframe": 5,
      "mocap/stage/rig": 3, "the same skeleton again": 1,
    };
    const count = (name) => (counts[name] = (counts[name] ?? 0) + 1);
    const isEnough = () => Object.entries(wanted).every(([topic, least]) => counts[topic] >= least);
    await new Promise((resolve, reject) => {
      setTimeout(() => reject(new Error(JSON.stringify(counts))), 60_000);
      client.onerror = () => reject(new Error("no connection"));
      client.onmessage = ({ data }) => {
        if (typeof data !== "string") {
          const view = new DataView(data);
          const of = view.getUint8(0) === 1 && topics.get(view.getUint32(1, true));
          if (of) {
            const payload = btoa(String.fromCharCode(...new Uint8Array(data, 13)));
            const isRepeated = of.topic.endsWith("/skeleton") && last[of.topic]?.payload === payload;
            count(of.topic);
            if (isRepeated) count("the same skeleton again");
            last[of.topic] = { ...of, payload };
          }
          if (isEnough()) resolve();
          return;
        }
        const { op, channels = [], message } = JSON.parse(data);
        if (op === "status") reject(new Error(message));
        if (op !== "advertise") return;
        for (const { id, topic, schemaName, schema } of channels) topics.set(id, { topic, schemaName, schema });
        client.send(JSON.stringify({ op: "subscribe", subscriptions: channels.map(({ id }) => ({ id, channelId: id })) }));
      };
    });
    client.close();
    return last;
  }, `ws://127.0.0.1:${socket}`);
  const message = (topic) => decoded(got[topic].schemaName, got[topic].schema, got[topic].payload);
  const [{ lines, spheres }] = message("/performers").entities;
  assert.ok(lines.length > 0 && lines[0].points.length > 20 && spheres.length === 1);
  assert.equal(message("mocap/stage/rig").cameras.length, 4);
  const { joint_positions_m: joints } = message("mocap/stage/actor/actor/pose");
  assert.ok(joints.length === 66 && joints[1] > 0.5 && joints[1] < 1.5, `the pelvis is at ${joints[1]} m`);
  assert.deepEqual(said, []);
  await page.close();
  other.close();
});

test("Foxglove and Lichtblick open what a solve writes, with the poses that it has", async () => {
  run("solve", join(root, "recordings/walk.mcap"), "--out", join(folder, "both"));
  const file = readFileSync(join(folder, "both/poses.mcap"));
  const readable = { size: async () => BigInt(file.length), read: async (at, length) => file.subarray(Number(at), Number(at + length)) };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: { zstd: (bytes) => zstd(bytes) } });
  const found = {};
  for await (const { channelId, logTime, data } of reader.readMessages()) {
    const { topic, schemaId } = reader.channelsById.get(channelId);
    const schema = reader.schemasById.get(schemaId);
    (found[topic] ??= []).push({ logTime, schema, data });
  }
  const ours = found["mocap/stage/actor/actor/pose"];
  assert.equal(found["/performers"].length, ours.length);
  const read = ({ schema, data }) => decoded(schema.name, Buffer.from(schema.data).toString("base64"), Buffer.from(data).toString("base64"));
  for (const at of [0, ours.length - 1]) {
    assert.equal(found["/performers"][at].logTime, ours[at].logTime);
    const joints = read(ours[at]).joint_positions_m;
    const transform = found["/tf"].map(read).flatMap(({ transforms }) => transforms)
      .filter(({ child_frame_id }) => child_frame_id.endsWith("/pelvis"))[at].translation;
    ["x", "y", "z"].forEach((axis, k) => assert.ok(Math.abs(transform[axis] - joints[k]) < 1e-5, `${axis} of pose ${at}`));
  }
  run("info", join(folder, "both/poses.mcap"), "--check");
  // The layout for Lichtblick names topics and fields that are there. Images are not, and keypoints are in other files.
  const layout = readFileSync(join(root, "config/lichtblick.json"), "utf8");
  const named = [...layout.matchAll(/"((?:\/|mocap\/)[^"]*)"/g)].map(([, path]) => path.replace(/\/p[123]\//, "/actor/"));
  assert.ok(named.length > 20);
  for (const path of named.filter((path) => !/\/(image|keypoints)$/.test(path))) {
    const [, topic, field, index] = /^([^.]*)\.?(\w*)(?:\[(\d+)\])?$/.exec(path);
    assert.ok(found[topic], `config/lichtblick.json: ${path}`);
    if (!field) continue;
    const value = read(found[topic][0])[field];
    assert.ok((index === undefined ? value : value[index]) !== undefined, `config/lichtblick.json: ${path}`);
  }
});

/** A site of another program on this computer. */
async function anotherSite() {
  const site = createServer((_, answer) => answer.setHeader("content-type", "text/html").end("<link rel=icon href=data:,>"));
  await new Promise((resolve) => site.listen(0, "127.0.0.1", resolve).unref());
  return { url: `http://127.0.0.1:${site.address().port}/`, close: () => site.close() };
}

test("other sites and those without the token are refused", async () => {
  const poses = join(folder, "walk/poses.mcap");
  const own = await start(["view", poses, "--listen", "127.0.0.1:0"], /open (\S+)/);
  assert.equal(await status(own.match[1]), 200);
  assert.match((await fetch(own.match[1])).headers.get("content-security-policy"), /default-src 'none'/);
  assert.equal(await status(own.match[1], { host: "example.org" }), 403);
  for (const path of ["about.json", "messages?from=0&to=1&kinds=pose", "bus"]) {
    assert.equal(await status(own.match[1] + path, { origin: "http://example.org" }), 403);
  }
  // The page of another site gets nothing of a live stage.
  const [bus, http] = [await freePort(), await freePort()];
  const node = ["run", "--listen", `tcp/127.0.0.1:${bus}`, "--view", `127.0.0.1:${http}`];
  const live = await start(node, /the page is on (\S+)/);
  const site = await anotherSite();
  const foreign = await open(site.url);
  const opened = (url) => foreign.page.evaluate((address) => new Promise((resolve) => {
    const socket = new WebSocket(address);
    [socket.onopen, socket.onerror] = [() => resolve(true), () => resolve(false)];
  }), url);
  assert.equal(await opened(`${live.match[1].replace("http", "ws")}bus`), false);
  await foreign.page.close();
  site.close();
  const own_site = await open(live.match[1]);
  await until(own_site.page, () => document.getElementById("empty").textContent.startsWith("No keypoints on mocap/stage."));
  await own_site.page.close();
  const all = await start(["view", poses, "--listen", "0.0.0.0:0"], /open (\S+)/);
  const url = new URL(all.match[1]);
  url.hostname = "127.0.0.1";
  assert.match(url.searchParams.get("token"), /^[0-9a-f]{32}$/);
  assert.equal(await status(url.origin), 401);
  assert.equal(await status(`${url.origin}/?token=00000000000000000000000000000000`), 401);
  const { page, said } = await open(`${url}#t=1`);
  await people(page, 1);
  assert.deepEqual(said, []);
  // An open page finds a node again that is started anew, beyond this computer too.
  const beyond = ["run", "--listen", `tcp/127.0.0.1:${await freePort()}`, "--view", `0.0.0.0:${await freePort()}`];
  const first = await start(beyond, /the page is on (\S+)/);
  const here = Object.assign(new URL(first.match[1]), { hostname: "127.0.0.1" });
  const other = await open(here.href);
  const isConnected = () => !/^$|no connection/.test(document.getElementById("node").textContent);
  await until(other.page, isConnected);
  await stop(first.child);
  await until(other.page, () => document.getElementById("node").textContent.includes("no connection"));
  await start(beyond, /the page is on (\S+)/);
  await until(other.page, isConnected);
});
