// Opens a recording in the Rerun viewer at a step; the viewer's files come from this service.
const place = document.body.dataset,
  message = document.getElementById("message");
const theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
const wait = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

// The viewer sends usage data to its makers, which the policy of this page forbids; this avoids the attempt.
const own = window.fetch.bind(window);
window.fetch = (what, how) =>
  new URL(what.url ?? what, location.href).origin === location.origin
    ? own(what, how)
    : Promise.resolve(new Response(null, { status: 204 }));

// Commands to the viewer are Protocol Buffers messages: rerun.viewer_control.v1alpha1.
function varint(value) {
  const bytes = [];
  for (let rest = BigInt(value); ; rest >>= 7n) {
    if (rest < 128n) return [...bytes, Number(rest)];
    bytes.push(Number(rest & 127n) | 128);
  }
}
const field = (number, content) => [(number << 3) | 2, ...varint(content.length), ...content];

function setTimeCursor(timeline, time) {
  const name = field(1, [...new TextEncoder().encode(timeline)]);
  const paused = [5 << 3, 1];
  return new Uint8Array(field(6, [...field(2, name), ...field(3, [1 << 3, ...varint(time)]), ...paused]));
}

async function ready() {
  const response = await fetch(place.recording, { method: "GET", headers: { range: "bytes=0-0" } });
  if (response.ok) return;
  const body = await response.json().catch(() => null);
  throw new Error(body?.error.message ?? `The service responded with status ${response.status}.`);
}

async function open() {
  console.debug = () => {};
  await ready();
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
  const request = setTimeCursor("step", place.step);
  for (let tries = 0; tries < 400; tries++) {
    if (handle.has_panicked()) throw new Error(`The viewer has crashed: ${handle.panic_message()}`);
    try {
      await handle.viewer_control(request);
      document.body.dataset.opened = place.step;
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
