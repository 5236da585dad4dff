// What came so far: the newest of what stays, and the last seconds of what streams.

import { COLOURS, numberOf } from "./colours.js";

/** The middle value, which is sorted to its place; `undefined` of none. */
export const median = (values) => values.sort((a, b) => a - b)[values.length >> 1];

/** Steps between the newest items, in memory that is kept. */
const steps = new Float64Array(8);

/** Items in order of time, seconds. */
export class Series {
  constructor() {
    this.times = [];
    this.items = [];
  }

  /** Adds an item; one of the same time is replaced. Items of a clock that has jumped back are forgotten. */
  add(time, item, jump = Infinity) {
    if (this.last - time > jump) this.clear();
    const { times, items } = this;
    let at = times.length;
    while (at > 0 && times[at - 1] > time) at--;
    if (times[at - 1] === time) {
      items[at - 1] = item;
      return;
    }
    times.splice(at, 0, time);
    items.splice(at, 0, item);
  }

  /** Forgets all. */
  clear() {
    [this.times, this.items] = [[], []];
  }

  /** Forgets what is outside of a span. */
  keep(from, to) {
    const { times, items } = this;
    const [first, end] = [this.after(from), this.after(to)];
    // Not for a few, except for the last ones.
    if (first < times.length && first < 200 && times.length - end < 200) return;
    this.times = times.slice(first, end);
    this.items = items.slice(first, end);
  }

  /** Index of the first item later than a time. */
  after(time) {
    let [low, high] = [0, this.times.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] <= time) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** The item to show at a time. It is at most 0.21 s old; where items are rarer, at most one and a half steps. */
  shown(time) {
    const { times } = this;
    const [count, last] = [Math.min(steps.length, times.length - 1), times.length - 1];
    if (count <= 0) return this.at(time, 0.21);
    for (let k = 0; k < count; k++) steps[k] = times[last - k] - times[last - k - 1];
    const step = median(count === steps.length ? steps : steps.subarray(0, count));
    return this.at(time, Math.max(0.21, 1.5 * Math.min(step, 2)));
  }

  /** The last item at a time or up to `age` seconds before it. */
  at(time, age = 0.1) {
    const index = this.after(time + 1e-6) - 1;
    return index >= 0 && time - this.times[index] <= age ? this.items[index] : undefined;
  }

  get last() {
    return this.times.at(-1);
  }
}

/** A step back of a clock, seconds, after which older items count no more. */
const JUMP = 30;
const STATES = ["", "tracking", "coasting", "lost"];

export class Store {
  /** `node`: the name whose status is that of the live node. `recorded`: that of a recording. Other statuses repeat the cameras. */
  constructor(decoder, node, recorded) {
    this.decoder = decoder;
    this.node = this.guess = node;
    this.judged = node ?? recorded;
    this.jump = node === undefined ? Infinity : JUMP;
    this.base = undefined;
    this.rig = undefined;
    this.performers = new Map();
    this.keypoints = new Map();
    /** When the last frame of each camera came (page's clock, ms). */
    this.came = new Map();
    this.events = [];
    this.statuses = new Series();
    this.statusOf = new Map();
    /** Who is there, by the node; `undefined`: not known. */
    this.stage = undefined;
    this.statusCame = undefined;
    /** Least difference of the page's clock and the node's, ms. */
    this.apart = Infinity;
    this.unreadable = 0;
    this.states = new Map();
    [this.dropped, this.droppedAt] = [0, undefined];
    /** The cameras that other stages have, by stage. */
    this.otherStages = new Map();
    /** Name of the last take that was begun or ended, by whomever; and the answers to commands. */
    this.lastTake = undefined;
    this.answers = [];
    /** What recorders said of their disks: when (page's clock, ms), and bytes that are free. */
    this.disks = [];
  }

  /** Seconds since the first message, of a capture time in nanoseconds. */
  seconds(ns) {
    this.base ??= ns;
    return Number(ns - this.base) / 1e9;
  }

  /** The capture time, nanoseconds, of seconds since the first message. */
  nanoseconds(seconds) {
    return (this.base ?? 0n) + BigInt(Math.round(seconds * 1e9));
  }

  performer(name) {
    let one = this.performers.get(name);
    if (!one) {
      const [poses, provisional, points] = [new Series(), new Series(), new Series()];
      one = { name, number: this.numberFor(name), poses, provisional, points };
      this.performers.set(name, one);
    }
    return one;
  }

  /** The number of the colour of a new performer. A second solve of `p1`, `p1 (2)`, is paler, a third one is darker. */
  numberFor(name) {
    const [, first] = /^(.*) \(\d+\)$/.exec(name) ?? [];
    const solves = [...this.performers.keys()].filter((other) => other === first || other.startsWith(`${first} (`));
    if (solves.length > 0) return this.performers.get(solves[0]).number + COLOURS.length * solves.length;
    return numberOf(name, this.performers.size);
  }

  camera(name) {
    let series = this.keypoints.get(name);
    if (!series) this.keypoints.set(name, (series = new Series()));
    return series;
  }

