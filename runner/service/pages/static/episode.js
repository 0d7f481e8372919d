// The replay of an episode: the address names the step, and so do the links to other pages.
import { isTaken, json } from "./page.js";
import { keepAddress, listen, open } from "./player.js";

const root = document.querySelector("[data-source]"),
  fields = root.querySelectorAll("[data-step]"); // links and fields that end with a step
const asked = new URLSearchParams(location.search),
  search = asked.get("found"), // whose hits are played one after the other
  kept = search ? `found=${encodeURIComponent(search)}` : "";
let onward = null;

function moved({ k, length, timer }) {
  const steps = { last: Math.max(0, k - 1), now: k, next: Math.min(k, length - 1) };
  for (const field of fields) {
    const name = field.matches("a") ? "href" : "value";
    field.setAttribute(name, field.getAttribute(name).replace(/[0-9]+$/, steps[field.dataset.step]));
  }
  if (onward && timer && k === length) return location.assign(`${onward}?${kept}&play=1`);
  keepAddress(`?t=${k}${kept && `&${kept}`}`);
}

const { bar } = await open(root, Number(root.dataset.at), moved);
listen(bar);

// Marks: a tick at the slider and a link for each; the key M leads to the text of another.
for (const link of root.querySelectorAll("[data-mark]"))
  link.addEventListener("click", (event) => {
    event.preventDefault();
    bar.go(Number(link.dataset.mark));
  });
bar.slider.setAttribute("list", "mark-ticks");
const mark = root.querySelector(".marks [name=text]");
document.addEventListener("keydown", (event) => {
  if (event.key.toLowerCase() !== "m" || isTaken(event) || !mark) return;
  event.preventDefault();
  bar.pause();
  mark.focus();
});

// The hits of a search: the one before and the one after this episode, which is played next.
if (search) {
  const hits = (await json(`/api/v1/find?${search}`)).hits.map((hit) => hit.replay),
    here = hits.indexOf(root.dataset.source.replace("/api/v1", "")),
    place = root.querySelector("[data-hits]");
  const linked = (text, href) => place.append(make("a", { href }, text), " ");
  if (here > 0) linked("‹ Previous hit", `${hits[here - 1]}?${kept}`);
  linked(here < 0 ? "All hits" : `Hit ${here + 1} of ${hits.length}`, `/find?${search}`);
  if (here + 1 < hits.length) linked("Next hit ›", `${(onward = hits[here + 1])}?${kept}`);
  place.hidden = false;
  if (asked.has("play")) bar.play();
}
