// The figures at the top: what the node does, and how long things take.

import { isNodeSilent, recent, timeOfDay } from "./lights.js";

/** Longer than that is not as it should be: publishing and provisional, microseconds; others, ms. */
const LONG = { publishing: 5000, provisional: 50_000, network: 50, "to the screen": 100 };

/** Bad if the median is too long, warn if the 99th percentile is. */
const judge = (usual, longest, most) => (usual > most ? "bad" : longest > most ? "warn" : "ok");

const LAST = "median / 99th / 99.9th percentile of the last minute";
const RECENT = "median / 99th percentile";
/** What the figures are, in words. */
const MEANINGS = {
  tracking: "performers who are tracked, of those who are there",
  latency: "declared: from the capture to the publication of every pose",
  poses: "final poses of a performer in a second",
  publishing: `deviation of a pose from its due time: ${LAST}`,
  provisional: `from the last frame of a set to its provisional pose: ${LAST}`,
  window: `age of a window's first pose when the window is given to the solvers: ${RECENT}`,
  solve: `solve of a window: ${RECENT}`,
  network: `from the due time until a pose is here: ${RECENT}`,
  "to the screen": `from the due time until a pose is on the screen: ${RECENT}`,
  captured: "time of day of the shown pose",
  timecode: "of the shown pose",
  "not readable": "messages that this page could not read",
  "not shown": "messages that did not come here in time",
};

/** For how long dropped messages are shown, ms. */
const SLOW = 60_000;

export class Figures {
  constructor(list) {
    this.list = list;
    /** The rows stay: a tooltip would go away with its row. */
    this.rows = new Map();
  }

  /**
   * Shows the figures of a time (Infinity: the newest). `shown`: the time of the picture; `present`: how many performers
   * there are, `expected`: how many should be tracked; `toScreen`: times from due times to pictures, ms.
   */
  show(store, { time, shown, isLive, people, present, expected, toScreen }) {
    const all = new Map();
    // The figures of a silent node are old.
    const isUnknown = isLive && isNodeSilent(store);
    const set = (name, value, level = "") => all.set(name, { value, level: isUnknown ? "" : level });
    const tracked = people.filter(({ state }) => state === "tracking").length;
    const worse = tracked > 0 ? "warn" : "bad";
    set("tracking", `${tracked} of ${present}`, expected === 0 ? "" : tracked >= expected ? "ok" : worse);
    const status = store.historyAt(time).at(-1)?.status;
    if (status) this.ofStatus(store, status, { time, shown, set });
    const arrived = [...store.performers.values()].flatMap(({ poses }) => poses.items.map(({ late }) => late));
    const late = isLive ? arrived.filter((ms) => ms !== undefined) : [];
    for (const [what, times] of [["network", late], ["to the screen", [...toScreen]]]) {
      times.sort((a, b) => a - b);
      const [p50, p99] = [0.5, 0.99].map((share) => times[Math.floor(share * times.length)]);
      if (p50 === undefined) continue;
      // The clock of another computer may be wrong.
      const level = judge(what === "network" ? 0 : p50, p99, LONG[what]);
      set(what, `${p50.toFixed(1)} / ${p99.toFixed(1)} ms`, level);
    }
    if (store.unreadable > 0) set("not readable", `${store.unreadable} messages`, "warn");
    if (performance.now() - store.droppedAt < SLOW) set("not shown", `${store.dropped} messages: this page is too slow`, "warn");
    const clock = { fractionalSecondDigits: 2, hour: "2-digit", minute: "2-digit", second: "2-digit" };
    const captured = timeOfDay(store.nanoseconds(shown), clock);
    if (people[0]?.timecode) set("timecode", people[0].timecode);
    else if (captured) set("captured", captured);
    this.put(all);
  }

