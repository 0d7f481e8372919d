// Replays of episodes that the server sends in parts, with pictures in blocks as they are made.
import { json, request } from "./page.js";

const BEFORE = 250; // steps before the requested one, as in pages/replay.py
const BLOCK = 64,
  AHEAD = 256, // pictures
  KEPT = 12; // blocks before and after the picture that is shown

// Return the replay of the episode at `data-source`, at a step.
export async function open(root, at = 0, moved) {
  const part = async (k) => (await json(`${root.dataset.source}?start=${Math.max(0, k - BEFORE)}`)).episode;
  root.setAttribute("aria-busy", "true");
  const pictures = picturesOf(root, at);
  const episode = await part(at)
    .catch((error) => {
      root.querySelector(".description").textContent = error.message;
      throw error;
    })
    .finally(() => root.removeAttribute("aria-busy"));
  const replay = new Replay(root, { load: part, moved, pictures });
  await replay.begin(episode, at);
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
// pictures, `problem` the reason why there are no further ones. Most end at multiples of 64 steps, so that a browser
// finds them in its cache; the first has only the picture that is shown.
function picturesOf(root, at) {
  const source = root.dataset.pictures;
  if (!source) return null;
  const blocks = new Map(), // by number, with the address of the picture at each step
    messages = new Map(); // or why there is none
  let note = root.querySelector(".frame-note").textContent,
    wanted = at,
    show = () => {},
    reading = null,
    timer = null,
    last = Infinity;

  const numberOf = (k) => Math.floor(k / BLOCK);
  const addressOf = (k) => blocks.get(numberOf(k))?.[k % BLOCK] ?? "";
  const known = (k) => addressOf(k) || messages.has(k) || k > last;

  function drop(number) {
    blocks.get(number).forEach((address) => URL.revokeObjectURL(address));
    blocks.delete(number);
  }

  function tell() {
    const address = addressOf(wanted);
    show(address, address ? note : (messages.get(wanted) ?? "This picture is being made …"));
  }

  async function read(start) {
    let stop = start + 1;
    if (blocks.size) {
      while (stop % BLOCK && !addressOf(stop)) stop++;
      // Where later pictures are known, the user steps back.
      while (addressOf(stop) && stop - start < 16 && start % BLOCK && !addressOf(start - 1)) start--;
    }
    const own = { next: start, stop, control: new AbortController() };
    reading = own;
    try {
      const response = await request(`${source}?start=${start}&steps=${stop - start}`, { signal: own.control.signal });
      const body = await response.arrayBuffer(),
        begin = 4 + new DataView(body).getUint32(0),
        head = JSON.parse(new TextDecoder().decode(body.slice(4, begin)));
      let end = begin;
      const addresses = head.sizes.map((size) => URL.createObjectURL(new Blob([body.slice(end, (end += size))])));
      note = head.note || note;
      last = head.last;
      const block = blocks.get(numberOf(start)) ?? [];
      for (const picture of head.shown) block[own.next++ % BLOCK] = addresses[picture];
      blocks.set(numberOf(start), block);
      if (head.problem) throw new Error(head.problem);
    } catch (error) {
      if (error.name === "AbortError") {
        if (reading === own) reading = null;
        return;
      }
      for (let k = own.next; k < own.stop; k++) messages.set(k, error.message);
      if (error.status === 503) setTimeout(retry, 2500); // others are looking
    }
    tell();
    for (const number of blocks.keys()) if (Math.abs(number - numberOf(wanted)) > KEPT) drop(number);
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
      if (known(wanted) || (wanted >= reading.next && wanted < reading.stop)) return;
      reading.control.abort();
      reading = null;
    }
    let k = wanted;
    while (known(k) && k < wanted + AHEAD) k++;
    if (k < wanted + AHEAD && root.isConnected) timer = setTimeout(read, k === wanted && blocks.size ? 60 : 0, k);
  }

  function close() {
    reading?.control.abort();
    clearTimeout(timer);
    [...blocks.keys()].forEach(drop);
  }

  addEventListener("pagehide", () => reading?.control.abort());
  addEventListener("pageshow", more); // the browser may have kept the page
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