  /** Takes a frame. `stage`: its name, if others are told apart. A message that cannot be read is counted. */
  take(frame, stage) {
    try {
      this.sort(frame, stage);
    } catch {
      this.unreadable++;
    }
  }

  sort({ topic, capture, arrival, payload }, stage) {
    const parts = topic.split("/");
    if (stage !== undefined && parts[1] !== stage) {
      if (!this.otherStages.has(parts[1])) this.otherStages.set(parts[1], new Set());
      this.otherStages.get(parts[1]).add(parts[3]);
      return;
    }
    const read = (name) => this.decoder.decode(name, payload);
    const readNew = (name, before) => (this.isNew(topic, payload) ? read(name) : before);
    if (parts[2] === "rig") this.rig = readNew("Rig", this.rig);
    else if (parts[2] === "camera") this.takeKeypoints(read("KeypointFrame"), arrival);
    else if (parts[2] === "events") this.takeEvent(read("Event"));
    else if (parts[2] === "status") this.takeStage(read("StageStatus"));
    else if (parts[2] === "take" && parts[3] === "answers") this.takeAnswer(read("TakeAnswer"));
    else if (parts[2] === "take") this.takeSlate(read("Take"));
    else if (parts[2] === "actor" && parts[4] === "points") this.takePoints(parts[3], capture, payload);
    else if (parts[2] === "actor") this.takeActor(parts[3], parts.slice(4).join("/"), { read, readNew }, arrival);
  }

  /** Whether a state differs from the last one under that name; each part of a recording begins with all states. */
  isNew(name, payload) {
    const before = this.states.get(name);
    if (before?.length === payload.length && before.every((byte, k) => byte === payload[k])) return false;
    this.states.set(name, payload.slice());
    return true;
  }

  takeSlate(take) {
    if (["start", "stop"].includes(take.action) && take.name) this.lastTake = take.name;
  }

  takeStage(stage) {
    // On another computer the node's name is a guess.
    const isOpen = [this.guess, this.node].every((name) => !this.statusOf.has(name));
    if (this.node !== undefined && stage.node && isOpen) this.node = this.judged = stage.node;
    if (this.node === undefined || stage.node === this.node) this.stage = stage;
  }

  takeAnswer(answer) {
    const bytes = Number(answer.free_bytes ?? 0n);
    if (bytes === 0) this.answers.push(answer);
    else this.disks = [...this.disks.slice(-20), { at: performance.now(), bytes }];
  }

  takeKeypoints(frame, arrival) {
    const people = frame.people.map((person) => person.points);
    const size = [frame.image_width ?? 0, frame.image_height ?? 0];
    this.came.set(frame.camera, performance.now());
    const capture = (frame.capture_time_ns ?? 0n) + this.offsetOf(frame.camera);
    this.camera(frame.camera).add(this.seconds(capture), { people, size, arrival }, this.jump);
  }

  /** What is added to the capture times of a camera, ns: the offset of the calibration and the node's correction. */
  offsetOf(camera) {
    const known = this.rig?.cameras.find(({ name }) => name === camera)?.time_offset_ns ?? 0n;
    const { status } = this.statuses.items.at(-1) ?? {};
    const found = status?.cameras.find((one) => one.camera === camera)?.time_correction_s ?? 0;
    return known + BigInt(Math.round(found * 1e9));
  }

  /** Where a body has its keypoints: index in the format, x, y, z, and so on. */
  takePoints(name, capture, payload) {
    const points = new Float32Array(payload.slice().buffer);
    this.performer(name).points.add(this.seconds(capture), points, this.jump);
  }

  takeActor(name, channel, { read, readNew }, arrival) {
    if (channel === "events") return this.takeEvent(read("Event"), name);
    if (!["pose", "pose/provisional", "skeleton", "status"].includes(channel)) return;
    if (channel === "status") return this.takeStatus(name, read("Status"), arrival);
    const one = this.performer(name);
    if (channel === "skeleton") one.skeleton = readNew("Skeleton", one.skeleton);
    else {
      const pose = read("Pose");
      // Due times are of the cameras' clock.
      const { status } = this.statuses.items.at(-1) ?? {};
      const offset = status && 1e3 * (status.clock_offset_s ?? 0);
      const isTimed = pose.due_time_ns !== undefined && offset !== undefined;
      const item = {
        joints: Float32Array.from(pose.joint_positions_m),
        rotations: Float32Array.from([...pose.root_rotation, ...pose.local_rotations]),
        state: STATES[pose.state],
        timecode: pose.timecode ?? "",
        due: isTimed ? Number(pose.due_time_ns / 1000n) / 1e3 + offset : undefined,
        late: isTimed ? Number(arrival - pose.due_time_ns) / 1e6 - offset : undefined,
      };
      const series = channel === "pose" ? one.poses : one.provisional;
      const seconds = this.seconds(pose.capture_time_ns ?? 0n);
      // The clock has jumped back for those who are not seen now, too.
      if (series.last - seconds > this.jump) {
        for (const { poses, provisional, points } of this.performers.values()) {
          for (const all of [poses, provisional, points]) all.clear();
        }
      }
      series.add(seconds, item);
    }
  }

