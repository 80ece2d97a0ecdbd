// The overview page: who answered, how far people agree, and how the robot and its reward model are doing.

const EVERY = 10_000; // ms between two looks
const MARGIN = { top: 14, right: 16, bottom: 42, left: 52 };
const HEIGHT = 240;

const byId = (id) => document.getElementById(id);
let known = null; // the last overview, drawn anew when the window changes its width

function svg(name, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

const compact = new Intl.NumberFormat("en", { notation: "compact", maximumSignificantDigits: 3 });
const short = (number) => compact.format(number).replace("K", "k");
const long = (number) => number.toLocaleString("en");

/** About four round numbers from low to high, both ends covered. */
function ticks(low, high) {
  const rough = (high - low || 1) / 4;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((size) => size >= rough * 0.999);
  const first = Math.floor(low / step + 1e-9);
  const last = Math.max(Math.ceil(high / step - 1e-9), first + 1);
  return Array.from({ length: last - first + 1 }, (_, i) => Number(((first + i) * step).toPrecision(12)));
}

/**
 * A line through (x[i], y[i]) with axes. `spec`: {x, y, xTitle, yTitle, range: [low, high] or null, reference: y of a
 * dashed line or null, sentence: the text alternative, notes: a sentence a point}.
 */
function chart(place, spec) {
  const width = Math.max(place.clientWidth, 240);
  const xs = ticks(0, Math.max(...spec.x));
  const ys = ticks(...(spec.range ?? [Math.min(0, ...spec.y), Math.max(...spec.y)]));
  const [left, right, top, bottom] = [MARGIN.left, width - MARGIN.right, MARGIN.top, HEIGHT - MARGIN.bottom];
  const px = (x) => left + (x / xs.at(-1)) * (right - left);
  const py = (y) => bottom - ((y - ys[0]) / (ys.at(-1) - ys[0])) * (bottom - top);
  const across = (y) => ({ x1: left, x2: right, y1: py(y), y2: py(y) });
  const words = (text, x, y, more) => root.append(svg("text", { x, y, "text-anchor": "middle", ...more }, text));
  const size = { viewBox: `0 0 ${width} ${HEIGHT}`, width, height: HEIGHT };
  const root = svg("svg", { ...size, role: "img", "aria-label": spec.sentence });
  for (const y of ys) {
    root.append(svg("line", { class: "grid", ...across(y) }));
    words(short(y), left - 8, py(y) + 4, { "text-anchor": "end" });
  }
  for (const x of xs) words(short(x), px(x), bottom + 18);
  words(spec.xTitle, (left + right) / 2, HEIGHT - 6);
  words(spec.yTitle, 12, (top + bottom) / 2, { transform: `rotate(-90 12 ${(top + bottom) / 2})` });
  if (spec.reference !== null) root.append(svg("line", { class: "reference", ...across(spec.reference) }));
  const points = spec.x.map((x, i) => [px(x), py(spec.y[i])]);
  root.append(svg("polyline", { class: "curve", points: points.join(" ") }));
  points.forEach(([cx, cy], i) => {
    const dot = svg("circle", { class: "point", cx, cy, r: 4 });
    dot.append(svg("title", {}, spec.notes[i]));
    root.append(dot);
  });
  place.replaceChildren(root);
}

/** Heads and rows of cells into a table; a cell is text, or a number, which stands right. */
function table(place, caption, heads, rows) {
  const line = (cells, tag) => {
    const row = document.createElement("tr");
    cells.forEach((cell, i) => {
      const element = document.createElement(tag === "td" && i === 0 ? "th" : tag);
      if (tag === "th") element.scope = "col";
      else if (i === 0) element.scope = "row";
      element.textContent = cell ?? "–";
      if (i > 0) element.className = "number";
      row.append(element);
    });
    return row;
  };
  const title = document.createElement("caption");
  title.className = "unseen";
  title.textContent = caption;
  const [head, body] = ["thead", "tbody"].map((tag) => document.createElement(tag));
  head.append(line(heads, "th"));
  body.append(...rows.map((row) => line(row, "td")));
  place.replaceChildren(title, head, body);
  place.hidden = rows.length === 0;
}

function showCurve({ step, success, return: sums }) {
  const about = byId("curve-about");
  if (!step.length) {
    about.textContent = "Nothing has been evaluated yet.";
    byId("curve").replaceChildren();
    return;
  }
  const y = success ?? sums;
  const what = success ? "success" : "return";
  const last = success ? `${Math.round(y.at(-1) * 100)} % success` : `a return of ${short(y.at(-1))}`;
  about.textContent = `At step ${long(step.at(-1))}: ${last}.`;
  chart(byId("curve"), {
    x: step, y, xTitle: "environment steps", yTitle: what, range: success ? [0, 1] : null, reference: null,
    sentence: `The task's ${what} against environment steps: ${listed(step, y)}.`,
    notes: step.map((s, i) => `${short(y[i])} at step ${long(s)}`),
  });
}

function showProspective({ step, accuracy, pairs }) {
  const about = byId("prospective-about");
  if (!step.length) {
    about.textContent = "Nothing to compare yet: the model must have been fitted before the answers were given.";
    byId("prospective").replaceChildren();
    return;
  }
  about.textContent =
    "How often the model, before it had learnt from a session's answers, preferred the clip that people then " +
    "preferred. 0.5 is guessing.";
  chart(byId("prospective"), {
    x: step, y: accuracy, xTitle: "environment steps", yTitle: "agreement", range: [0, 1], reference: 0.5,
    sentence: `Agreement of the reward model with the people: ${listed(step, accuracy)}. Guessing gives 0.5.`,
    notes: step.map((s, i) => `${short(accuracy[i])} of ${pairs[i]} pairs at step ${long(s)}`),
  });
}

const listed = (step, y) => step.map((s, i) => `${short(y[i])} at ${short(s)}`).join(", ");

function showPeople(annotators) {
  const seconds = (value) => (value === null ? null : `${value.toFixed(1)} s`);
  const rows = annotators.map((one) => [one.name, one.answers, one.equals, one.skips, seconds(one.median_seconds)]);
  if (!rows.length) rows.push(["Nobody yet", "", "", "", ""]);
  table(byId("annotators"), "Answers of each person", ["Name", "Answers", "Equal", "Cannot tell", "Median time"], rows);
}

function showAgreement({ pairs, fleiss, cohen }) {
  byId("fleiss").textContent = fleiss === null ? "" : `Fleiss' kappa: ${fleiss.toFixed(2)} (${pairs} pairs)`;
  byId("agreement-about").textContent = pairs
    ? "1 is full agreement, 0 is what chance alone would give, below 0 is less than chance. From about 0.6 on, " +
      "people mean the same by “better”; under 0.4, talk about the goal first."
    : "No pair has been answered by two people yet, so agreement is not known. Train with --overlap 2 and every " +
      "pair is given to two people; it still costs one label of the budget.";
  const rows = cohen.map(({ one, other, pairs: shared, kappa }) => [`${one}, ${other}`, shared, kappa?.toFixed(2)]);
  table(byId("cohen"), "Cohen's kappa of every two people", ["Two people", "Pairs", "Cohen's kappa"], rows);
}

function draw() {
  if (!known) return;
  byId("run").textContent = known.run;
  byId("goal").textContent = known.goal;
  showCurve(known.curve);
  showProspective(known.prospective);
  showPeople(known.annotators);
  showAgreement(known.agreement);
}

async function look() {
  let next = EVERY;
  try {
    const response = await fetch("/api/overview", { signal: AbortSignal.timeout(EVERY) });
    if (response.status === 401) {
      byId("freshness").textContent = "This link has expired. Open the address again that the trainer has printed.";
      return;
    }
    if (!response.ok) throw new Error(String(response.status));
    known = await response.json();
    byId("freshness").textContent = "";
    draw();
  } catch {
    next = 3000;
    byId("freshness").textContent = "No connection to the server, trying again …";
  }
  setTimeout(look, next);
}

let drawnAt = innerWidth;
addEventListener("resize", () => {
  if (innerWidth === drawnAt) return;
  drawnAt = innerWidth;
  draw();
});
const address = new URL(location.href);
address.searchParams.delete("token");
history.replaceState(null, "", address);
look();