  ofStatus(store, { playout, windows, declared_latency_ns }, { time, shown, set }) {
    const declared = Number(declared_latency_ns ?? 0n) / 1e6;
    const { age_p50_ms = 0, age_p99_ms = 0, solve_p50_ms = 0, solve_p99_ms = 0 } = windows ?? {};
    const judged = (usual, longest) => (declared > 0 && age_p50_ms > 0 ? judge(usual, longest, declared) : "");
    const ofAge = judged(age_p50_ms, age_p99_ms);
    const ofBoth = judged(age_p50_ms + solve_p50_ms, age_p99_ms + solve_p99_ms);
    if (declared > 0) set("latency", `${declared.toFixed(0)} ms`, ofBoth);
    // Of the performer with the most, in the last two seconds.
    const rates = [...store.performers.values()].map(({ poses }) => {
      const [from, to] = [poses.after(shown - 2), poses.after(shown)];
      return to - from > 1 ? (to - from - 1) / (poses.times[to - 1] - poses.times[from]) : 0;
    });
    const rate = Math.max(0, ...rates);
    const [missed, coasted] = ["missed", "coasted"].map((name) => recent(store.historyAt(time), (one) => one.playout?.[name]));
    const level = missed > 0 ? "bad" : coasted > 0 ? "warn" : "ok";
    if (rate > 0) set("poses", `${rate.toFixed(1)} Hz`, playout ? level : "");
    for (const [what, kind] of [["publishing", "deviation"], ["provisional", "provisional"]]) {
      const all = lastMinute(store, time, `${kind}_counts`);
      const edges = playout?.[`${kind}_bins_us`] ?? [];
      const shares = [0.5, 0.99, 0.999].map((share) => quantile(edges, all, share));
      if (shares[0] === undefined) continue;
      const inMs = (us) => (us === Infinity ? `>${edges.at(-1) / 1000}` : `≤${us / 1000}`);
      set(what, `${shares.map(inMs).join(" / ")} ms`, judge(shares[0], shares[1], LONG[what]));
    }
    if (age_p50_ms > 0) set("window", `${age_p50_ms.toFixed(0)} / ${age_p99_ms.toFixed(0)} ms`, ofAge);
    // If a window is late before its solve, the solve is not the cause.
    const ofSolve = ofAge === "ok" ? ofBoth : "";
    if (solve_p50_ms > 0) set("solve", `${solve_p50_ms.toFixed(1)} / ${solve_p99_ms.toFixed(1)} ms`, ofSolve);
  }

  put(all) {
    for (const [name, row] of this.rows) {
      if (all.has(name)) continue;
      row.remove();
      this.rows.delete(name);
    }
    const isNew = [...all.keys()].some((name) => !this.rows.has(name));
    for (const [name, { value, level }] of all) {
      const row = this.rows.get(name) ?? this.make(name);
      if (isNew) this.list.append(row);
      const figure = row.lastChild;
      if (figure.textContent !== value) figure.textContent = value;
      figure.className = level && `light ${level}`;
    }
  }

  make(name) {
    const row = document.createElement("div");
    row.append(document.createElement("dt"), document.createElement("dd"));
    row.firstChild.textContent = name;
    row.title = MEANINGS[name] ?? "";
    this.rows.set(name, row);
    return row;
  }
}

/** The counts of a histogram of poses in the minute before a time. */
function lastMinute(store, time, name) {
  const history = store.historyAt(time);
  const { at, status } = history.at(-1);
  const before = history.find((one) => at - one.at <= 60 && one.status.run_id === status.run_id);
  const [counts, old] = [status, before.status].map(({ playout }) => (playout?.[name] ?? []).map(Number));
  return before === history.at(-1) ? counts : counts.map((count, bin) => count - (old[bin] ?? 0));
}

/** The value below which a share of a histogram lies: the upper edge of its bin. */
function quantile(edges, all, share) {
  const total = all.reduce((sum, count) => sum + count, 0);
  if (total === 0) return undefined;
  let seen = 0;
  const bin = all.findIndex((count) => (seen += count) >= share * total);
  return bin < edges.length ? edges[bin] : Infinity;
}
