// Two replays in step: one slider moves both; where one has ended, it stands still.
const bar = document.querySelector("[data-together]");
const [slider, button, count] = [".both", ".both-play", ".both-count"].map((name) => bar.querySelector(name));
const BEFORE = 250;
let timer = null, writing = null;

async function partOf(source, k) {
  const answer = await fetch(`${source}?start=${Math.max(0, k - BEFORE)}`);
  const found = await answer.json();
  if (!answer.ok) throw new Error(found.error.message);
  return found;
}

async function begun(root) {
  const { source } = root.dataset;
  const told = await partOf(source, 0);
  const replay = new Replay(root, told, { load: async (k) => (await partOf(source, k)).episode });
  replay.begin(told.episode);
  return replay;
}

const roots = [...document.querySelectorAll("[data-source]")];
for (const root of roots) root.querySelector(".description").textContent = "Loading …";
const replays = (await Promise.all(roots.map((root) => begun(root).catch((error) => {
  root.querySelector(".description").textContent = error.message;
  return null;
})))).filter(Boolean);
const length = Math.max(0, ...replays.map((replay) => replay.length));

function show(k) {
  k = Math.min(length, Math.max(0, k));
  slider.value = k;
  count.textContent = `step ${k} of ${length}`;
  slider.setAttribute("aria-valuetext", count.textContent);
  for (const replay of replays) replay.show(Math.min(k, replay.length));
  clearTimeout(writing);
  writing = setTimeout(() => history.replaceState(null, "", `${bar.dataset.base}&at=${bar.dataset.prefix}:${k}`), 150);
}

function pause() {
  clearInterval(timer);
  timer = null;
  button.textContent = "\u25b6";
  button.setAttribute("aria-label", "Play both");
}

function play() {
  if (timer) return pause();
  if (Number(slider.value) === length) show(0);
  button.textContent = "\u23f8";
  button.setAttribute("aria-label", "Pause both");
  timer = setInterval(() => Number(slider.value) < length ? show(Number(slider.value) + 1) : pause(), 350);
}

slider.max = length;
slider.addEventListener("input", () => { pause(); show(Number(slider.value)); });
button.addEventListener("click", play);
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input:not([type=range]), textarea, select, button, a, summary")) return;
  const jump = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10, Home: -Infinity, End: Infinity }[event.key];
  if (event.key === " ") { event.preventDefault(); play(); }
  if (jump === undefined) return;
  event.preventDefault();
  pause();
  show(Number(slider.value) + jump);
});
show(Number(bar.dataset.at));
