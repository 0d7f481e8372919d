// Replays in step: one slider moves all; a replay that has ended stays at its last step.
import { listen, open } from "./player.js";

const box = document.querySelector("[data-together]");
const offset = ({ root }) => Number(root.dataset.offset ?? 0);
let writing = null;

const opened = [...document.querySelectorAll("[data-source]")].map(async (root) => {
  const description = root.querySelector(".description");
  description.textContent = "Loading …";
  return open(root).catch((error) => {
    description.textContent = error.message;
  });
});
const replays = (await Promise.all(opened)).filter(Boolean);

const bar = new Scrubber(box, "all", (k) => {
  for (const replay of replays) replay.bar.show(k - offset(replay));
  clearTimeout(writing);
  writing = setTimeout(() => history.replaceState(null, "", box.dataset.address + k), 150);
});
bar.length = Number(box.dataset.length) || Math.max(0, ...replays.map(({ bar }) => bar.length));
bar.pace = Math.max(...replays.map(({ bar }) => bar.pace));
listen(bar);
bar.show(Number(box.dataset.at));
