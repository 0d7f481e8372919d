// Opens a recording in the Rerun viewer at a step; the viewer's files come from this service.
import { request, wait } from "./page.js";

const place = document.body.dataset,
  message = document.getElementById("message");
const theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";

// The viewer sends usage data to its makers, which the policy of this page forbids; this avoids the attempt.
const own = window.fetch.bind(window);
window.fetch = (what, how) =>
  new URL(what.url ?? what, location.href).origin === location.origin
    ? own(what, how)
    : Promise.resolve(new Response(null, { status: 204 }));

async function open() {
  console.debug = () => {};
  await request(place.recording, { headers: { range: "bytes=0-0" } });
  message.textContent = "Loading the viewer …";
  await wasm_bindgen({ module_or_path: place.wasm });
  const handle = new wasm_bindgen.WebHandle({
    url: [new URL(place.recording, location.href).href],
    hide_welcome_screen: true,
    enable_history: false,
    notebook: false,
    persist: false,
    theme,
    render_backend: "webgl",
    manifest_url: null,
  });
  await handle.start(document.getElementById("viewer"));
  message.hidden = true;
  const command = Uint8Array.from(place.command.match(/../g), (byte) => Number.parseInt(byte, 16));
  for (let tries = 0; tries < 400; tries++) {
    if (handle.has_panicked()) throw new Error(`The viewer has crashed: ${handle.panic_message()}`);
    try {
      await handle.viewer_control(command);
      place.opened = place.step;
      return;
    } catch (error) {
      if (error.name !== "ViewerControlError") throw error; // the recording is not there yet
      await wait(150);
    }
  }
}

open().catch((error) => {
  message.hidden = false;
  message.textContent = error.message;
});