  /** The state of a performer, or of the node, which has the cameras. */
  takeStatus(name, status, arrival) {
    this.statusOf.set(name, status);
    if (name === this.guess) this.node = this.judged = name;
    // Before a calibration the node has no cameras; in a recording, other statuses have none.
    if (name !== this.judged || (status.cameras.length === 0 && this.node === undefined)) return;
    this.statusCame = performance.now();
    this.apart = Math.min(this.apart, Math.abs(Date.now() - Number(status.node_time_ns ?? 0n) / 1e6));
    const seconds = this.seconds(status.capture_time_ns ?? 0n);
    this.statuses.add(this.clock(arrival), { at: Number(arrival) / 1e9, seconds, status });
  }

  /** The take that runs, by the node's newest status, and for how many seconds it has had frames; `undefined`: none. */
  get runningTake() {
    const { take: name, take_since_ns: since = 0n, node_time_ns: now = 0n } = this.statuses.items.at(-1)?.status ?? {};
    if (!name) return undefined;
    const seconds = since > 0n ? Number(now - since) / 1e9 + (performance.now() - this.statusCame) / 1000 : undefined;
    return { name, seconds };
  }

  /** The least free space on a recorder's disk, bytes; `undefined`: none said it in the last 12 s. */
  get freeSpace() {
    const said = this.disks.filter(({ at }) => performance.now() - at < 12_000);
    return said.length > 0 ? Math.min(...said.map(({ bytes }) => bytes)) : undefined;
  }

  /** How a performer is shown; empty: by default. */
  labelOf(name) {
    const { display_name = "", colour = "", locked = false } = this.statusOf.get(name)?.label ?? {};
    return { display_name, colour, locked };
  }

  /** How a performer of several is there: confirmed, coasting, lost or left; `undefined`: not known. */
  lifeOf(name) {
    return this.stage?.performers.find((one) => one.name === name)?.life;
  }

  /** The time of an arrival among the capture times: seconds since the first arrival. */
  clock(arrival) {
    this.firstArrival ??= arrival;
    return Number(arrival - this.firstArrival) / 1e9;
  }

  /** The usual residual of a camera at a time, pixels; 0: not known. */
  usualOf(name, time) {
    const { items } = this.statuses;
    const newest = this.node === undefined ? items.findLast(({ seconds }) => seconds <= time + 1) : items.at(-1);
    return newest?.status.cameras.find(({ camera }) => camera === name)?.usual_px ?? 0;
  }

  /** The node's states up to a capture time, the newest last; those of two minutes. */
  historyAt(time) {
    const all = this.statuses.items.filter(({ seconds }) => seconds <= time + 1);
    return all.slice(-120);
  }

  takeEvent(event, actor) {
    const { kind = "", camera, detail = "", count = 1n } = event;
    const at = this.seconds(event.capture_time_ns ?? 0n);
    this.addEvent({ at, kind, camera, detail, count: Number(count), actor, run: event.run_id });
  }

  addEvent(event) {
    // After each reconnection the last ones come again.
    const same = (one) => ["at", "kind", "camera", "actor", "detail", "count", "run"].every((key) => one[key] === event[key]);
    if (this.jump < Infinity && this.events.some(same)) return;
    this.events.push(event);
    if (this.events.length > 20_000) this.events.shift();
  }

  /** The newest time of final poses; of keypoints, if there are no poses any more. */
  get newest() {
    const last = (all) => all.map((series) => series.last).filter((time) => time !== undefined).sort((a, b) => a - b);
    const poses = last([...this.performers.values()].map((one) => one.poses)).at(-1) ?? -Infinity;
    // The page gets no frames of cameras that are out of sight.
    const now = performance.now();
    const comes = ([name]) => this.jump === Infinity || now - this.came.get(name) < 2000;
    const coming = [...this.keypoints].filter(comes);
    const cameras = last((coming.length > 0 ? coming : [...this.keypoints]).map(([, series]) => series));
    const keypoints = cameras[cameras.length >> 1] ?? -Infinity;
    return keypoints - poses > 2 ? keypoints : poses;
  }

  /** Forgets what is older than so many seconds before the newest of its kind, and poses of who left. */
  keepLast(seconds, secondsOfPoints) {
    const { newest } = this;
    for (const { poses, provisional, points } of this.performers.values()) {
      poses.keep(newest - seconds, Infinity);
      for (const series of [provisional, points]) series.keep(newest - secondsOfPoints, Infinity);
    }
    for (const series of this.keypoints.values()) series.keep(series.last - secondsOfPoints, Infinity);
    this.statuses.keep(this.statuses.last - 300, Infinity);
  }

  keep(from, to) {
    for (const one of this.performers.values()) {
      one.poses.keep(from, to);
      one.provisional.keep(from, to);
      one.points.keep(from, to);
    }
    for (const series of this.keypoints.values()) series.keep(from, to);
  }
}
