// The labelling page: one pair at a time, one key an answer, and no next pair before the server has the last answer.

import { connectKeys } from "./keys.js";
import { createPlayer } from "./player.js";
import { newId, post, wait } from "./post.js";

const el = Object.fromEntries([...document.querySelectorAll("[id]")].map((element) => [element.id, element]));
const ANSWER_BUTTONS = [...document.querySelectorAll("[data-answer]")];
const RATE_BUTTONS = [...el.rates.children];
const RATES = RATE_BUTTONS.map((button) => Number(button.dataset.rate));
const WORDS = { left: "left", right: "right", equal: "about equal", skip: "cannot tell" };
const TITLES = {
  waiting: "Nothing to label just now",
  drawing: "Clips are on their way",
  others: "Others have the rest",
  finished: "Training has finished. Thank you.",
  stopped: "Training has stopped",
};
const RUN = document.body.dataset.run; // its identity
const AWAY = 60_000; // ms out of sight after which the pair may have been leased to somebody else

/** For measuring, in ms: from answer key to next clip, and to the acknowledgement; pairs loaded in time or not. */
window.senior = { latencies: [], saves: [], loaded: { before: 0, late: 0 } };

let annotator = null;
let turn = null; // the last Turn of the server
let state = null; // the last State
let saving = false; // an answer, undo or redo is under way
let asking = false; // a turn is being asked for
let turns = 0; // how many turns were asked for: one that was overtaken is not shown
let expired = false;
let measuring = false; // an answer was given and the next clip is not on the screen yet
let rate = 1;
let events = null; // the EventSource

const player = createPlayer(
  { left: el["screen-left"], right: el["screen-right"] },
  {
    shown: pairShown,
    frame: showFrame,
    playing: showPlaying,
    trouble: (yes) => tell(yes ? "A clip cannot be loaded, trying again …" : "", "refused"),
    shape: (ratio) => el.stage.style.setProperty("--ratio", ratio),
  },
);

// How long the pair has been looked at: from its first frame on, without the time the page was out of sight.
const watch = {
  seen: false,
  total: 0,
  since: null,
  run(on) {
    if (this.since !== null) this.total += performance.now() - this.since;
    this.since = on && this.seen ? performance.now() : null;
  },
  seconds() {
    this.run(!document.hidden);
    return Math.round(this.total) / 1000;
  },
};

const hasClips = (pair) => Boolean(pair?.left && pair?.right);
const same = (a, b) => a?.pair === b?.pair && a?.left === b?.left && a?.right === b?.right;
const detailOf = (data) => (typeof data.detail === "string" ? data.detail : "The server refused this.");

function tell(text, kind = "") {
  el.status.textContent = text;
  el.status.className = kind;
}

function warn(text) {
  el.unsaved.textContent = text;
  el.unsaved.hidden = !text;
}

/** Private windows may refuse storage; the page then only forgets. */
function remember(store, name, value) {
  try {
    if (value !== undefined) window[store].setItem(name, value);
    return window[store].getItem(name);
  } catch {
    return null;
  }
}

// Turns: what the server is asked, and what it says

/** {status, data}, or null where the token is no longer good, which is shown, or another run is served here. */
async function send(path, body, wording) {
  const reply = await post(path, { ...body, run: RUN }, wording, warn);
  if (reply.status === 401) expire();
  else if (reply.status === 410) location.reload();
  else return reply;
  return null;
}

/** Asks for the pair to show: at first, whenever there is none, and after a long absence. */
async function ask() {
  if (asking || saving || expired || !annotator) return;
  asking = true;
  const mine = (turns += 1);
  const reply = await send("/api/next", { annotator }, "No connection to the server, trying again …");
  asking = false;
  if (reply === null || mine !== turns) return;
  if (reply.status === 200) {
    show(reply.data);
    if (!events) listen();
  } else if (turn === null) {
    askName(detailOf(reply.data));
  } else tell(detailOf(reply.data), "refused");
}

/** An answer, undo or redo: one at a time, under one id, until the server has acknowledged it. */
async function act(path, fields, button) {
  if (saving || expired || !turn) return;
  if (isOver()) return tell("Training has finished; no answer can be changed any more.", "refused");
  saving = true;
  turns += 1;
  button.classList.add("chosen");
  tell("");
  showReadiness();
  const began = performance.now();
  const reply = await send(path, { post: newId(), annotator, ...fields }, "Not saved, trying again …");
  button.classList.remove("chosen");
  if (reply === null) return;
  saving = false;
  window.senior.saves.push(performance.now() - began);
  show(reply.status === 200 ? reply.data : (reply.data.turn ?? turn));
  if (reply.status === 200) tell(confirmation(path, reply.data.said), "saved");
  else tell(detailOf(reply.data), "refused");
}

