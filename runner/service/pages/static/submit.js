// The form of a configuration: checked as it is written, with a link from each mistake to its line.
const form = document.querySelector("[data-submit]"),
  text = form.elements.text;
const problems = document.getElementById("problems"),
  valid = document.getElementById("valid");
let timer = null,
  checks = 0;

function go(line) {
  const lines = text.value.split("\n"),
    start = lines.slice(0, line - 1).join("\n").length + (line > 1 ? 1 : 0);
  text.focus();
  text.setSelectionRange(start, start + (lines[line - 1] ?? "").length);
  text.scrollTop = (line - 4) * Number.parseFloat(getComputedStyle(text).lineHeight);
}

function make(tag, content) {
  const element = document.createElement(tag);
  element.append(...content);
  return element;
}

function problemBox({ line, path, message }) {
  const parts = [];
  if (line) {
    const link = make("a", [`Line ${line}`]);
    link.href = "#text";
    link.dataset.line = line;
    parts.push(link, path ? ", " : "");
  }
  if (path) parts.push(make("code", [path]));
  parts.push(line || path ? ": " : "", message);
  const box = make("div", [make("p", parts)]);
  box.className = "problem";
  if (line) box.append(make("pre", [text.value.split("\n")[line - 1] ?? ""]));
  return box;
}

async function check() {
  const mine = ++checks;
  const response = await fetch("/api/v1/jobs/check", {
    method: "POST",
    body: text.value,
    headers: { "content-type": "application/yaml" },
  }).catch(() => null);
  if (mine !== checks || !response) return;
  const found = await response.json();
  if (response.ok) {
    problems.replaceChildren();
    const runs = `${found.runs.toLocaleString("en")} ${found.runs === 1 ? "run" : "runs"}`;
    const size = found.bytes ? `, about ${(found.bytes / 1e6).toFixed(found.bytes < 1e7 ? 1 : 0)} MB` : "";
    valid.textContent = `Valid: ${found.kind} ${found.name}, ${runs}${size}.`;
    return;
  }
  valid.textContent = "";
  const { error } = found;
  problems.replaceChildren(...(error.problems.length ? error.problems : [{ message: error.message }]).map(problemBox));
}

text.addEventListener("input", () => {
  clearTimeout(timer);
  timer = setTimeout(check, 700);
});
problems.addEventListener("click", (event) => {
  const line = event.target.closest("[data-line]")?.dataset.line;
  if (!line) return;
  event.preventDefault();
  go(Number(line));
});
text.addEventListener("keydown", (event) => {
  if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) form.requestSubmit();
});
const first = problems.querySelector("[data-line]");
if (first) go(Number(first.dataset.line));
