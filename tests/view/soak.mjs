// The live page over ten minutes: npm run soak. Environment: PERFORMERS (1), CAMERAS (4), SECONDS (600), PAGES (1),
// SOCKETS (0; connections that draw nothing, as pages on other computers), TAKE (a recording with these performers; without
// it one is made, which takes minutes for many), and those of browser.mjs. It prints figures; in ten minutes or more it fails
// if the memory of the page grows.

import assert from "node:assert/strict";
import { writeFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import { setTimeout } from "node:timers/promises";
import { folder, freePort, open, people, run, shown, start } from "./browser.mjs";

const setting = (name, usual) => Number(process.env[name] ?? usual);
const [performers, cameras] = [setting("PERFORMERS", 1), setting("CAMERAS", 4)];
const [seconds, pages, sockets] = [setting("SECONDS", 600), setting("PAGES", 1), setting("SOCKETS", 0)];
const TIMES = 10;

/** Receives what pages do, and draws nothing; returns how to read the bytes so far. */
async function receive(url, count) {
  const { page } = await open(new URL("messages.js", url).href);
  await page.evaluate((count) => {
    window.bytes = 0;
    const topics = ["rig", "events", "status", "take", "take/answers", "camera/*/keypoints", "actor/**"];
    for (let k = 0; k < count; k++) {
      const socket = new WebSocket(`ws://${location.host}/bus`);
      socket.binaryType = "arraybuffer";
      socket.onmessage = ({ data }) => {
        if (typeof data !== "string") window.bytes += data.byteLength;
        else if (JSON.parse(data).open) socket.send(JSON.stringify({ topics: topics.map((topic) => `mocap/stage/${topic}`) }));
      };
    }
  }, count);
  return () => page.evaluate(() => window.bytes);
}

test("ten minutes leave the memory flat", async () => {
  const [bus, http, metrics] = [await freePort(), await freePort(), await freePort()];
  const [take, config] = [process.env.TAKE ?? join(folder, "take.mcap"), join(folder, "soak.toml")];
  if (!process.env.TAKE) run("synth", "--performers", performers, "--cameras", cameras, "--seconds", seconds + 60, "--out", take);
  const stage = performers > 1 ? '[stage]\nperformers = "auto"\n' : "";
  writeFileSync(config, `${stage}[node]\nprometheus = "127.0.0.1:${metrics}"\n`);
  const listen = ["--listen", `tcp/127.0.0.1:${bus}`, "--view", `127.0.0.1:${http}`];
  const node = await start(["run", config, ...listen], /the page is on (\S+)/);
  await start(["play", take, "--connect", `tcp/127.0.0.1:${bus}`]);
  const opened = [];
  for (let k = 0; k < pages; k++) opened.push(await open(node.match[1]));
  const received = sockets > 0 && (await receive(node.match[1], sockets));
  const page = opened[0]?.page;
  // A long take of many is read for minutes.
  if (page) await people(page, performers, 300_000);
  const devtools = await page?.context().newCDPSession(page);
  const heap = async () => {
    await devtools.send("HeapProfiler.collectGarbage");
    return (await devtools.send("Runtime.getHeapUsage")).usedSize / 1e6;
  };
  const counter = async (name) => {
    const text = await (await fetch(`http://127.0.0.1:${metrics}/metrics`)).text();
    return Number(new RegExp(`^${name} (\\S+)$`, "m").exec(text)?.[1]);
  };
  const poses = (outcome) => counter(`bundlemocap_poses_total\\{outcome="${outcome}"\\}`);
  // The latency is declared, and everybody has a body.
  await setTimeout(15_000);
  const [missed, heaps] = [await poses("missed"), []];
  for (let k = 0; k < TIMES; k++) {
    const before = page && (await shown(page));
    const begin = performance.now();
    await setTimeout((1000 * seconds) / TIMES);
    if (!page) continue;
    const [now, passed] = [await shown(page), (performance.now() - begin) / 1000];
    heaps.push(await heap());
    const [pictures, bytes] = ["pictures", "bytes"].map((name) => (now[name] - before[name]) / passed);
    const screen = await page.locator("#figures div", { hasText: "to the screen" }).allTextContents();
    console.log(
      `${((k + 1) * seconds / TIMES).toFixed(0)} s: ${heaps[k].toFixed(1)} MB, ${now.people} performers, ` +
      `${pictures.toFixed(1)} pictures/s, script p50, p99 ${now.script} ms, lists and curves ${now.tick} ms, ${now.calls} draw calls, ` +
      `${now.triangles} triangles, ${(bytes / 1000).toFixed(0)} kB/s, ${screen}`,
    );
  }
  const late = (await poses("missed")) - missed;
  console.log(`${await poses("published")} poses, ${late} of them missed after the start, ${pages} pages`);
  if (received) console.log(`${sockets} others received ${((await received()) / 1e6).toFixed(1)} MB`);
  assert.ok(Number.isFinite(late));
  // Curves of five minutes are kept.
  const half = TIMES / 2;
  if (page && seconds >= 600) assert.ok(Math.max(...heaps.slice(half)) < 1.1 * Math.max(...heaps.slice(0, half)), `it grows: ${heaps}`);
  for (const { said } of opened) assert.deepEqual(said, []);
});
