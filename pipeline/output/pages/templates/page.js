"use strict";
// Commands name the folder of the results where it is not the default one: the page lies in DIR/<campaign>/ or below it.
const parts = decodeURIComponent(location.pathname).split("/"), folder = parts.slice(0, parts.at(-2) === "reports" ? -3 : -2);
if (location.protocol === "file:" && folder.at(-1) !== "results") {
  const quoted = (word) => /^[\w@%+=:,.\/-]+$/.test(word) ? word : `'${word.replaceAll("'", `'"'"'`)}'`;
  for (const code of document.querySelectorAll("code[data-results]")) {
    const option = code.dataset.results, path = folder.join("/");
    code.textContent += option.endsWith("=") ? ` ${quoted(`${option.trim()}${path}`)}` : `${option}${quoted(path)}`;
  }
}
for (const code of document.querySelectorAll("code[data-folder]"))
  if (location.protocol === "file:" && folder.at(-1) !== "results") code.textContent = code.textContent.replace("results/", `${folder.join("/")}/`);
for (const button of document.querySelectorAll(".copy button")) {
  button.hidden = false;
  button.addEventListener("click", () => {
    const code = button.parentElement.querySelector("code");
    const done = () => { button.textContent = "copied"; };
    const select = () => {
      const range = document.createRange();
      range.selectNodeContents(code);
      const selection = window.getSelection();
      selection.removeAllRanges();
      selection.addRange(range);
      if (document.execCommand("copy")) done();
    };
    if (navigator.clipboard) navigator.clipboard.writeText(code.textContent).then(done, select);
    else select();
  });
}
// The contents mark the part in view, and list its sections.
const contents = document.querySelector(".contents");
if (contents) {
  const links = [...contents.querySelectorAll("a")], heads = links.map((link) => document.getElementById(link.hash.slice(1)));
  const below = document.createElement("ul");
  below.className = "parts";
  contents.append(below);
  let now = -1;
  const entry = (head, i, part) => {
    const item = document.createElement("li"), link = document.createElement("a");
    head.id ||= `${part.id}-${i}`;
    link.href = `#${head.id}`; link.textContent = head.textContent;
    item.append(link);
    return item;
  };
  const follow = () => {
    const next = heads.findLastIndex((head) => head && head.getBoundingClientRect().top < 120);
    if (next === now) return;
    now = next;
    links.forEach((link, i) => i === now ? link.setAttribute("aria-current", "true") : link.removeAttribute("aria-current"));
    const list = contents.firstElementChild, link = links[now];
    if (link) list.scrollLeft = link.offsetLeft - list.clientWidth / 2;
    below.replaceChildren(...[...heads[now]?.querySelectorAll("h3") ?? []].map((head, i) => entry(head, i, heads[now])));
  };
  addEventListener("scroll", () => requestAnimationFrame(follow), { passive: true });
  follow();
}
// On a phone, long parts are closed; a link into one opens it, and all are printed.
const narrow = matchMedia("screen and (max-width: 700px)"), folds = [...document.querySelectorAll("details.fold")];
const fold = () => folds.forEach((part) => part.open = !narrow.matches);
narrow.addEventListener("change", fold);
fold();
const unfold = () => {
  const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!target) return;
  for (let part = target.closest("details"); part; part = part.parentElement.closest("details")) part.open = true;
  target.scrollIntoView();
};
addEventListener("hashchange", unfold);
addEventListener("beforeprint", () => folds.forEach((part) => part.open = true));
unfold();
// On a phone, a table that is too wide shows each row as a block (page.css). The names of the columns are rules of a style sheet, as
// the rows of a list change.
const names_ = document.createElement("style");
const fit = new ResizeObserver((entries) => requestAnimationFrame(() => {
  for (const { target } of entries) {
    const table = target.firstElementChild;
    if (target.clientWidth === target.fitted || table.hidden) continue;
    target.fitted = target.clientWidth;
    table.classList.remove("folded");
    const column = [...table.rows].some((row) => row.offsetHeight > 200); // of a word a line
    table.classList.toggle("folded", narrow.matches && (column || target.scrollWidth > target.clientWidth + 1));
    if (!target.matches(".tall")) target.scrollWidth > target.clientWidth ? target.tabIndex = 0 : target.removeAttribute("tabindex"); // scrolled by keys
  }
}));
document.querySelectorAll(".scroll").forEach((box, i) => {
  const [first, ...others] = box.querySelectorAll("thead > tr"), last = others.pop() ?? first;
  if (!first) return;
  const groups = last === first ? [] : [...first.cells].flatMap((cell) => [cell.textContent.split(",")[0], ...Array(cell.colSpan - 1).fill("")]);
  box.firstElementChild.dataset.columns = i;
  [...last.cells].forEach((cell, k) => {
    const lines = [groups[k], [...cell.childNodes].map((node) => node.textContent).join(" ").trim()].filter(Boolean).map((line) => line.replace(/["\\\n]/g, " "));
    if (groups[k]) cell.dataset.group = groups[k];
    if (k) names_.append(`[data-columns="${i}"].folded > tbody > tr > :nth-child(${k + 1})::before { content: "${lines.join(", ")}"; }\n`);
  });
  fit.observe(box);
});
document.head.append(names_);
