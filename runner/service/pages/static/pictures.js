// The pictures of an episode, fetched in blocks as they are made: of those around the step shown, a limited number.
const BLOCK = 64,
  KEPT = 1500,
  AHEAD = 256;

// Return the function that `Replay` requests pictures with, or null where a replay has none.
//
// A block is the length of its head (32 bits, big-endian), the head as JSON, and the pictures: `sizes` has their bytes,
// `shown` the number of the picture at each step, `last` the last step of the episode, `note` a sentence on all
// pictures, `problem` the reason why there are no further ones. Blocks end at multiples of 64 steps, so that a browser
// finds them in its cache; the first has only the picture that is shown.
export function picturesOf(root, at = 0) {
  const source = root.dataset.pictures;
  if (!source) return null;
  const image = root.querySelector(".frame"),
    kept = new Map(),
    messages = new Map();
  let note = root.querySelector(".frame-note").textContent,
    wanted = at,
    show = () => {},
    reading = null,
    waiting = null,
    retry = null,
    last = Infinity,
    closed = false;

  const known = (k) => kept.has(k) || messages.has(k) || k > last;

  function keep(k, address) {
    kept.set(k, address);
    if (kept.size <= KEPT) return;
    const far = [...kept.keys()].reduce((a, b) => (Math.abs(a - wanted) > Math.abs(b - wanted) ? a : b));
    const gone = kept.get(far);
    kept.delete(far);
    if (gone.startsWith("blob:") && ![kept.get(far - 1), kept.get(far + 1)].includes(gone)) URL.revokeObjectURL(gone);
  }

  function tell() {
    if (kept.has(wanted)) show(kept.get(wanted), note);
    else if (messages.has(wanted)) show("", messages.get(wanted));
    else show("", "This picture is being made …");
  }

  async function read(start) {
    const steps = kept.size ? BLOCK - (start % BLOCK) : 1;
    const own = { start, next: start, stop: start + steps, control: new AbortController() };
    reading = own;
    try {
      const response = await fetch(`${source}?start=${start}&steps=${steps}`, { signal: own.control.signal });
      if (response.status === 503)
        retry = setTimeout(() => {
          messages.clear();
          more();
        }, 2500); // others are looking
      if (!response.ok)
        throw new Error(
          (await response.json().catch(() => null))?.error.message ??
            `The service responded with status ${response.status}.`,
        );
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
      if (wanted >= own.next && wanted < own.stop) tell();
    }
    if (reading === own) {
      reading = null;
      more();
    }
  }

  // Read the block of the step shown, then those after it.
  function more() {
    clearTimeout(waiting);
    if (closed) return;
    if (reading) {
      if (known(wanted) || (wanted >= reading.next && wanted < reading.stop)) return;
      reading.control.abort();
      reading = null;
    }
    let k = wanted;
    while (known(k) && k < wanted + AHEAD) k++;
    if (k > last || k >= wanted + AHEAD || messages.has(k)) return;
    waiting = setTimeout(read, k === wanted && kept.size > 1 ? 60 : 0, k); // a slider passes many steps
  }

  if (image?.getAttribute("src")) keep(at, image.getAttribute("src"));
  addEventListener("pagehide", () => {
    reading?.control.abort();
    clearTimeout(retry);
  });
  more();
  const pictures = (k, display) => {
    wanted = k;
    show = display;
    tell();
    more();
  };
  pictures.close = () => {
    // of a replay that is no longer shown
    closed = true;
    reading?.control.abort();
    clearTimeout(retry);
    clearTimeout(waiting);
    for (const address of new Set(kept.values())) if (address.startsWith("blob:")) URL.revokeObjectURL(address);
  };
  return pictures;
}
