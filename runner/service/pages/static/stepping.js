// Replays in step: one slider moves all; a replay that has ended stays at its last step.
import { onKeys, partAt } from "./parts.js";
import { picturesOf } from "./pictures.js";

const bar = document.querySelector("[data-together]");
const [slider, button, count] = [".both", ".both-play", ".both-count"].map((name) => bar.querySelector(name));
let timer = null,
  writing = null;

async function start(root) {
  const { source } = root.dataset,
    { episode } = await partAt(source, 0);
  const k = Math.min(Math.max(0, Number(bar.dataset.at) - Number(root.dataset.offset ?? 0)), episode.length);
  const replay = new Replay(root, {
    load: async (k) => (await partAt(source, k)).episode,
    pictures: picturesOf(root, k),
  });
  await replay.begin(episode, k);
  return replay;
}

const roots = [...document.querySelectorAll("[data-source]")];
for (const root of roots) {
  root.setAttribute("aria-busy", "true");
  root.querySelector(".description").textContent = "Loading …";
}
const offset = (replay) => Number(replay.root.dataset.offset ?? 0);
const replays = (
  await Promise.all(
    roots.map((root) =>
      start(root)
        .catch((error) => {
          root.querySelector(".description").textContent = error.message;
          return null;
        })
        .finally(() => root.removeAttribute("aria-busy")),
    ),
  )
).filter(Boolean);
const length = Number(bar.dataset.length) || Math.max(0, ...replays.map((replay) => replay.length));

function show(k) {
  k = Math.min(length, Math.max(0, k));
  slider.value = k;
  count.textContent = `step ${k} of ${length}`;
  slider.setAttribute("aria-valuetext", count.textContent);
  for (const replay of replays) replay.show(Math.min(Math.max(0, k - offset(replay)), replay.length));
  clearTimeout(writing);
  writing = setTimeout(() => history.replaceState(null, "", `${bar.dataset.address}${k}`), 150);
}

function pause() {
  clearInterval(timer);
  timer = null;
  button.textContent = "\u25b6";
  button.setAttribute("aria-label", "Play all");
}

function play() {
  if (timer) return pause();
  if (Number(slider.value) === length) show(0);
  button.textContent = "\u275a\u275a";
  button.setAttribute("aria-label", "Pause all");
  const pace = Math.max(...replays.map((replay) => replay.pace));
  timer = setInterval(() => (Number(slider.value) < length ? show(Number(slider.value) + 1) : pause()), pace);
}

slider.max = length;
slider.addEventListener("input", () => {
  pause();
  show(Number(slider.value));
});
button.addEventListener("click", play);
onKeys("input:not([type=range]), textarea, select, button, a, summary", play, (by) => {
  pause();
  show(Number(slider.value) + by);
});
show(Number(bar.dataset.at));
