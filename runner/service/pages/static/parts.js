// What the replays in pages share: the parts of an episode, asked for as they are needed, and the keys.
import { asked } from "./asked.js";

const BEFORE = 250;  // steps before the one that is wanted, as in pages/replay.py

export const partAt = (source, k) => asked(`${source}?start=${Math.max(0, k - BEFORE)}`);

// Keys play and move, unless what has the focus makes something else of them.
export function onKeys(others, play, move) {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches(others)) return;
    const by = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10, Home: -Infinity, End: Infinity }[event.key];
    if (event.key === " ") { event.preventDefault(); play(); }
    if (by === undefined) return;
    event.preventDefault();
    move(by);
  });
}
