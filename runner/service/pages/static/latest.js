// The latest whole episode of each run that is running, which replays by itself; when it is over, the next latest one.
import { request, wait } from "./page.js";
import { open } from "./player.js";

async function follow(place) {
  let replay = null,
    shown = "";
  for (;;) {
    const pause = wait(3000); // before a server is asked again that has no later episode
    try {
      const response = await request(`${place.dataset.latest}?shown=${encodeURIComponent(shown)}`);
      if (response.headers.get("x-run-over")) return;
      if (response.status === 200) {
        replay?.close();
        place.innerHTML = await response.text(); // rendered, and escaped, by the server
        const root = place.querySelector("[data-source]");
        shown = root.dataset.episode;
        root.querySelector(".own").hidden = false;
        replay = await open(root);
        replay.bar.play();
        while (replay.bar.k < replay.bar.length) await wait(500); // a visitor who pauses it keeps it
      }
    } catch {
      /* the service is not available: try again */
    }
    await pause;
  }
}

document.querySelectorAll("[data-latest]").forEach(follow);
