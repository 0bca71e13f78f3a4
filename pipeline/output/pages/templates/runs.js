"use strict";
// The comparison of two runs: for each unit its state after either run, where they differ.
const history_ = JSON.parse(document.querySelector("#history-data").textContent), FIRST_ROWS = 100;
const boxes = ["#run-a", "#run-b"].map((id) => document.querySelector(id));
const published = JSON.parse(document.querySelector("#published")?.textContent ?? "null"); // null: every unit has a page
const after = (states, run) => states.filter(([n]) => n <= run).pop()?.[1];
const number = (v) => v === null || v === undefined ? "\u2013" : v === 0 ? "0" : v >= 1e-4 && v < 1e5 ? v < 1000 ? v.toPrecision(3) : v.toFixed(0) : v.toExponential(2).replace("-", "\u2212");
const words = (name) => (name ?? "").replaceAll("_", " ");
function settings(a, b) {
  const keys = [...new Set([...Object.keys(a), ...Object.keys(b)])].filter((k) => a[k] !== b[k] && !k.startsWith("effects"));
  return keys.map((k) => `${k}: ${a[k] ?? "default"} \u2192 ${b[k] ?? "default"}`);
}
function rowsOf([unit, states], a, b) {
  const [old, now] = [after(states, a), after(states, b)];
  if (!old || !now || old === now) return [];
  const other = settings(old.overrides ?? {}, now.overrides ?? {});
  if (old.status !== now.status) other.push(`${old.status} \u2192 ${now.status}`);
  return ["accelerometer", "gyroscope"].map((sensor) => {
    const [[e0, f0, v0, n0], [e1, f1, v1, n1]] = [old[sensor] ?? [], now[sensor] ?? []].map((s) => s.length ? s : [null, null, "", []]);
    const effects = [...n1.filter((n) => !n0.includes(n)).map((n) => `+ ${words(n)}`), ...n0.filter((n) => !n1.includes(n)).map((n) => `\u2212 ${words(n)}`)];
    if (e0 === e1 && v0 === v1 && !effects.length) return null;
    const factor = e0 && e1 ? Math.abs(Math.log(e1 / e0)) : Infinity;
    const ratio = (e, f) => e && f ? number(e / f) : "\u2013";
    return { factor, cells: [unit, sensor, number(e0), number(e1), ratio(e0, f0), ratio(e1, f1), words(v0), words(v1), [...effects, ...other].join(", ")] };
  }).filter(Boolean);
}
function compare() {
  const [a, b] = boxes.map((box) => Number(box.value));
  const rows = history_.units.flatMap((unit) => rowsOf(unit, a, b)).sort((p, q) => q.factor - p.factor);
  const body = document.querySelector("#runs-table tbody");
  body.replaceChildren(...rows.slice(0, FIRST_ROWS).map(({ cells }) => {
    const row = document.createElement("tr");
    cells.forEach((text, i) => {
      const cell = document.createElement(i ? "td" : "th");
      if (i > 1 && i < 6) cell.className = "n";
      if (i) cell.textContent = text;
      else {
        const link = document.createElement("a");
        if (!published || published.includes(text)) link.href = `reports/${encodeURIComponent(text)}.html`;
        link.textContent = text;
        cell.scope = "row"; cell.append(link);
      }
      row.append(cell);
    });
    return row;
  }));
  document.querySelector("#runs-table").hidden = !rows.length;
  const more = rows.length > FIRST_ROWS ? `; the first ${FIRST_ROWS} are shown` : "";
  document.querySelector("#runs-said").textContent = rows.length ? `${rows.length === 1 ? "1 sensor differs" : `${rows.length} sensors differ`}${more}.` : "No unit differs between these runs.";
}
document.querySelector("#choice").hidden = false;
for (const box of boxes) box.addEventListener("change", compare);
compare();
