// Keeps a page up to date: asks for what is new, puts it in its place, says it aloud.
"use strict";

const one = (query, place = document) => place.querySelector(query);
const all = (query, place = document) => [...place.querySelectorAll(query)];
const PART = 50;

// HTML of the server, which escaped all words that are not its own.
function elements(html) {
  const template = document.createElement("template");
  template.innerHTML = html;
  return template.content;
}

async function ask(address) {
  const answer = await fetch(address);
  if (answer.status === 204) return "";
  if (!answer.ok) throw new Error(`${address}: ${answer.status}`);
  return answer.text();
}

// Calls no more often than every `pause` ms; the last call is never lost.
function atMost(pause, call) {
  let timer = null, last = -Infinity;
  return () => {
    if (timer !== null) return;
    const wait = Math.max(0, last + pause - performance.now());
    timer = setTimeout(() => { timer = null; last = performance.now(); call(); }, wait);
  };
}

// ---- the list of experiments

const rows = one("#rows");

const form = one("#choose");

// What the user chose, without what is empty: the address of the page and of its rows.
function chosen() {
  return new URLSearchParams([...new FormData(form)].filter(([, value]) => value.trim()));
}

let asked = 0;

async function choose() {
  const query = chosen(), mine = ++asked;
  history.replaceState(null, "", `${query.size ? `?${query}` : location.pathname}${location.hash}`);
  const found = await ask(`${one("[data-run]").dataset.run}/rows?${query}`).then(elements, () => null);
  if (found && mine === asked) rows.replaceChildren(found);
}

const chooseAgain = atMost(1000, choose);

function put(row) {
  const fresh = elements(row.html).firstElementChild;
  const old = document.getElementById(fresh.id);
  fresh.classList.add("new");
  if (old) {
    const focused = old.contains(document.activeElement);
    old.replaceWith(fresh);
    if (focused) one("a", fresh).focus();
    return;
  }
  let part = one(".part", rows);
  if (!part || part.children.length >= PART) {
    part = document.createElement("ol");
    part.className = "part";
    rows.prepend(part);
  }
  const below = rows.scrollTop;
  part.prepend(fresh);
  part.style.setProperty("--rows", part.children.length);
  // Who reads further down stays where they are.
  if (below > 0) rows.scrollTop = below + fresh.offsetHeight;
}

// The experiments after those in the list, whose end is a button.
async function further() {
  const button = one(".more", rows);
  if (!button || button.disabled) return;
  button.disabled = true;
  const query = chosen();
  query.set("after", button.dataset.after);
  const found = await ask(`${one("[data-run]").dataset.run}/rows?${query}`).then(elements, () => null);
  if (!found) return void (button.disabled = false);
  const first = document.activeElement === button ? one("a", found) : null;
  button.replaceWith(found);
  first?.focus();
  nearEnd();
}

function nearEnd() {
  if (rows.scrollHeight - rows.scrollTop - rows.clientHeight < 3000) further();
}

// ---- sections of the report, and the curve

const shown = new Map();

async function fill(part) {
  const html = await ask(part.dataset.part);
  const section = part.closest("section");
  const link = one(`nav a[href="#${section.id}"]`)?.parentElement;
  section.hidden = !html;
  if (link) link.hidden = !html;
  const used = part.contains(document.activeElement) && document.activeElement !== document.body;
  if (html === shown.get(part) || (used && shown.has(part))) return;
  const open = all("details", part).map((d) => d.open);
  const chosen = one("input:checked", part)?.id;
  part.replaceChildren(elements(html));
  if (chosen && one(`#${chosen}`)) one(`#${chosen}`).checked = true;
  if (shown.has(part)) all("details", part).forEach((d, k) => { if (k < open.length) d.open = open[k]; });
  shown.set(part, html);
}

const fillAll = atMost(2000, async () => {
  for (const part of all("[data-part]")) await fill(part).catch(() => {});
});

const drawCurve = atMost(400, async () => {
  const place = one("[data-curve]");
  if (place) place.replaceChildren(elements(await ask(place.dataset.curve)));
});

// ---- the stream

function connected(words, lost) {
  const place = one("#connection");
  if (place.textContent !== words) place.textContent = words;
  place.classList.toggle("lost", lost);
}

// isLedger: the ledger has new lines; else only figures of the running fit changed.
function news(data, isLedger) {
  if (rows && chosen().size) data.rows.length && chooseAgain();
  else if (rows) for (const row of [...data.rows].reverse()) put(row);
  for (const [name, html] of Object.entries(data.parts)) {
    const place = document.getElementById(name);
    if (place) swap(place, html);
  }
  if ("running" in data) {
    for (const button of all("[data-running]")) button.disabled = !data.running;
  }
  if (data.said) one("#live").textContent = data.said;
  if (data.rows.length) drawCurve();
  if (isLedger) fillAll();
  const fresh = one("[data-refresh]");
  const only = Number(fresh?.dataset.only ?? NaN);
  if (fresh && data.rows.some((row) => Number.isNaN(only) || row.number === only)) refresh();
}

