// The Rerun viewer, told which recording to open and at which step: its own files, from this service.
const place = document.body.dataset, said = document.getElementById("said");
const theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
const wait = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

// The viewer would report to its makers; the policy of this page keeps it from that, and this from trying.
const own = window.fetch.bind(window);
window.fetch = (what, how) => new URL(what.url ?? what, location.href).origin === location.origin
  ? own(what, how) : Promise.resolve(new Response(null, { status: 204 }));

// What is asked of the viewer is a message in Protocol Buffers: rerun.viewer_control.v1alpha1.
function varint(value) {
  const bytes = [];
  for (let rest = BigInt(value); ; rest >>= 7n) {
    if (rest < 128n) return [...bytes, Number(rest)];
    bytes.push(Number(rest & 127n) | 128);
  }
}
const field = (number, content) => [number << 3 | 2, ...varint(content.length), ...content];

function setTimeCursor(timeline, time) {
  const name = field(1, [...new TextEncoder().encode(timeline)]);
  const paused = [5 << 3, 1];
  return new Uint8Array(field(6, [...field(2, name), ...field(3, [1 << 3, ...varint(time)]), ...paused]));
}

async function ready() {
  const answer = await fetch(place.recording, { method: "GET", headers: { range: "bytes=0-0" } });
  if (answer.ok) return;
  const told = await answer.json().catch(() => null);
  throw new Error(told?.error.message ?? `The service answers ${answer.status}.`);
}

async function open() {
  console.debug = () => {};
  await ready();
  said.textContent = "Loading the viewer …";
  await wasm_bindgen({ module_or_path: place.wasm });
  const handle = new wasm_bindgen.WebHandle({
    url: [new URL(place.recording, location.href).href],
    hide_welcome_screen: true, enable_history: false, notebook: false, persist: false, theme,
    render_backend: "webgl", manifest_url: null,
  });
  await handle.start(document.getElementById("viewer"));
  said.hidden = true;
  const request = setTimeCursor("step", place.step);
  for (let tries = 0; tries < 400; tries++) {
    if (handle.has_panicked()) throw new Error(`The viewer has crashed: ${handle.panic_message()}`);
    try {
      await handle.viewer_control(request);
      document.body.dataset.opened = place.step;
      return;
    } catch (error) {
      if (error.name !== "ViewerControlError") throw error;  // the recording is not there yet
      await wait(150);
    }
  }
}

open().catch((error) => { said.hidden = false; said.textContent = error.message; });
