// Units that are chosen in a chart or in a list are marked in every chart and every list: by a ring and by an arrow.
const chosen = new Set(), placeOf = new Map(window.chartNames.units.map((name, i) => [name, i]));
const brushed = [...document.querySelectorAll("svg[data-names=units]")].map((svg) => [svg, scaleOf(svg)]);
const told_ = document.createElement("p"), words_ = document.createElement("span");
const offered = (text, action) => {
  const button = document.createElement("button");
  button.type = "button"; button.textContent = text;
  button.addEventListener("click", action);
  return button;
};
told_.className = "brush"; told_.hidden = true; words_.setAttribute("role", "status");
told_.append(words_, " ", offered("List them first", () => {
  state.rows = [...state.rows].sort((a, b) => chosen.has(placeOf.get(text(b, 0))) - chosen.has(placeOf.get(text(a, 0))));
  state.draw();
}), " ", offered("Clear", () => { chosen.clear(); markChosen(); }));
document.querySelector("main").append(told_);
const unitOf = (row) => placeOf.get(row.cells[0]);
function markChosen() {
  for (const [svg, x] of brushed)
    for (const layers of svg.querySelectorAll(".layers")) {
      const ring = layers.querySelector(".chosen") ?? document.createElementNS(SVG, "path");
      const points = [...layers.querySelectorAll(".dots")].flatMap(pointsOf).filter((p) => chosen.has(unitAt(x, p)));
      ring.setAttribute("class", "chosen");
      ring.setAttribute("d", points.map((p) => `M${p[0]} ${p[1]}h0`).join(""));
      layers.insertBefore(ring, layers.querySelector(".dots"));
    }
  for (const { rows } of tables.values()) for (const row of rows) {
    row.chosen = chosen.has(unitOf(row));
    row.made?.classList.toggle("chosen", row.chosen);
  }
  const names = [...chosen].slice(0, 5).map((i) => window.chartNames.units[i]).join(", ");
  words_.textContent = `${chosen.size} unit${chosen.size === 1 ? "" : "s"} marked: ${names}${chosen.size > 5 ? " and others" : ""}`;
  told_.hidden = !chosen.size;
}
window.choose = (units) => { // one is switched, several are added
  for (const unit of units) if (units.length === 1 && chosen.has(unit)) chosen.delete(unit); else chosen.add(unit);
  markChosen();
};
for (const table of tables.keys()) table.tBodies[0].addEventListener("click", (event) => {
  const unit = placeOf.get(event.target.closest("tr")?.cells[0].textContent.trim());
  if (unit !== undefined && !event.target.closest("a, button, summary")) window.choose([unit]);
});
if (brushed.length) shown.after(" ", offered("Mark in the charts", () => window.choose(state.found.map(unitOf))));
for (const hint of document.querySelectorAll(".chart-hint")) hint.append(" Click a dot or a row of a list, or drag with Ctrl over dots, to mark units everywhere.");