const refresh = atMost(1000, async () => {
  const place = one("[data-refresh]");
  const fresh = await ask(place.dataset.refresh).then(elements);
  for (const box of all("input[type=checkbox][id]", fresh)) box.checked = one(`#${box.id}`)?.checked ?? box.checked;
  place.replaceChildren(fresh);
});

// The losses of a running fit as a line without axes; logarithmic where all are positive.
function drawLosses() {
  for (const svg of all("svg[data-losses]")) {
    const points = JSON.parse(svg.dataset.losses), isLog = points.every(([, loss]) => loss > 0);
    const columns = [points.map(([step]) => step), points.map(([, loss]) => (isLog ? Math.log(loss) : loss))];
    const [x, y] = columns.map((values) => {
      const low = Math.min(...values), high = Math.max(...values);
      return values.map((value) => (high > low ? (value - low) / (high - low) : 0.5));
    });
    const line = document.createElementNS("http://www.w3.org/2000/svg", "polyline");
    line.setAttribute("points", x.map((share, k) => `${2 + 136 * share},${30 - 26 * y[k]}`).join(" "));
    svg.setAttribute("viewBox", "0 0 140 34");
    svg.replaceChildren(line);
  }
}

// Checked boxes and the focus survive.
function swap(place, html) {
  const checked = new Set(all("input:checked", place).map((box) => box.value));
  const focused = document.activeElement?.value;
  const inside = place.contains(document.activeElement);
  place.replaceChildren(elements(html));
  drawLosses();
  for (const box of all("input", place)) {
    box.checked = checked.has(box.value);
    if (inside && box.value === focused) box.focus();
  }
}

function follow(place) {
  let mark = place.dataset.mark, source = null, again = null;
  function begin() {
    if (source || document.hidden) return;
    source = new EventSource(`${place.dataset.stream}?mark=${encodeURIComponent(mark)}`);
    source.onopen = () => connected("live", false);
    source.addEventListener("news", (event) => {
      const isLedger = mark !== event.lastEventId;
      mark = event.lastEventId;
      connected("live", false);
      news(JSON.parse(event.data), isLedger);
    });
    source.addEventListener("anew", () => location.reload());
    source.addEventListener("trouble", (event) => connected(JSON.parse(event.data).words, true));
    source.onerror = () => {
      connected("no connection: is asia view still running?", true);
      end();
      again ??= setTimeout(() => { again = null; begin(); }, 500);
    };
  }
  function end() {
    source?.close();
    source = null;
  }
  // A browser keeps few connections to a host: pages that nobody sees give theirs back.
  document.addEventListener("visibilitychange", () => (document.hidden ? end() : begin()));
  window.addEventListener("pagehide", end);
  begin();
}

// ---- a person's word

async function tell(element, text) {
  const panel = element.closest("[data-at]"), place = one("[role=status]", panel);
  try {
    const answer = await fetch(`${panel.dataset.at}/${element.dataset.post}`, {
      method: "POST",
      headers: { "X-ASIA-Token": one("meta[name=asia-token]").content },
      body: text,
    });
    const kind = answer.headers.get("content-type") ?? "";
    const found = kind.includes("json") ? await answer.json() : { words: await answer.text() };
    place.textContent = found.words;
    if (found.address) location.assign(found.address);
    return answer.ok;
  } catch {
    place.textContent = "not sent: there is no connection";
    return false;
  }
}

document.addEventListener("submit", async (event) => {
  const form = event.target;
  if (!form.dataset.post) return;
  event.preventDefault();
  const fields = Object.fromEntries(new FormData(form));
  const button = one("[type=submit]", form);
  button.disabled = true;
  if (await tell(form, form.dataset.post === "steer" ? fields.text : JSON.stringify(fields))) form.reset();
  button.disabled = false;
});

document.addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (!button) return;
  if (button.classList.contains("more")) further();
  const what = button.dataset.post;
  if (!what) return;
  if (what === "stop" && !confirm("Stop the search after this experiment?")) return;
  tell(button, "");
});

// ---- runs to compare

const compare = one("#chosen");
if (compare) document.addEventListener("change", () => (compare.disabled = !one("input[name=run]:checked")));

if (rows) {
  form.addEventListener("input", atMost(150, choose));
  form.addEventListener("submit", (event) => { event.preventDefault(); choose(); });
  rows.addEventListener("scroll", nearEnd, { passive: true });
}
for (const place of all("[data-stream]")) follow(place);
drawLosses();
fillAll();
