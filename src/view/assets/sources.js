// Where messages come from: the bus, or a recording.

import { anglesOf } from "./charts.js";
import { frames } from "./messages.js";

/** Where cameras of any stage send. */
const EVERYWHERE = "mocap/*/camera/*/keypoints";
/** Live: for how long poses and keypoints are kept, seconds: for the curves, and for looking back. */
const [KEPT, KEPT_POINTS] = [60, 30];

/** Connection, ms: interval of the checks; a longer interval means that the browser stopped the page; longest silence. */
const [LOOK, STOPPED, SILENT] = [2000, 10_000, 30_000];

/** A live stage. A lost connection is opened again. */
export class Live {
  /** `about`: what the server said of itself when the page was opened. */
  constructor(store, about) {
    this.store = store;
    [this.about, this.stage] = [about, about.name];
    this.connected = false;
    this.error = "";
    this.wait = 250;
    /** Bytes of messages that came. */
    this.bytes = 0;
    /** Who receives topics of performers; undefined if it is not known yet. */
    this.receivers = undefined;
    /** Whether anybody else receives poses, announced or not; undefined if it is not known. */
    this.received = undefined;
    /** When something came last, and when the page looked last. */
    [this.heard, this.looked] = [performance.now(), performance.now()];
    setInterval(() => this.watch(), LOOK);
    this.open();
  }

  open() {
    const socket = new WebSocket(`ws://${location.host}/bus`);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      this.heard = performance.now();
      if (typeof data === "string") return this.said(JSON.parse(data));
      this.bytes += data.byteLength;
      for (const frame of frames(data)) this.store.take(frame, this.stage);
    };
    socket.onclose = () => {
      this.lost();
      this.ask();
      setTimeout(() => this.open(), this.wait);
      this.wait = Math.min(2 * this.wait, 4000);
    };
  }

  /**
   * Asks the server for its description: a browser does not say why a WebSocket was refused. If another server answers, the
   * page is loaded again.
   */
  ask() {
    fetch("about.json").then(async (answer) => {
      if (answer.status === 401) {
        this.error = "The program was started again and has a new address: open the one that it prints.";
      } else if (answer.ok) {
        const { about } = await answer.json();
        const isOther = (field) => about[field] !== this.about[field];
        if (this.connected && ["version", "shows", "name", "node"].some(isOther)) location.reload();
      }
    }).catch(() => {});
  }

  /** Connects again after 30 s without a message. The server sends the list of receivers every 2 s. */
  watch() {
    const now = performance.now();
    // The browser had stopped the page.
    if (now - this.looked > STOPPED) this.heard = now;
    this.looked = now;
    if (!this.connected || now - this.heard < SILENT) return;
    this.socket.onclose = this.socket.onmessage = null;
    this.socket.close();
    this.lost();
    this.open();
  }

  lost() {
    this.connected = false;
    this.receivers = this.received = undefined;
  }

  /** What the server says of the bus. */
  said({ open, error, dropped, receivers, received }) {
    if (open) {
      [this.connected, this.error, this.wait] = [true, "", 250];
      this.send();
      this.ask();
    }
    if (error !== undefined) this.error = error;
    if (dropped !== undefined) [this.store.dropped, this.store.droppedAt] = [dropped, performance.now()];
    if (receivers !== undefined) [this.receivers, this.received] = [receivers, received ?? undefined];
  }

  /** Asks for what is shown: of the cameras, those given, or else all. */
  want(provisional, cameras = ["*"]) {
    const own = `mocap/${this.stage}`;
    const topics = ["rig", "events", "status", "take", "take/answers", ...cameras.map((name) => `camera/${name}/keypoints`)];
    topics.push("actor/*/skeleton", "actor/*/status", "actor/*/events", "actor/*/pose");
    if (provisional) topics.push("actor/*/pose/provisional");
    this.topics = topics.map((topic) => `${own}/${topic}`);
    this.send();
  }

  /** Commands nodes and recorders; returns the number that their answers carry. */
  command(action, name = "", more = {}) {
    const id = Math.floor(Math.random() * 2 ** 32);
    if (this.connected) this.socket.send(JSON.stringify({ take: { id, action, name, ...more } }));
    return id;
  }

  /** Looks for cameras on other stages. */
  lookAround() {
    if (this.topics.includes(EVERYWHERE)) return;
    this.topics.push(EVERYWHERE);
    this.send();
  }

  send() {
    if (this.connected && this.topics) this.socket.send(JSON.stringify({ topics: this.topics }));
  }

  /** Called for each picture, and a few times a second where nothing is drawn. */
  prepare() {
    this.store.keepLast(KEPT, KEPT_POINTS);
    if (this.store.keypoints.size > 0 && this.topics?.includes(EVERYWHERE)) {
      this.topics = this.topics.filter((topic) => topic !== EVERYWHERE);
      this.send();
    }
  }

  /** What the charts show: residuals, latencies and solve times by second, and angles of a performer. */
  curves(performer) {
    return { statuses: this.store.statuses.items, angles: anglesOf(performer) };
  }

  get span() {
    const { newest } = this.store;
    return Number.isFinite(newest) ? [newest - KEPT, newest] : [0, 0];
  }
}

