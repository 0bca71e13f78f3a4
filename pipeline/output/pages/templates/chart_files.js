// A chart as PNG, as it is shown with its finding and legend, and its values as CSV: of a curve every sample.
const KEPT = ["fill", "stroke", "stroke-width", "stroke-dasharray", "stroke-linecap", "opacity", "font", "text-anchor", "paint-order", "vector-effect", "display"];
function save(blob, svg, ending) {
  const link = document.createElement("a"), page = document.title.split(":")[0];
  link.href = URL.createObjectURL(blob);
  link.download = `${page}_${svg.getAttribute("aria-labelledby").split("-t ")[0]}.${ending}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
function csvOf(figure, svg) {
  const x = scaleOf(svg), names = window.chartNames?.[svg.dataset.names], values = window.chartValues?.[svg.getAttribute("aria-labelledby").split("-t ")[0]];
  const plain = (v) => /^'*[=+\-@\t\r\n]/.test(v) && Number.isNaN(Number(v)) ? `'${v}` : v; // no formula of a spreadsheet
  const cell = (v) => /[",\n]/.test(v) ? `"${plain(v).replaceAll('"', '""')}"` : plain(v), read = (axis, v) => told(axis, valueAt(axis, v / SUBDIVISION, axis.full)).replace("\u2212", "-");
  const rows = [["panel", "series", ...names ? ["unit"] : [], x.label, "value", "low", "high", ...values ? ["stated"] : []]];
  for (const group of svg.querySelectorAll(".panel")) {
    const y = scaleOf(group);
    if (svg.dataset.full) x.samples ??= fullOf(svg, x);
    for (const path of group.querySelectorAll(".line:not(.mean), .dots, .strokes")) {
      const full = path.dataset.full && fullOf(path, y);
      x.exact = y.exact = Boolean(full);
      const colour = [...path.classList].find((c) => /^c\d$/.test(c));
      const series = figure.querySelector(`.legend .${colour}`)?.parentNode.textContent.trim() ?? "";
      const ofUnits = names && path.matches(".dots"); // a line next to them summarises many units
      for (const p of full ? full.map((v, i) => [x.samples[i], v, v]).filter(([, v]) => !Number.isNaN(v)) : pointsOf(path)) {
        const unit = ofUnits ? unitAt(x, p) : null, range = !full && path.classList.contains("strokes"), ends = [p[1], p[2]].map((v) => read(y, v));
        const place = ofUnits && p.unit === undefined ? String(unit + 1) : read(x, p[0]);
        rows.push([y.label, series, ...names ? [names[unit] ?? ""] : [], place, ...range ? ["", ...y.start > y.stop && p[1] < p[2] ? ends.reverse() : ends] : [ends[0], "", ""],
          ...values ? [ofUnits ? (values[colour] ?? values.after)[p.i ?? unit].replaceAll("\u2212", "-") : ""] : []]);
      }
    }
  }
  return rows.map((row) => row.map(cell).join(",")).join("\r\n") + "\r\n";
}
function pngOf(figure, svg, done) {
  const copy = svg.cloneNode(true), to = copy.querySelectorAll("*"), box = svg.viewBox.baseVal, ratio = 4, width = box.width * ratio;
  svg.querySelectorAll("*").forEach((element, i) => {
    const style = getComputedStyle(element);
    for (const key of KEPT) to[i].style.setProperty(key, style.getPropertyValue(key));
    if (element.localName === "path") // their strokes do not grow with the drawing
      for (const key of ["stroke-width", "stroke-dasharray"]) to[i].style.setProperty(key, style.getPropertyValue(key).replace(/[\d.]+/g, (v) => v * ratio));
  });
  copy.setAttribute("xmlns", SVG); copy.setAttribute("width", width); copy.setAttribute("height", box.height * ratio);
  const picture = new Image(), canvas = document.createElement("canvas"), pen = canvas.getContext("2d"), style = getComputedStyle(figure);
  const lines = [[]], bold = "600 52px system-ui, sans-serif", usual = "48px system-ui, sans-serif";
  pen.font = bold;
  for (const word of (figure.querySelector(".finding")?.textContent ?? "").split(/\s+/)) {
    if (pen.measureText([...lines.at(-1), word].join(" ")).width > width - 80) lines.push([]);
    lines.at(-1).push(word);
  }
  const legend = [...figure.querySelectorAll(".legend li")].map((item) => [getComputedStyle(item.querySelector("i")).color, item.textContent.trim()]);
  picture.onload = () => {
    const top = 40 + 64 * lines.length;
    canvas.width = width; canvas.height = top + box.height * ratio + 76 * legend.length + 24;
    pen.fillStyle = style.backgroundColor; pen.fillRect(0, 0, canvas.width, canvas.height);
    pen.fillStyle = style.color; pen.font = bold;
    lines.forEach((line, i) => pen.fillText(line.join(" "), 40, 72 + 64 * i));
    pen.drawImage(picture, 0, top);
    pen.font = usual;
    legend.forEach(([colour, text], i) => {
      const at = top + box.height * ratio + 48 + 76 * i;
      pen.fillStyle = colour; pen.beginPath(); pen.arc(64, at - 16, 20, 0, 7); pen.fill();
      pen.fillStyle = style.color; pen.fillText(text, 104, at);
    });
    canvas.toBlob(done, "image/png");
  };
  picture.src = `data:image/svg+xml,${encodeURIComponent(new XMLSerializer().serializeToString(copy))}`;
}
for (const tools of document.querySelectorAll("figure > .tools")) {
  const figure = tools.parentNode, svg = figure.querySelector("svg");
  const offer = (text, words, action) => {
    const button = document.createElement("button");
    button.type = "button"; button.className = "file"; button.textContent = text; button.setAttribute("aria-label", words);
    button.addEventListener("click", action);
    tools.prepend(button);
  };
  if (!svg) continue;
  if (svg.dataset.scale) offer("CSV", "Save the values of this chart as CSV", () => save(new Blob([csvOf(figure, svg)], { type: "text/csv" }), svg, "csv"));
  offer("PNG", "Save this chart as PNG", () => pngOf(figure, svg, (blob) => save(blob, svg, "png")));
}
