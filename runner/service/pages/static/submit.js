// The form of a configuration: checked as it is written, with a link from each mistake to its line.
const form = document.querySelector("[data-submit]"),
  text = form.elements.text,
  problems = document.getElementById("problems");
let timer = null,
  checks = 0;

function go(link) {
  const line = Number(link.dataset.line),
    lines = text.value.split("\n"),
    start = lines.slice(0, line - 1).reduce((sum, line) => sum + line.length + 1, 0);
  text.focus();
  text.setSelectionRange(start, start + (lines[line - 1] ?? "").length);
  text.scrollTop = (line - 4) * Number.parseFloat(getComputedStyle(text).lineHeight);
}

// What the page would say if the button was pressed.
async function check() {
  const mine = ++checks,
    body = new URLSearchParams(new FormData(form));
  body.set("action", "check");
  const response = await fetch("/submit", { method: "POST", body, headers: { accept: "text/html" } }).catch(() => null);
  const page = new DOMParser().parseFromString((await response?.text()) ?? "", "text/html");
  if (mine !== checks) return;
  for (const id of ["problems", "valid"]) {
    const found = page.getElementById(id);
    if (found) document.getElementById(id).replaceChildren(...found.childNodes);
  }
}

text.addEventListener("input", () => {
  clearTimeout(timer);
  timer = setTimeout(check, 700);
});
problems.addEventListener("click", (event) => {
  const link = event.target.closest("[data-line]");
  if (!link) return;
  event.preventDefault();
  go(link);
});
text.addEventListener("keydown", (event) => {
  if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) form.requestSubmit();
});
const first = problems.querySelector("[data-line]");
if (first) go(first);
