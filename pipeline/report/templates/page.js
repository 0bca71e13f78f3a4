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