function confirmation(path, said) {
  const words = said ? [WORDS[said.answer], said.strength].filter(Boolean).join(", ") : "";
  if (path === "/api/undo") return `Undone: ${words}. Please answer again.`;
  return `${path === "/api/redo" ? "Redone" : "Saved"}: ${words}`;
}

function answer(name, strength = "clearly") {
  const pair = turn?.pair;
  if (!pair || saving) return;
  if (name !== "skip" && !watch.seen) {
    tell(hasClips(pair) ? "The clips are still loading." : "This pair can only be skipped.", "refused");
    return;
  }
  performance.clearMarks("answer");
  performance.mark("answer");
  measuring = true;
  const graded = state.strength && (name === "left" || name === "right");
  const fields = { pair: pair.pair, answer: name, strength: graded ? strength : null };
  const button = graded && strength === "slightly" ? el[`${name}-slightly`] : el[name];
  act("/api/answer", { ...fields, seconds: watch.seconds(), replays: player.loops() }, button);
}

const undo = () => act("/api/undo", {}, el.undo);
const redo = () => act("/api/redo", {}, el.redo);

function show(next) {
  const before = turn?.pair;
  turn = next;
  const { pair } = turn;
  measuring &&= hasClips(pair);
  if (!same(pair, before)) {
    Object.assign(watch, { seen: false, total: 0, since: null });
    enlarge(null);
    const loaded = player.open(pair);
    if (before && hasClips(pair)) window.senior.loaded[loaded ? "before" : "late"] += 1;
  }
  player.prefetch([pair, ...turn.ahead]);
  showState(turn.state);
  showPair(pair);
}

/** Nothing comes any more, and the server ends with the trainer: the page does not ask for it. */
const isOver = () => turn?.kind === "finished";

function pairShown() {
  if (measuring) window.senior.latencies.push(performance.measure("key to clip", "answer").duration);
  measuring = false;
  watch.seen = true;
  watch.run(!document.hidden);
  showReadiness();
}

function expire() {
  expired = true;
  events?.close();
  player.pause();
  const lost = saving ? "Your last answer is not saved. " : "";
  warn(`${lost}This link has expired. Open the address again that the trainer has printed.`);
  showReadiness();
}

// What is on the page

function showPair(pair) {
  const clips = hasClips(pair);
  for (const id of ["pane-left", "pane-right"]) el[id].hidden = !clips;
  el.controls.classList.toggle("off", !clips);
  el.number.textContent = pair ? `Pair ${pair.number} of ${pair.size}` : "";
  el.note.textContent = (clips && pair.note) || "";
  el.empty.hidden = clips;
  el.empty.dataset.kind = turn.kind ?? "";
  el["empty-title"].textContent = pair ? "This pair cannot be shown" : titleOfNone();
  el["empty-why"].textContent = pair ? `${pair.note ?? ""} Choose “Cannot tell” to go on.` : turn.why;
  if (clips) el.seek.max = pair.frames - 1;
  setRate(rate);
  showReadiness();
}

function titleOfNone() {
  const { done, budget } = turn.state.labels;
  if (done >= budget && ["waiting", "finished"].includes(turn.kind)) return "All labels are given. Thank you.";
  return TITLES[turn.kind] ?? "No pair";
}

/** data-state of the body says how far the page is: start, loading, ready, saving, broken, empty, expired. */
function showReadiness() {
  const pair = turn?.pair;
  const idle = !turn ? "start" : !pair ? "empty" : !hasClips(pair) ? "broken" : watch.seen ? "ready" : "loading";
  document.body.dataset.state = expired ? "expired" : saving ? "saving" : idle;
  document.body.dataset.pair = pair?.pair ?? "";
  const free = Boolean(turn && !saving && !expired);
  for (const button of ANSWER_BUTTONS) {
    button.setAttribute("aria-disabled", String(!(free && pair && (watch.seen || button === el.skip))));
  }
  for (const button of [el.undo, el.redo]) button.setAttribute("aria-disabled", String(!free));
}

