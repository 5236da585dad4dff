// Files and a live stage in Lichtblick itself. No registry has its web app: the environment variable LICHTBLICK is the
// folder of a built one. Without it this test is skipped.

import assert from "node:assert/strict";
import { createReadStream, statSync } from "node:fs";
import { createServer } from "node:http";
import { extname, join } from "node:path";
import { test } from "node:test";
import { setTimeout } from "node:timers/promises";
import { folder, freePort, open, picture, root, run, start, stop } from "./browser.mjs";

const app = process.env.LICHTBLICK;
const skip = app ? false : "LICHTBLICK is not set";
const TYPES = { ".html": "text/html", ".js": "text/javascript", ".wasm": "application/wasm", ".json": "application/json" };
/** The colours of the first performers. */
const COLOURS = { p1: [0, 0x72, 0xb2], p2: [0xe6, 0x9f, 0], p3: [0, 0x9e, 0x73] };

/** Serves a folder, parts of files too, to pages of other sites. */
async function served(place) {
  const server = createServer((asked, answer) => {
    const path = decodeURIComponent(new URL(asked.url, "http://localhost").pathname);
    const file = join(place, path === "/" ? "index.html" : path);
    const length = statSync(file, { throwIfNoEntry: false })?.size;
    if (length === undefined) return answer.writeHead(404).end();
    const [, from, to] = /bytes=(\d+)-(\d*)/.exec(asked.headers.range ?? "") ?? [];
    const [first, last] = [Number(from ?? 0), to ? Math.min(Number(to), length - 1) : length - 1];
    answer.writeHead(from ? 206 : 200, {
      "accept-ranges": "bytes", "access-control-allow-origin": "*", "access-control-expose-headers": "*",
      "access-control-allow-headers": "*",
      "content-length": last - first + 1, "content-range": `bytes ${first}-${last}/${length}`,
      "content-type": TYPES[extname(file)] ?? "application/octet-stream",
    });
    if (asked.method !== "GET") return answer.end();
    createReadStream(file, { start: first, end: last }).pipe(answer);
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve).unref());
  return `http://127.0.0.1:${server.address().port}`;
}

/** Opens a source with our layout. */
async function opened(kind, url) {
  const [lichtblick, config] = [await served(app), await served(join(root, "config"))];
  const asked = new URLSearchParams({ ds: kind, "ds.url": url, layoutUrl: `${config}/lichtblick.json` });
  return open(`${lichtblick}/?${asked}`, { viewport: { width: 1600, height: 1000 } });
}

/**
 * For each of `COLOURS`, the height of what has this colour in the 3D panel, divided by its width; 0 if there is nothing. And
 * the number of pixels with the colour of keypoints, magenta, in the images.
 */
async function seen(page) {
  const png = (await page.screenshot()).toString("base64");
  return page.evaluate(async ([png, colours]) => {
    const image = await createImageBitmap(await (await fetch(`data:image/png;base64,${png}`)).blob());
    const context = new OffscreenCanvas(image.width, image.height).getContext("2d");
    context.drawImage(image, 0, 0);
    const { data } = context.getImageData(0, 0, image.width, image.height);
    const places = Object.fromEntries(Object.keys(colours).map((name) => [name, []]));
    let keypoints = 0;
    for (let at = 0; at < data.length; at += 4) {
      const [x, y] = [(at / 4) % image.width, Math.floor(at / 4 / image.width)];
      const [red, green, blue] = data.slice(at, at + 3);
      if (x > 1024) {
        keypoints += Math.min(red, blue) - green > 60;
        continue;
      }
      for (const [name, colour] of Object.entries(colours)) {
        if (x < 320 || y > 640 || colour.some((value, k) => Math.abs(value - data[at + k]) > 12)) continue;
        places[name].push([x, y]);
      }
    }
    const extent = (all, axis) => {
      const values = all.map((place) => place[axis]);
      return Math.max(...values) - Math.min(...values) + 1;
    };
    const shapes = Object.entries(places).map(([name, all]) => [name, all.length > 50 ? extent(all, 1) / extent(all, 0) : 0]);
    return { ...Object.fromEntries(shapes), keypoints };
  }, [png, COLOURS]);
}

/** Waits until the picture is as wanted. */
async function until(page, isWanted, what) {
  let last;
  for (const end = Date.now() + 60_000; Date.now() < end; await setTimeout(500)) {
    last = await seen(page);
    if (isWanted(last)) return picture(page, `lichtblick ${what}`);
  }
  await picture(page, "lichtblick");
  assert.fail(`${what}: ${JSON.stringify(last)}`);
}

test("Lichtblick shows all performers of a file, standing, after a jump back too", { skip }, async () => {
  const take = join(folder, "three.mcap");
  run("synth", "--performers", "3", "--seconds", "4", "--out", take);
  run("solve", take, "--performers", "auto", "--out", join(folder, "three"));
  const { page } = await opened("remote-file", `${await served(join(folder, "three"))}/poses.mcap`);
  const areStanding = ({ p1, p2, p3 }) => Math.min(p1, p2, p3) > 1.3;
  await until(page, areStanding, "at the beginning");
  for (const part of [0.55, 0.3]) {
    await page.mouse.click(8 + part * 1584, 942);
    // What was shown before is gone by then.
    await setTimeout(3000);
    await until(page, areStanding, `after a jump to ${part}`);
  }
});

test("Lichtblick shows a live stage, and nobody after the cameras have stopped", { skip }, async () => {
  const [bus, socket] = [await freePort(), await freePort()];
  await start(["run", "--listen", `tcp/127.0.0.1:${bus}`, "--foxglove", `127.0.0.1:${socket}`], /connect to ws:/);
  const { page } = await opened("foxglove-websocket", `ws://127.0.0.1:${socket}`);
  const { child } = await start(["play", join(root, "recordings/walk.mcap"), "--loop", "--connect", `tcp/127.0.0.1:${bus}`]);
  await until(page, ({ p1, keypoints }) => p1 > 1.3 && keypoints > 50, "live");
  await stop(child);
  await until(page, ({ p1 }) => p1 === 0, "after the cameras have stopped");
});
