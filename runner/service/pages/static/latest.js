// The latest whole episode of each run that is running, which replays by itself; when it is over, the next latest one.
import { partAt } from "./parts.js";
import { picturesOf } from "./pictures.js";

const AGAIN = 3000; // milliseconds before a server is asked again that has no later episode

async function follow(place) {
  let pictures = null,
    shown = "";
  for (;;) {
    const pause = new Promise((resolve) => setTimeout(resolve, AGAIN));
    try {
      const response = await fetch(`${place.dataset.latest}?shown=${encodeURIComponent(shown)}`, {
        headers: { accept: "text/html" },
      });
      if (response.status === 204 && response.headers.get("x-run-over")) return;
      if (response.status === 200) {
        pictures?.close();
        place.innerHTML = await response.text(); // rendered, and escaped, by the server
        const root = place.querySelector("[data-source]"),
          { source } = root.dataset;
        shown = root.dataset.episode;
        root.querySelector(".own").hidden = false;
        pictures = picturesOf(root);
        const replay = new Replay(root, { load: async (k) => (await partAt(source, k)).episode, pictures });
        await replay.begin((await partAt(source, 0)).episode);
        replay.play();
        await over(replay);
      }
    } catch {
      /* the service is not available: try again */
    }
    await pause;
  }
}

// Wait until a replay is at its end; a visitor who pauses it keeps it.
function over(replay) {
  return new Promise((resolve) => {
    const look = setInterval(() => {
      if (replay.k < replay.length) return;
      clearInterval(look);
      resolve();
    }, 500);
  });
}

document.querySelectorAll("[data-latest]").forEach(follow);
