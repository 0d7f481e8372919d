// The replay of an episode: its parts are requested as they are needed, and the address names the step.
import { onKeys, partAt } from "./parts.js";
import { picturesOf } from "./pictures.js";

const root = document.querySelector("[data-part]"),
  source = root.dataset.part;
const [toRerun, toWhatIf, toBranch] = ["rerun", "what-if", "branch"].map((name) =>
  root.querySelector(`[data-to-${name}]`),
);
let writing = null;

// Browsers limit how often the address may change, so a playing replay does not write every step.
function moved(k) {
  if (toRerun) toRerun.href = `${root.dataset.rerun}:${Math.max(0, k - 1)}`;
  if (toWhatIf) toWhatIf.href = `${root.dataset.whatIf}:${Math.min(k, replay.length - 1)}`;
  if (toBranch) toBranch.href = toBranch.href.replace(/[0-9]+$/, Math.min(k, replay.length - 1));
  clearTimeout(writing);
  writing = setTimeout(() => history.replaceState(null, "", `?t=${k}`), 150);
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
