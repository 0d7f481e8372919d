// The replay of an episode: its parts are requested as they are needed, and the address names the step.
import { request } from "./api.js";
import { onKeys, partAt } from "./parts.js";
import { picturesOf } from "./pictures.js";

const root = document.querySelector("[data-part]"),
  source = root.dataset.part;
const [toRerun, toWhatIf, toBranch, toMark] = ["rerun", "what-if", "branch", "mark"].map((name) =>
  root.querySelector(`[data-to-${name}]`),
);
const asked = new URLSearchParams(location.search),
  search = asked.get("found"), // whose hits are played one after the other
  kept = search ? `found=${encodeURIComponent(search)}` : "";
let writing = null,
  onward = null;

// Browsers limit how often the address may change, so a playing replay does not write every step.
function moved(k) {
  if (toRerun) toRerun.href = `${root.dataset.rerun}:${Math.max(0, k - 1)}`;
  if (toWhatIf) toWhatIf.href = `${root.dataset.whatIf}:${Math.min(k, replay.length - 1)}`;
  if (toBranch) toBranch.href = toBranch.href.replace(/[0-9]+$/, Math.min(k, replay.length - 1));
  if (toMark) toMark.value = toMark.value.replace(/[0-9]+$/, k);
  clearTimeout(writing);
  if (onward && replay.timer && k === replay.length) return location.assign(`${onward}?${kept}&play=1`);
  writing = setTimeout(() => history.replaceState(null, "", `?t=${k}${kept && `&${kept}`}`), 150);
}

const at = Number(root.dataset.at),
  pictures = picturesOf(root, at);
root.setAttribute("aria-busy", "true");
const { episode } = await partAt(source, at).finally(() => root.removeAttribute("aria-busy"));
const replay = new Replay(root, { load: async (k) => (await partAt(source, k)).episode, moved, pictures });
replay.begin(episode, at);

onKeys(
  "input, textarea, select, button, a, summary",
  () => replay.play(),
  (by) => {
    replay.pause();
    replay.show(Math.min(replay.length, Math.max(0, replay.k + by)));
  },
);

// Marks: a tick at the slider and a link for each; the key M leads to the text of another.
const ticks = document.createElement("datalist");
ticks.id = "mark-ticks";
for (const link of root.querySelectorAll("[data-mark]")) {
  const tick = ticks.appendChild(document.createElement("option"));
  tick.value = link.dataset.mark;
  tick.label = link.parentElement.textContent.trim();
  link.addEventListener("click", (event) => {
    event.preventDefault();
    replay.pause();
    replay.show(Number(link.dataset.mark));
  });
}
replay.slider.after(ticks);
replay.slider.setAttribute("list", ticks.id);
document.addEventListener("keydown", (event) => {
  if (event.key.toLowerCase() !== "m" || event.ctrlKey || event.metaKey || event.altKey || !toMark) return;
  if (event.target.matches("input:not([type=range]), textarea, select")) return;
  event.preventDefault();
  replay.pause();
  toMark.form.elements.text.focus();
});

// The hits of a search: the one before and the one after this episode, which is played next.
if (search) {
  const hits = (await request(`/api/v1/find?${search}`)).hits.map((hit) => hit.replay),
    here = hits.indexOf(source.replace("/api/v1", "")),
    place = root.querySelector("[data-hits]");
  const linked = (text, address) => {
    const link = document.createElement("a");
    link.textContent = text;
    link.href = address;
    place.append(link, " ");
  };
  if (here > 0) linked("‹ Previous hit", `${hits[here - 1]}?${kept}`);
  linked(here < 0 ? "All hits" : `Hit ${here + 1} of ${hits.length}`, `/find?${search}`);
  if (here + 1 < hits.length) linked("Next hit ›", `${(onward = hits[here + 1])}?${kept}`);
  place.hidden = false;
  if (asked.has("play")) replay.play();
}