function showState(news) {
  const phase = state?.trainer.phase;
  state = news;
  const { labels, trainer, clips, you } = state;
  el.bar.max = Math.max(labels.budget, 1);
  el.bar.value = labels.done;
  el.labels.textContent = `${labels.done} of ${labels.budget} labels`;
  const { number, done, size } = labels.session ?? {};
  el.session.textContent = labels.session ? `session ${number}: ${done} of ${size}` : "";
  el.pace.textContent = labels.per_hour === null ? "" : `${Math.round(labels.per_hour).toLocaleString("en")} an hour`;
  el.trainer.textContent = clips.failure ?? trainer.text;
  el.dot.dataset.phase = clips.failure ? "stopped" : trainer.phase;
  el["empty-trainer"].textContent = turn.kind === "waiting" && trainer.text !== turn.why ? trainer.text : "";
  el.drawn.hidden = turn.kind !== "drawing";
  el.drawn.max = Math.max(clips.wanted, 1);
  el.drawn.value = clips.ready;
  if (phase !== trainer.phase) el.announcer.textContent = trainer.text;
  if (el["goal-form"].hidden) el.goal.textContent = state.goal;
  el.who.textContent = `${annotator} · ${you?.answers ?? 0}`;
  el.who.setAttribute("aria-label", `Labelling as ${annotator}, ${you?.answers ?? 0} answers. Change the name.`);
  el.undo.classList.toggle("spent", !you?.undo);
  el.redo.classList.toggle("spent", !you?.redo);
  document.body.classList.toggle("graded", state.strength);
  showTitle();
}

/** A tab in the background says in its title that the trainer waits for answers. */
function showTitle() {
  const called = document.hidden && turn && !turn.pair && state.trainer.phase === "waiting";
  document.title = `${called ? "● Pairs are waiting · " : ""}${el.run.textContent} · SENIOR`;
}

function showFrame(k) {
  const { frames } = turn.pair;
  el.seek.value = k;
  el.seek.setAttribute("aria-valuetext", `Frame ${k + 1} of ${frames}`);
  el.frame.textContent = `${k + 1} / ${frames}`;
}

function showPlaying(playing) {
  el.play.setAttribute("aria-label", playing ? "Pause" : "Play");
  el["play-shape"].setAttribute("d", playing ? "M8 5v14M16 5v14" : "M8 5l11 7-11 7z");
  el.stage.classList.toggle("paused", !playing);
}

function setRate(value) {
  rate = value;
  for (const button of RATE_BUTTONS) button.setAttribute("aria-pressed", String(Number(button.dataset.rate) === rate));
  const real = rate * (turn?.pair?.speed ?? 1); // how fast the robot is seen to move
  el.real.textContent = real === 1 ? "real time" : `${Number(real.toPrecision(2))}× real\u00a0time`;
  player.setRate(rate);
  remember("localStorage", "senior-rate", rate);
}

const shiftRate = (by) => setRate(RATES[Math.max(0, Math.min(RATES.length - 1, RATES.indexOf(rate) + by))]);

/** Makes one clip ("left" or "right") large, or shows both again: null, or the one that is large already. */
function enlarge(side) {
  const large = side && !el[`pane-${side}`].classList.contains("large") ? side : null;
  document.body.classList.toggle("zoomed", large !== null);
  for (const name of ["left", "right"]) {
    const pane = el[`pane-${name}`];
    pane.classList.toggle("large", large === name);
    pane.classList.toggle("beside", large !== null && large !== name);
    pane.setAttribute("aria-pressed", String(large === name));
  }
}

// Live news

function listen() {
  events?.close();
  const mine = new EventSource(`/api/events?annotator=${encodeURIComponent(annotator)}`);
  events = mine;
  mine.onopen = () => (el.connection.hidden = true);
  mine.addEventListener("state", (event) => {
    const news = JSON.parse(event.data);
    if (news.identity !== RUN && !saving) return location.reload();
    showState(news);
    if (state.trainer.phase !== "finished" || saving) return;
    show({ ...turn, pair: null, ahead: [], kind: "finished", why: state.trainer.text, state });
  });
  // Browsers differ in when they give up; closing and opening anew is the same in all of them.
  mine.onerror = async () => {
    mine.close();
    if (isOver()) return;
    el.connection.hidden = false;
    await wait(1500);
    if (events !== mine || isOver()) return;
    const refused = await fetch("/api/state").then((response) => response.status === 401, () => false);
    if (events !== mine || expired) return;
    if (refused) expire();
    else listen();
  };
}

/** A tab out of sight asks for nothing: it would lease pairs that others could answer. */
function poll() {
  if (!document.hidden && turn && !turn.pair && !isOver()) ask();
  setTimeout(poll, turn?.kind === "stopped" ? 5000 : 1000);
}

/** After a sleep or a way back in history the connection may be dead without knowing. */
function comeBack() {
  if (!events || expired || isOver()) return;
  listen();
  ask();
}

let resume = false;
let leftAt = 0;

function visibility() {
  watch.run(!document.hidden);
  showTitle();
  if (document.hidden) {
    leftAt = performance.now();
    resume = player.isPlaying();
    player.pause();
    return;
  }
  if (resume || !watch.seen) player.play();
  if (performance.now() - leftAt > AWAY) comeBack();
}

// The goal and the name

function editGoal(open) {
  el["goal-form"].hidden = !open;
  el["goal-shown"].hidden = open;
  el["goal-input"].value = el.goal.textContent;
  if (open) el["goal-input"].select();
  else el.main.focus({ preventScroll: true });
}

