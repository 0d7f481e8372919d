// Replays in step: one slider moves all; a replay that has ended stays at its last step.
import { keepAddress, listen, open } from "./player.js";

const box = document.querySelector("[data-together]");

const roots = [...document.querySelectorAll("[data-source]")],
  opened = await Promise.allSettled(roots.map((root) => open(root))),
  replays = opened.map(({ value }) => value).filter(Boolean); // others show why not

const bar = new Scrubber(box, "all", (k) => {
  for (const replay of replays) replay.bar.show(k - replay.root.dataset.offset);
  keepAddress(box.dataset.address + k);
});
bar.length = Number(box.dataset.length) || Math.max(0, ...replays.map(({ bar }) => bar.length));
bar.pace = Math.max(...replays.map(({ bar }) => bar.pace));
listen(bar);
bar.show(Number(box.dataset.at));
