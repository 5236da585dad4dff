// The commands of `bundlemocap take`.

const $ = (id) => document.getElementById(id);
/** How long nodes and recorders have for an answer, ms. */
const PATIENCE = 5000;
/** For how long a command of this page counts before the node's status tells what became of it, ms. */
const PENDING = 2500;
/** Two presses of the button within this time, ms, are one. */
const DOUBLE_CLICK = 400;
/** A disk with less free space, bytes, is nearly full. */
const LEAST_FREE = 2e9;
/** Who answers a command, if not nodes alone. */
const ANSWERERS = { start: ["node", "recorder"], stop: ["node", "recorder"], note: ["recorder"] };

/**
 * Connects the forms with a live stage; `lookOf` says how a performer is shown, `floorAt` which place on the floor is at
 * a place of the window. Call the result a few times a second: it shows the state of the take.
 */
export function takes(store, source, lookOf, floorAt) {
  let [sent, answers] = [undefined, []];
  // What a recorder says of a take that it has ended.
  let cut;
  const commands = (...all) => {
    if (!source.connected) {
      [sent, answers] = [undefined, [{ role: "not sent", text: "no connection" }]];
      return;
    }
    const ids = all.map(([action, name, more]) => BigInt(source.command(action, name, more)));
    sent = { ids, action: all[0][0], name: all[0][1], at: performance.now() };
    answers = [];
  };
  const command = (...one) => commands(one);
  const running = () => {
    const age = performance.now() - (sent?.at ?? -Infinity);
    const isPending = age < PENDING && answers.every(({ role, refused }) => role !== "node" || !refused);
    if (isPending && sent.action === "start") return { name: sent.name, seconds: age / 1000 };
    return isPending && sent.action === "stop" ? undefined : store.runningTake;
  };
  let submitted = -Infinity;
  $("take").hidden = false;
  $("take").addEventListener("submit", (event) => {
    event.preventDefault();
    if (performance.now() - submitted < DOUBLE_CLICK) return;
    submitted = performance.now();
    // What the button shows: another page may have ended the take since then.
    if (shown) command("stop", shown);
    else command("start", $("take-name").value);
  });
  $("reset").addEventListener("click", () => command("reset"));
  // Name of the take that runs, or of the last one; and the take whose next name is in the field.
  let [noteTake, followed] = [undefined, undefined];
  // The take that the button ends.
  let shown;
  const sendNote = (mark) => {
    // The text stays until it can be sent.
    if (!source.connected || (!mark && !$("note").value.trim())) return;
    command("note", noteTake, { mark, note: $("note").value });
    $("note").value = "";
  };
  for (const mark of ["good", "bad"]) $(mark).addEventListener("click", () => sendNote(mark));
  $("notes").addEventListener("submit", (event) => {
    event.preventDefault();
    sendNote();
  });
  $("moved").addEventListener("click", ({ target }) => {
    if (target.dataset.mend) command("mend", target.dataset.mend);
  });
  const arm = (on) => $("choose").setAttribute("aria-pressed", String(on));
  $("choose").addEventListener("click", () => arm($("choose").getAttribute("aria-pressed") !== "true"));
  // A drag turns the view.
  let pressed = [0, 0];
  $("canvas").addEventListener("pointerdown", ({ clientX, clientY }) => (pressed = [clientX, clientY]));
  $("canvas").addEventListener("click", ({ clientX, clientY }) => {
    const isArmed = $("choose").getAttribute("aria-pressed") === "true" && !$("choose").hidden;
    const isDrag = Math.hypot(clientX - pressed[0], clientY - pressed[1]) > 5;
    const place = isArmed && !isDrag ? floorAt(clientX, clientY) : undefined;
    if (!place) return;
    arm(false);
    command("follow", "", { place_m: place });
  });
  // The performer in the form, as it was opened.
  let edited;
  $("performers").addEventListener("click", ({ target }) => {
    const one = store.performers.get(target.dataset.label);
    if (!one) return;
    edited = { name: one.name, ...store.labelOf(one.name) };
    $("labelled").textContent = one.name;
    [$("shown").value, $("locked").checked] = [edited.display_name, edited.locked];
    [$("named").value, $("dropped").checked] = [one.name, false];
    // The only performer is called as the settings say.
    for (const part of document.querySelectorAll("#label .several")) part.hidden = one.name === store.node;
    $("usual").checked = edited.colour === "";
    $("colour").value = lookOf(one).tint;
    $("label").returnValue = "";
    $("label").showModal();
  });
  $("colour").addEventListener("input", () => ($("usual").checked = false));
  $("label").addEventListener("close", () => {
    if ($("label").returnValue !== "save") return;
    const { name, display_name, colour, locked } = edited;
    const wanted = { display_name: $("shown").value.trim(), colour: $("usual").checked ? "" : $("colour").value };
    const all = [];
    if ($("locked").checked !== locked) all.push([locked ? "unlock" : "lock", name]);
    if (wanted.display_name !== display_name || wanted.colour !== colour) all.push(["label", name, wanted]);
    if ($("dropped").checked) all.push(["drop", name]);
    // The last: then this name is no more.
    if ($("named").value !== name && $("named").value) all.push(["name", name, { new_name: $("named").value }]);
    if (all.length > 0) commands(...all);
  });
  return () => {
    const take = running();
    noteTake = take?.name || store.lastTake || noteTake;
    if (noteTake) {
      $("notes").hidden = false;
      set($("noted"), noteTake);
    }
    if (!take && noteTake !== followed) {
      followed = noteTake;
      $("take-name").value = next(noteTake);
    }
    shown = take?.name;
    $("record").disabled = !source.connected;
    $("record").setAttribute("aria-pressed", String(take !== undefined));
    const seconds = Math.floor(take?.seconds);
    const clock = take?.seconds === undefined ? "no frames" : `${String(Math.floor(seconds / 60)).padStart(2, "0")}:${String(seconds % 60).padStart(2, "0")}`;
    set($("record"), take ? `● ${take.name} ${clock} Stop` : "Record");
    $("take-name").disabled = take !== undefined;
    const told = store.answers.splice(0);
    answers.push(...told.filter(({ id }) => sent?.ids.includes(id)));
    cut = take && (told.findLast(({ id = 0n }) => id === 0n)?.text ?? cut);
    const isCut = cut?.startsWith(`take ${take.name} ends`) ?? false;
    const isRecorder = ({ program }) => program.startsWith("bundlemocap record");
    // One that records cameras alone, or another program, tells of its disk.
    const isRecorded = store.freeSpace !== undefined || (source.receivers?.some(isRecorder) ?? true);
    $("answers").classList.toggle("bad", take !== undefined && (isCut || !isRecorded));
    const lines = answers.map(({ role, text = "", refused }) => `${role}${refused ? " refuses" : ""}: ${text}`);
    if (take && !isRecorded) lines.unshift("no recorder is known: start `bundlemocap record takes/`");
    if (isCut) lines.unshift(cut);
    const wanted = ANSWERERS[sent?.action] ?? ["node"];
    const isOver = sent && performance.now() - sent.at > PATIENCE;
    for (const role of isOver ? wanted.filter((one) => answers.every((answer) => answer.role !== one)) : []) {
      lines.push(`no ${role} answered`);
    }
    const free = store.freeSpace;
    $("free").hidden = free === undefined;
    $("free").classList.toggle("bad", free < LEAST_FREE);
    if (free !== undefined) set($("free"), `${(free / 1e9).toFixed(1)} GB free`);
    set($("answers"), lines.join("; "));
    $("answers").title = lines.join("\n");
  };
}

/** The name of the next take: one more than the number at its end. */
function next(name) {
  const [, stem, digits] = /^(.*?)(\d*)$/.exec(name);
  return digits ? stem + String(BigInt(digits) + 1n).padStart(digits.length, "0") : `${name}_02`;
}

function set(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
