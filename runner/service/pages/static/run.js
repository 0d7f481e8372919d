// The replay of an episode: its parts are asked for as they are needed, and the address is that of the step.
const root = document.querySelector("[data-part]"), source = root.dataset.part;
const BEFORE = 250;
const onward = root.querySelector("[data-to-rerun]");
let told = null, writing = null;

async function partAt(k) {
  const answer = await fetch(`${source}?start=${Math.max(0, k - BEFORE)}`);
  const found = await answer.json();
  if (!answer.ok) throw new Error(found.error.message);
  return found;
}

// Writing each step of a playing replay into the address at once would be too often for browsers.
function moved(k) {
  onward.href = `${root.dataset.rerun}:${Math.max(0, k - 1)}`;
  clearTimeout(writing);
  writing = setTimeout(() => history.replaceState(null, "", `?t=${k}`), 150);
}

const at = Number(root.dataset.at);
told = await partAt(at);
const replay = new Replay(root, told, { load: async (k) => (await partAt(k)).episode, moved });
replay.begin(told.episode, at);

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, textarea, select, button, a, summary")) return;
  const jump = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10, Home: -Infinity, End: Infinity }[event.key];
  if (event.key === " ") { event.preventDefault(); replay.play(); }
  if (jump === undefined) return;
  event.preventDefault();
  replay.pause();
  replay.show(Math.min(replay.length, Math.max(0, replay.k + jump)));
});
