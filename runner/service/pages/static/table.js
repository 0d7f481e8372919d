// The table of runs: selecting runs to compare, and keys to move in it.
import { isTaken } from "./page.js";

const form = document.querySelector("[data-rows]");
const search = document.querySelector("[data-focus]");

function update() {
  const button = form.querySelector("[data-compare]"),
    boxes = [...form.querySelectorAll("tbody input:checked")],
    count = boxes.reduce((runs, box) => runs + Number(box.dataset.runs), 0);
  button.disabled = count < 2;
  button.textContent = count < 2 ? "Select two or more runs to compare" : `Compare ${count} runs`;
}

function step(by) {
  const links = [...form.querySelectorAll("tbody tr")].map((row) => row.querySelector("a"));
  const at = links.findIndex((link) => link.closest("tr").contains(document.activeElement));
  links[Math.min(links.length - 1, Math.max(0, at + by))].focus();
}

document.addEventListener("keydown", (event) => {
  if (isTaken(event)) return;
  if (event.key === "/") {
    event.preventDefault();
    search.focus();
    search.select();
  }
  if (!form) return;
  if (event.key === "j") step(1);
  if (event.key === "k") step(-1);
  if (event.key === "x") document.activeElement.closest("tr")?.querySelector("input")?.click();
});
if (form) {
  form.addEventListener("change", update);
  addEventListener("pageshow", update);
  update();
}