async function saveGoal(event) {
  event.preventDefault();
  const reply = await send("/api/goal", { goal: el["goal-input"].value.trim() }, "Goal not saved, trying again …");
  if (reply === null) return;
  if (reply.status !== 200) return tell(detailOf(reply.data), "refused");
  el.goal.textContent = reply.data.goal;
  editGoal(false);
  tell("Goal saved", "saved");
}

function askName(problem = "") {
  if (saving) return;
  el["name-problem"].textContent = problem;
  el.name.value = annotator ?? remember("localStorage", "senior-annotator") ?? "";
  el.start.showModal();
  el.name.select();
}

/** The name stays with this tab; another tab is asked again, with this name filled in. */
function begin(name) {
  for (const store of ["localStorage", "sessionStorage"]) remember(store, "senior-annotator", name);
  el.main.focus({ preventScroll: true });
  el.start.close();
  if (name === annotator && turn) return;
  annotator = name;
  player.open(null);
  turn = null;
  turns += 1;
  asking = false;
  events?.close();
  events = null;
  tell("");
  ask();
}

// Buttons and keys

function connectButtons() {
  for (const button of ANSWER_BUTTONS) {
    // The second click of a double click was not meant for the pair that has come up in between.
    const { answer: name, strength } = button.dataset;
    button.addEventListener("click", (event) => event.detail > 1 || answer(name, strength));
  }
  for (const button of RATE_BUTTONS) button.addEventListener("click", () => setRate(Number(button.dataset.rate)));
  const clicks = {
    undo, redo, "help-open": toggleHelp, "help-close": toggleHelp, who: () => askName(),
    play: player.toggle, back: () => player.step(-1), forward: () => player.step(1),
    "pane-left": () => enlarge("left"), "pane-right": () => enlarge("right"),
    "goal-edit": () => editGoal(true), "goal-cancel": () => editGoal(false),
  };
  for (const [id, action] of Object.entries(clicks)) el[id].addEventListener("click", () => action());
  el.seek.addEventListener("input", () => player.seek(Number(el.seek.value)));
  el.seek.addEventListener("pointerup", () => el.seek.blur());
  // A button pressed by mouse or finger gives the focus back, or the next Space would press it again.
  el.main.addEventListener("click", (event) => event.detail > 0 && event.target.closest("button")?.blur());
  el["goal-form"].addEventListener("submit", saveGoal);
  el["goal-input"].addEventListener("keydown", (event) => event.key === "Escape" && editGoal(false));
  el.start.addEventListener("close", () => annotator || askName()); // Escape does not do without a name
  el["name-form"].addEventListener("submit", (event) => {
    event.preventDefault();
    if (el.name.value.trim()) begin(el.name.value.trim());
  });
}

function toggleHelp() {
  if (el.help.open) el.help.close();
  else el.help.showModal();
}

function bindings() {
  const [left, right, equal, skip] = ["left", "right", "equal", "skip"].map((name) => () => answer(name));
  const slightly = { left: () => answer("left", "slightly"), right: () => answer("right", "slightly") };
  const cycle = () => setRate(RATES[(RATES.indexOf(rate) + 1) % RATES.length]);
  return {
    arrowleft: left, a: left, arrowright: right, d: right,
    "shift+arrowleft": slightly.left, "shift+a": slightly.left,
    "shift+arrowright": slightly.right, "shift+d": slightly.right,
    arrowdown: equal, e: equal, "=": equal, s: skip,
    z: undo, backspace: undo, "control+z": undo, y: redo, "shift+z": redo, "control+y": redo, "control+shift+z": redo,
    " ": () => player.toggle(), ",": () => player.step(-1), ".": () => player.step(1),
    "[": () => shiftRate(-1), "]": () => shiftRate(1), x: cycle,
    1: () => enlarge("left"), 2: () => enlarge("right"), escape: () => enlarge(null), "?": toggleHelp,
  };
}

/** While a dialog is open only the key that closes it acts. */
const blocked = (action) => (el.help.open ? action !== toggleHelp : el.start.open);

function main() {
  const address = new URL(location.href);
  address.searchParams.delete("token");
  history.replaceState(null, "", address);
  connectButtons();
  connectKeys(bindings(), blocked);
  document.addEventListener("visibilitychange", visibility);
  addEventListener("pageshow", (event) => event.persisted && comeBack());
  addEventListener("beforeunload", (event) => saving && !el.unsaved.hidden && !expired && event.preventDefault());
  const chosen = Number(remember("localStorage", "senior-rate"));
  setRate(RATES.includes(chosen) ? chosen : 1);
  showReadiness();
  const name = remember("sessionStorage", "senior-annotator");
  if (name) begin(name);
  else askName();
  poll();
}

main();
