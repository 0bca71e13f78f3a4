"use strict";
const key = (row, column) => row.cells[column].textContent.trim().replaceAll("\u2212", "-");
const compare = (a, b) => {
  const x = Number(a), y = Number(b);
  return Number.isNaN(x) || Number.isNaN(y) ? a.localeCompare(b, undefined, { numeric: true }) : x - y;
};
for (const table of document.querySelectorAll("table.units")) {
  const body = table.tBodies[0];
  const headings = [...table.tHead.rows[1].cells];
  for (const heading of headings) {
    heading.querySelector("button").addEventListener("click", () => {
      const down = heading.getAttribute("aria-sort") === "ascending";
      for (const other of headings) other.removeAttribute("aria-sort");
      heading.setAttribute("aria-sort", down ? "descending" : "ascending");
      const keyed = [...body.rows].map((row) => [key(row, heading.cellIndex), row]);
      keyed.sort(([a], [b]) => {
        if (a === "" || b === "") return (a === "") - (b === "");
        return down ? compare(b, a) : compare(a, b);
      });
      body.append(...keyed.map(([, row]) => row));
    });
  }
}
const box = document.querySelector("#filter"), shown = document.querySelector("#shown");
const rows = [...document.querySelector("#all").tBodies[0].rows];
const texts = rows.map((row) => row.textContent.toLowerCase());
box.closest("p").hidden = false;
box.addEventListener("input", () => {
  const words = box.value.toLowerCase().split(/\s+/).filter(Boolean);
  let count = 0;
  rows.forEach((row, i) => {
    row.hidden = !words.every((word) => texts[i].includes(word));
    count += !row.hidden;
  });
  shown.textContent = words.length ? `${count} of ${rows.length} units` : "";
});
