"use strict";
// The list of all units: sorting and filter. Only some rows are in the page, as a browser lays out long tables slowly; the
// others are in a template.
const text = (row, column) => row.cells[column].textContent.trim().replaceAll("\u2212", "-");
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
  const others = table.id === "all" ? document.querySelector("#others")?.content.querySelectorAll("tr") ?? [] : [];
  const state = { rows: [...table.tBodies[0].rows, ...others], draw: () => table.tBodies[0].replaceChildren(...state.rows) };
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
const all = document.querySelector("#all"), state = tables.get(all);
const box = document.querySelector("#filter"), shown = document.querySelector("#shown");
const FIRST = Math.max(all.tBodies[0].rows.length, 100);
const texts = new Map(); // made when it is first asked for
const textOf = (row) => {
  if (!texts.has(row)) texts.set(row, Array.from(row.cells, (c) => c.textContent).join(" ").toLowerCase());
  return texts.get(row);
};
const pager = document.createElement("p"), more = document.createElement("button"), whole = document.createElement("button");
pager.className = "pager";
more.type = whole.type = "button";
pager.append(more, " ", whole);
document.querySelector("p.pager")?.remove();
all.parentNode.after(pager);
let most = FIRST;
state.draw = () => {
  const words = box.value.toLowerCase().split(/\s+/).filter((w) => w && w !== "-");
  const wanted = words.filter((w) => w[0] !== "-"), unwanted = words.filter((w) => w[0] === "-").map((w) => w.slice(1));
  const fits = (row) => wanted.every((w) => textOf(row).includes(w)) && !unwanted.some((w) => textOf(row).includes(w));
  const found = state.found = words.length ? state.rows.filter(fits) : state.rows;
  all.tBodies[0].replaceChildren(...found.slice(0, most));
  const left = found.length - most;
  pager.hidden = left <= 0;
  more.textContent = `Show ${Math.min(left, 500)} more`;
  whole.textContent = `Show all ${found.length}`;
  shown.textContent = words.length || left > 0 ? `${Math.min(most, found.length)} of ${found.length}${words.length ? ` that match, of ${state.rows.length}` : ""} units shown` : "";
};
const widen = (count) => () => {
  const next = all.tBodies[0].rows.length;
  most += count;
  state.draw();
  all.tBodies[0].rows[next]?.querySelector("a").focus(); // where the reader was, not at the end
};
more.addEventListener("click", widen(500));
whole.addEventListener("click", widen(Infinity));
box.closest("p").hidden = false;
box.addEventListener("input", () => { most = FIRST; state.draw(); });
box.addEventListener("focus", () => { // offers the words of those columns that few words describe
  const offered = new Set();
  for (const column of all.tHead.rows[1].cells) {
    const words = new Set(state.rows.map((row) => text(row, column.cellIndex)));
    words.delete("");
    if (words.size > 1 && words.size <= 20) words.forEach((word) => offered.add(word));
  }
  document.querySelector("#words").replaceChildren(...[...offered].map((word) => new Option(word, word)));
}, { once: true });
state.draw();
