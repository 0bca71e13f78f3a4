"use strict";
// The list of all units: sorting and filter. A browser lays out long tables slowly: of many rows only those in view are in the page, and
// the margins of the table take the space of the others. Rows beyond the first are HTML in #others until they come into view.
const ENTITIES = { "&amp;": "&", "&lt;": "<", "&gt;": ">", "&#34;": '"', "&#39;": "'" };
const maker = document.createElement("template");
class Row {
  constructor(source) { if (typeof source === "string") this.html = source; else this.made = source; }
  get element() {
    if (!this.made) { maker.innerHTML = this.html; this.made = maker.content.firstElementChild; }
    this.made.classList.toggle("chosen", Boolean(this.chosen));
    return this.made;
  }
  get cells() { // their texts
    return this.texts ??= this.html ? this.html.split(/<t[hd]\b[^>]*>/).slice(1).map((cell) => cell.replace(/<[^>]*>/g, "").replace(/&[a-z#0-9]+;/g, (e) => ENTITIES[e] ?? e).trim())
      : Array.from(this.made.cells, (cell) => cell.textContent.trim());
  }
  get words() { return this.lower ??= this.cells.join(" ").toLowerCase(); }
}
const text = (row, column) => row.cells[column].replaceAll("\u2212", "-");
const collator = new Intl.Collator(undefined, { numeric: true });
function sorted(rows, column, down) { // empty cells last
  const keys = rows.map((row) => text(row, column)), full = keys.filter((k) => k !== "");
  const numbers = full.every((k) => !Number.isNaN(Number(k)));
  const compare = numbers ? (a, b) => a - b : (a, b) => collator.compare(a, b), sign = down ? -1 : 1;
  const keyed = rows.map((row, i) => [keys[i], row, i]);
  keyed.sort(([a, , i], [b, , j]) => a === "" || b === "" ? (a === "") - (b === "") || i - j : sign * compare(a, b) || i - j);
  return keyed.map(([, row]) => row);
}
const tables = new Map();
for (const table of document.querySelectorAll("table.units")) {
  const others = table.id === "all" ? JSON.parse(document.querySelector("#others")?.textContent ?? "[]") : [];
  const rows = [...table.tBodies[0].rows, ...others].map((source) => new Row(source));
  const state = { rows, draw: () => table.tBodies[0].replaceChildren(...state.rows.map((row) => row.element)) };
  tables.set(table, state);
  const headings = [...table.tHead.rows[1].cells];
  for (const heading of headings) {
    heading.querySelector("button").addEventListener("click", () => {
      const down = heading.getAttribute("aria-sort") === "ascending";
      for (const other of headings) other.removeAttribute("aria-sort");
      heading.setAttribute("aria-sort", down ? "descending" : "ascending");
      state.rows = sorted(state.rows, heading.cellIndex, down);
      state.draw();
    });
  }
}
const all = document.querySelector("#all"), state = tables.get(all), view = all.parentNode;
const box = document.querySelector("#filter"), shown = document.querySelector("#shown");
const WHOLE = 100, BESIDE = 20; // rows that are all in the page; rows of longer lists above and below the view
let height = 0, at = -1, printing = false;
function drawView() { // the rows in view
  const { found } = state, body = all.tBodies[0];
  const few = printing || found.length <= WHOLE, focus = document.activeElement;
  const start = few ? 0 : Math.min(Math.max(Math.floor(view.scrollTop / height) - BESIDE, 0), found.length - 1);
  const stop = few ? found.length : Math.min(start + Math.ceil(view.clientHeight / height) + 2 * BESIDE, found.length);
  if (!few && Math.abs(start - at) < BESIDE / 2 && at >= 0 && start > 0 && stop < found.length) return;
  at = start;
  all.ariaRowCount = found.length + 2;
  body.replaceChildren(...found.slice(start, stop).map((row, i) => {
    row.element.ariaRowIndex = start + i + 3; // below two rows of headings
    return row.element;
  }));
  all.style.marginTop = `${start * height}px`;
  all.style.marginBottom = `${few ? 0 : (found.length - stop) * height}px`;
  if (body.contains(focus)) focus.focus({ preventScroll: true });
}
state.draw = () => {
  const words = box.value.toLowerCase().split(/\s+/).filter((w) => w && w !== "-");
  const wanted = words.filter((w) => w[0] !== "-"), unwanted = words.filter((w) => w[0] === "-").map((w) => w.slice(1));
  const fits = (row) => wanted.every((w) => row.words.includes(w)) && !unwanted.some((w) => row.words.includes(w));
  const found = state.found = words.length ? state.rows.filter(fits) : state.rows;
  shown.textContent = words.length ? `${found.length} of ${state.rows.length} units match` : "";
  view.scrollTop = 0;
  at = -1;
  drawView();
};
const measure = () => { height = Math.max(all.tBodies[0].offsetHeight / Math.max(all.tBodies[0].rows.length, 1), 1); at = -1; drawView(); };
view.addEventListener("scroll", () => requestAnimationFrame(drawView), { passive: true });
addEventListener("resize", () => requestAnimationFrame(measure));
for (const [event, now] of [["beforeprint", true], ["afterprint", false]]) addEventListener(event, () => { printing = now; at = -1; drawView(); });
document.querySelector("p.pager")?.remove();
box.closest("p").hidden = false;
box.addEventListener("input", state.draw);
box.addEventListener("focus", () => { // suggests the words of columns with few different values
  const offered = new Set();
  for (const column of all.tHead.rows[1].cells) {
    const words = new Set(state.rows.map((row) => text(row, column.cellIndex)));
    words.delete("");
    if (words.size > 1 && words.size <= 20) words.forEach((word) => offered.add(word));
  }
  document.querySelector("#words").replaceChildren(...[...offered].map((word) => new Option(word, word)));
}, { once: true });
state.found = state.rows;
measure();