/** Length of a part of a recording that is read at once, seconds. */
const PART = 2;
/** Most parts that are read at once. */
const MOST = 2;

/** A recording, of which the parts around the shown time are read. */
export class Recording {
  constructor(store, overview) {
    this.store = store;
    this.overview = overview;
    this.connected = true;
    this.error = "";
    this.store.base = BigInt(overview.start_ns);
    /** Whether each part is there, or still being read. */
    this.parts = new Map();
    this.provisional = false;
    /** Number of parts that are being read. */
    this.reading = 0;
    /** After an error, when to read again (page's clock, ms). */
    this.pauseUntil = 0;
    for (const event of overview.events) store.addEvent({ ...event, run: BigInt(event.run) });
    for (const name of Object.keys(overview.performers)) store.performer(name);
    this.read(0, "");
  }

  get span() {
    return [0, this.overview.seconds];
  }

  /** Those of the whole recording. */
  curves(performer) {
    const { statuses, angles } = this.overview;
    return { statuses, angles: angles[performer?.name] ?? [] };
  }

  /** A recording gives all that it holds; provisional poses only if they are wanted. */
  want(provisional) {
    if (this.provisional === provisional) return;
    this.provisional = provisional;
    if (provisional) this.parts.clear();
  }

  async read(part, kinds) {
    const at = (seconds) => this.store.base + BigInt(Math.round(seconds * 1e9));
    const url = `messages?from=${at(part * PART)}&to=${at((part + 1) * PART)}&kinds=${kinds}`;
    this.reading++;
    try {
      const answer = await fetch(url);
      if (!answer.ok) throw new Error(await answer.text());
      for (const frame of frames(await answer.arrayBuffer())) this.store.take(frame);
      if (this.parts.has(part)) this.parts.set(part, true);
      [this.connected, this.error] = [true, ""];
    } catch (error) {
      this.parts.delete(part);
      [this.connected, this.error] = [false, error.message];
      this.pauseUntil = performance.now() + 1000;
    } finally {
      this.reading--;
    }
  }

  /** Reads the parts around a time, once each, and forgets others. */
  prepare(time) {
    if (performance.now() < this.pauseUntil) return;
    const now = Math.floor(time / PART);
    for (const part of [now, now + 1, now - 1, now + 2]) {
      if (part < 0 || part * PART > this.overview.seconds || this.parts.has(part)) continue;
      if (this.reading >= (this.connected ? MOST : 1)) break;
      this.parts.set(part, false);
      this.read(part, `pose,keypoints,status${this.provisional ? ",provisional" : ""}`);
    }
    for (const part of this.parts.keys()) if (Math.abs(part - now) > 4) this.parts.delete(part);
    this.store.keep((now - 4) * PART, (now + 5) * PART);
  }

  /** Whether the messages of a time are there. */
  isReady(time) {
    return this.parts.get(Math.floor(time / PART)) === true;
  }
}
