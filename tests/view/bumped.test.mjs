// A camera that is bumped. It takes a minute: the node must know the camera before.

import assert from "node:assert/strict";
import { readFileSync, readdirSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";
import { setTimeout } from "node:timers/promises";
import { folder, freePort, isSound, open, picture, run, start, until } from "./browser.mjs";

test("a camera that was bumped is red, and mended by a click", async () => {
  const [bus, http] = [await freePort(), await freePort()];
  const take = join(folder, "bumped.mcap");
  run("synth", "--seconds", "110", "--fps", "30", "--noise", "clean", "--bump", "38", "--out", take);
  const rig = join(folder, "rig.toml");
  run("calibrate", take, "--time-only", "--out", rig);
  const node = ["run", "--rig", rig, "--listen", `tcp/127.0.0.1:${bus}`, "--view", `127.0.0.1:${http}`];
  const first = await start(node, /the page is on (\S+)/);
  await start(["play", take, "--connect", `tcp/127.0.0.1:${bus}`]);
  // Until then the node has the computer for itself. The camera is found some 5 s after the bump, and where it is
  // 10 s later.
  await setTimeout(46_000);
  const { page, said } = await open(first.match[1], { viewport: { width: 820, height: 600 } });
  const red = '#cameras [data-camera="cam04"][data-level="bad"]';
  await until(page, (light) => document.querySelector(light)?.textContent.includes("turned by"), red, 60_000);
  await page.locator('[data-mend="cam04"]').waitFor({ timeout: 60_000 });
  await picture(page, "bumped");
  await isSound(page);
  await page.locator('[data-mend="cam04"]').click();
  await until(page, () => /node: .*cam04 is mended/.test(document.getElementById("answers").textContent));
  await until(page, () => document.querySelector('#cameras [data-camera="cam04"]:not([data-level="bad"])'));
  await until(page, () => !document.querySelector("[data-mend]"));
  await picture(page, "mended");
  // The node writes the file after the answer.
  const kept = () => readdirSync(folder).filter((name) => /^rig\.\d+\.toml$/.test(name));
  for (let waited = 0; kept().length === 0 && waited < 10_000; waited += 100) await setTimeout(100);
  const files = kept();
  assert.equal(files.length, 1, "the calibration before is kept");
  assert.notEqual(readFileSync(rig, "utf8"), readFileSync(join(folder, files[0]), "utf8"));
  assert.deepEqual(said, []);
  await page.close();
});
