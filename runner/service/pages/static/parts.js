// The parts of an episode, requested as they are needed, and the keys of replays.
import { request } from "./api.js";

const BEFORE = 250; // steps before the requested one, as in pages/replay.py

export const partAt = (source, k) => request(`${source}?start=${Math.max(0, k - BEFORE)}`);

// Keys play and move, unless the element with the focus uses them.
export function onKeys(others, play, move) {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches(others)) return;
    const by = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10, Home: -Infinity, End: Infinity }[event.key];
    if (event.key === " ") {
      event.preventDefault();
      play();
    }
    if (by === undefined) return;
    event.preventDefault();
    move(by);
  });
}
