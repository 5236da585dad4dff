// The page in a real browser, for the tests beside. Needs Chromium (the environment variable CHROMIUM, else
// /usr/bin/chromium) and the program (BUNDLEMOCAP, else target/release/bundlemocap). Pictures go to the folder
// PICTURES, if it is set. With SOURCES=1 the page's files are those of src, not those in the program.

import assert from "node:assert/strict";
import { spawn, spawnSync } from "node:child_process";
import { mkdtempSync, readFileSync, readdirSync, rmSync } from "node:fs";
import { request } from "node:http";
import { createRequire } from "node:module";
import { createServer } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, afterEach, before } from "node:test";
import { chromium } from "playwright-core";

export const root = new URL("../..", import.meta.url).pathname;
const program = process.env.BUNDLEMOCAP ?? join(root, "target/release/bundlemocap");
const axe = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");
export const folder = mkdtempSync(join(tmpdir(), "page-"));
const children = [];
let browser;

before(async () => {
  browser = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
  });
});

afterEach(async () => {
  for (const context of browser?.contexts() ?? []) await context.close();
  for (const child of children.splice(0)) child.kill("SIGKILL");
});

after(async () => {
  await browser?.close();
  rmSync(folder, { recursive: true, force: true });
});

/** Starts the program, and waits for a line that matches. Returns the match and the process. */
export function start(args, pattern) {
  const child = spawn(program, args, { env: { ...process.env, NO_COLOR: "1", XDG_STATE_HOME: folder } });
  children.push(child);
  return new Promise((resolve, reject) => {
    let text = "";
    const read = (data) => {
      text += data;
      const match = pattern?.exec(text);
      if (match) resolve({ child, match });
    };
    child.stdout.on("data", read);
    child.stderr.on("data", read);
    child.on("exit", () => reject(new Error(`${args.join(" ")} ended: ${text}`)));
    if (!pattern) resolve({ child });
  });
}

export function run(...args) {
  const { status, stderr } = spawnSync(program, args, { encoding: "utf8" });
  assert.equal(status, 0, `${args.join(" ")}: ${stderr}`);
}

/** Stops a process and waits for its end. */
export function stop(child, signal = "SIGINT") {
  return new Promise((resolve) => {
    child.removeAllListeners("exit");
    child.on("exit", resolve);
    child.kill(signal);
  });
}

export async function freePort() {
  const server = createServer().listen(0, "127.0.0.1");
  await new Promise((resolve) => server.on("listening", resolve));
  const { port } = server.address();
  await new Promise((resolve) => server.close(resolve));
  return port;
}

/** Opens the page. What its console says of errors is in `said`. `first` runs in it before its own scripts. */
export async function open(url, { first, ...options } = {}) {
  const page = await browser.newPage({ viewport: { width: 1280, height: 720 }, ...options });
  if (first) await page.addInitScript(first);
  const said = [];
  page.on("console", (message) => {
    if (["error", "warning"].includes(message.type())) said.push(message.text());
  });
  page.on("pageerror", (error) => said.push(error.message));
  for (const place of process.env.SOURCES ? ["src/view/assets", "src/io/report/scene"] : []) {
    for (const name of readdirSync(join(root, place))) {
      await page.route(`**/${name}`, (route) => route.fulfill({ path: join(root, place, name) }));
    }
  }
  await page.goto(url);
  return { page, said };
}

export const shown = (page) => page.evaluate(() => ({ ...document.body.dataset }));
/** Waits for a condition in the page; says what the page shows if it does not come. */
export const until = (page, condition, argument, timeout = 30_000) =>
  page.waitForFunction(condition, argument, { timeout }).catch(async (error) => {
    const text = await page.evaluate(() => document.body.innerText);
    throw new Error(`${error.message} for ${condition}; the page shows:\n${text}`);
  });
export const people = (page, count, timeout) =>
  until(page, (wanted) => Number(document.body.dataset.people) === wanted, count, timeout);

export async function picture(page, name) {
  if (process.env.PICTURES) await page.screenshot({ path: join(process.env.PICTURES, `${name}.png`) });
}

/** Nothing that assistive technology cannot use, and nothing cut off at the sides. */
export async function isSound(page) {
  const { violations } = await page.evaluate(`${axe}; axe.run({ resultTypes: ["violations"] })`);
  const serious = violations.filter(({ impact }) => ["serious", "critical"].includes(impact));
  assert.deepEqual(serious.map(({ id, nodes }) => [id, nodes.map(({ target }) => target)]), []);
  const [inner, wide] = await page.evaluate(() => [innerWidth, document.documentElement.scrollWidth]);
  assert.ok(wide <= inner, `the page is ${wide} px wide in a window of ${inner}`);
}

/** The status of a GET request with these headers. */
export function status(url, headers) {
  return new Promise((resolve, reject) => {
    const asked = request(url, { headers }, (answer) => resolve(answer.resume().statusCode));
    asked.on("error", reject).end();
  });
}
