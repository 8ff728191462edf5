// Parts of overlays: a drag across one, or its buttons. The server draws the samples asked for.
"use strict";

const LEAST = 8;
// The samples leave this share of the picture free on each side.
const EDGE = 0.01;
const shownPart = (box) => ({ first: Number(box.dataset.first ?? 0), last: Number(box.dataset.last ?? box.dataset.count - 1) });

async function showPart(box, first, last) {
  const most = box.dataset.count - 1;
  const length = Math.min(Math.max(Math.round(last - first), LEAST), most);
  const begin = Math.min(Math.max(Math.round(first), 0), most - length);
  box.dataset.first = begin;
  box.dataset.last = begin + length;
  mend(box);
  const query = box.dataset.overlay.includes("?") ? "&" : "?";
  const answer = await fetch(`${box.dataset.overlay}${query}first=${begin}&last=${begin + length}`);
  const html = await answer.text();
  // A later request may have been answered first.
  if (!answer.ok || Number(box.dataset.first) !== begin || Number(box.dataset.last) !== begin + length) return;
  const template = document.createElement("template");
  template.innerHTML = html;
  box.querySelector(".drawn").replaceChildren(template.content);
  document.querySelector("#live").textContent = `samples ${begin + 1} to ${begin + length + 1} of ${most + 1}`;
}

// Buttons that would do nothing say so.
function mend(box) {
  const { first, last } = shownPart(box), whole = last - first >= box.dataset.count - 1;
  const idle = { in: last - first <= LEAST, out: whole, left: first <= 0, right: last >= box.dataset.count - 1, all: whole };
  for (const button of box.querySelectorAll("[data-zoom]")) {
    button.setAttribute("aria-disabled", idle[button.dataset.zoom]);
  }
}

document.addEventListener("click", (event) => {
  const button = event.target.closest("[data-zoom]");
  if (!button || button.getAttribute("aria-disabled") === "true") return;
  const box = button.closest(".zoomable"), { first, last } = shownPart(box);
  const length = last - first, middle = (first + last) / 2;
  const parts = {
    in: [middle - length / 4, middle + length / 4],
    out: [middle - length, middle + length],
    left: [first - length / 2, last - length / 2],
    right: [first + length / 2, last + length / 2],
    all: [0, box.dataset.count - 1],
  };
  showPart(box, ...parts[button.dataset.zoom]);
});

let drag = null;

document.addEventListener("pointerdown", (event) => {
  const drawn = event.target.closest(".zoomable .drawn");
  if (!drawn || event.button !== 0) return;
  event.preventDefault();
  const plot = drawn.querySelector(".plot"), band = document.createElement("span");
  band.className = "chosen";
  drawn.append(band);
  drawn.setPointerCapture(event.pointerId);
  drag = { drawn, plot, band, start: share(plot, event) };
});

document.addEventListener("pointermove", (event) => {
  if (!drag) return;
  const here = share(drag.plot, event), left = Math.min(here, drag.start);
  const whole = drag.drawn.getBoundingClientRect(), { left: from, top, width, height } = drag.plot.getBoundingClientRect();
  const places = { left: from - whole.left + left * width, top: top - whole.top, width: Math.abs(here - drag.start) * width, height };
  for (const [side, pixels] of Object.entries(places)) drag.band.style[side] = `${pixels}px`;
});

function drop(event) {
  if (!drag) return;
  const { plot, band } = drag;
  const [start, here] = [drag.start, share(plot, event)].map((one) => one * (1 + 2 * EDGE) - EDGE);
  drag = null;
  band.remove();
  if (event.type === "pointercancel" || Math.abs(here - start) < 0.02) return;
  const box = plot.closest(".zoomable"), { first, last } = shownPart(box);
  showPart(box, first + Math.min(here, start) * (last - first), first + Math.max(here, start) * (last - first));
}
document.addEventListener("pointerup", drop);
document.addEventListener("pointercancel", drop);

function share(plot, event) {
  const { left, width } = plot.getBoundingClientRect();
  return Math.min(Math.max((event.clientX - left) / width, 0), 1);
}

for (const box of document.querySelectorAll(".zoomable")) mend(box);
