// Replays of episodes that the server sends in parts, with pictures in blocks as they are made.
import { json, request } from "./page.js";

const BEFORE = 250; // steps before the requested one, as in pages/replay.py
const BLOCK = 64,
  KEPT = 1500,
  AHEAD = 256; // pictures

// Return the replay of the episode at `data-source`, at a step.
export async function open(root, at = 0, moved) {
  const part = async (k) => (await json(`${root.dataset.source}?start=${Math.max(0, k - BEFORE)}`)).episode;
  root.setAttribute("aria-busy", "true");
  const pictures = picturesOf(root, at);
  const episode = await part(at).finally(() => root.removeAttribute("aria-busy"));
  const replay = new Replay(root, { load: part, moved, pictures });
  await replay.begin(episode, Math.min(at, episode.length));
  return replay;
}

// Browsers limit how often the address may change, so a playing replay does not write every step.
let writing = null;
export function keepAddress(address) {
  clearTimeout(writing);
  writing = setTimeout(() => history.replaceState(null, "", address), 150);
}

// Keys move and play, unless the element with the focus uses them.
export function listen(bar) {
  document.addEventListener("keydown", (event) => {
    if (!event.target.matches("input, textarea, select, button, a, summary")) bar.key(event);
  });
}

// Return the function that `Replay` requests pictures with, or null where a replay has none.
//
// A block is the length of its head (32 bits, big-endian), the head as JSON, and the pictures: `sizes` has their bytes,
// `shown` the number of the picture at each step, `last` the last step of the episode, `note` a sentence on all
// pictures, `problem` the reason why there are no further ones. Blocks end at multiples of 64 steps, so that a browser
// finds them in its cache; the first has only the picture that is shown.
function picturesOf(root, at) {
  const source = root.dataset.pictures;
  if (!source) return null;
  const kept = new Map(), // the address of the picture at a step
    messages = new Map(); // or why there is none
  let note = root.querySelector(".frame-note").textContent,
    wanted = at,
    show = () => {},
    reading = null,
    timer = null,
    last = Infinity;

  const known = (k) => kept.has(k) || messages.has(k) || k > last;
  const isRead = (k) => reading && k >= reading.next && k < reading.stop;

  function keep(k, address) {
    kept.set(k, address);
    if (kept.size <= KEPT) return;
    const far = [...kept.keys()].reduce((a, b) => (Math.abs(a - wanted) > Math.abs(b - wanted) ? a : b));
    const gone = kept.get(far);
    kept.delete(far);
    if (![kept.get(far - 1), kept.get(far + 1)].includes(gone)) URL.revokeObjectURL(gone);
  }

  function tell() {
    if (kept.has(wanted)) show(kept.get(wanted), note);
    else show("", messages.get(wanted) ?? "This picture is being made …");
  }

  async function read(start) {
    const steps = kept.size ? BLOCK - (start % BLOCK) : 1,
      own = { next: start, stop: start + steps, control: new AbortController() };
    reading = own;
    try {
      const response = await request(`${source}?start=${start}&steps=${steps}`, { signal: own.control.signal });
      const body = await response.arrayBuffer(),
        begin = 4 + new DataView(body).getUint32(0),
        head = JSON.parse(new TextDecoder().decode(body.slice(4, begin)));
      let end = begin;
      const addresses = head.sizes.map((size) => URL.createObjectURL(new Blob([body.slice(end, (end += size))])));
      note = head.note || note;
      last = head.last;
      for (const number of head.shown) keep(own.next++, addresses[number]);
      if (wanted >= start && wanted < own.next) tell();
      if (head.problem) throw new Error(head.problem);
    } catch (error) {
      if (error.name === "AbortError") return;
      for (let k = own.next; k < own.stop; k++) messages.set(k, error.message);
      if (isRead(wanted)) tell();
      if (error.status === 503) setTimeout(retry, 2500); // others are looking
    }
    if (reading === own) {
      reading = null;
      more();
    }
  }

  function retry() {
    messages.clear();
    more();
  }

  // Read the block of the step shown, then those after it; a slider passes many steps.
  function more() {
    clearTimeout(timer);
    if (reading) {
      if (known(wanted) || isRead(wanted)) return;
      reading.control.abort();
      reading = null;
    }
    let k = wanted;
    while (known(k) && k < wanted + AHEAD) k++;
    if (k <= last && k < wanted + AHEAD && !messages.has(k) && root.isConnected)
      timer = setTimeout(read, k === wanted && kept.size > 1 ? 60 : 0, k);
  }

  function close() {
    reading?.control.abort();
    clearTimeout(timer);
    new Set(kept.values()).forEach((address) => URL.revokeObjectURL(address));
  }

  addEventListener("pagehide", () => reading?.control.abort());
  more();
  return Object.assign(
    (k, display) => {
      wanted = k;
      show = display;
      tell();
      more();
    },
    { close },
  );
}
