// Replays in step: one slider moves all; a replay that has ended stays at its last step.
import { keepAddress, listen, open } from "./player.js";

const box = document.querySelector("[data-together]");

const opened = [...document.querySelectorAll("[data-source]")].map(async (root) => {
  const description = root.querySelector(".description");
  description.textContent = "Loading …";
  return open(root).catch((error) => {
    description.textContent = error.message;
  });
});
const replays = (await Promise.all(opened)).filter(Boolean);

const bar = new Scrubber(box, "all", (k) => {
  for (const replay of replays) replay.bar.show(k - replay.root.dataset.offset);
  keepAddress(box.dataset.address + k);
});
bar.length = Number(box.dataset.length) || Math.max(0, ...replays.map(({ bar }) => bar.length));
bar.pace = Math.max(...replays.map(({ bar }) => bar.pace));
listen(bar);
bar.show(Number(box.dataset.at));
