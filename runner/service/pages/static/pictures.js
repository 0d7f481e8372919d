// The pictures of an episode, fetched in pieces as they are made: of those around the step shown, a limited number.
const PIECE = 64,
  KEPT = 1500,
  AHEAD = 256;

// Return the function that `Replay` requests pictures with, or null where a replay has none.
//
// A piece is a stream of pictures: for each its length (32 bits, big-endian) and its bytes. Without bytes it is the
// same as the one before it. The length 2^32 - 1 begins a message in place of the pictures that cannot be had;
// 2^32 - 2 a note on all of them, after its length.
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
    const own = { start, next: start, stop: start + PIECE, control: new AbortController() };
    reading = own;
    let before = null;
    const take = (k, bytes) => {
      if (bytes.length) before = URL.createObjectURL(new Blob([bytes]));
      if (before !== null) keep(k, before);
      own.next = k + 1;
      if (k === wanted) tell();
    };
    try {
      const response = await fetch(`${source}?start=${start}&steps=${PIECE}`, { signal: own.control.signal });
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
      const failed = await records(
        response.body.getReader(),
        (bytes, number) => take(start + number, bytes),
        (text) => {
          note = text;
        },
      );
      if (failed !== null) throw new Error(failed);
      if (own.next < own.stop) last = Math.min(last, own.next - 1);
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

  // Read the piece of the step shown, then those after it.
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

// Call `take` with the bytes and the number of each picture, and `noted` with a note; return the message that ends
// the stream, or null.
async function records(reader, take, noted) {
  let bytes = new Uint8Array(0),
    number = 0;
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return null;
    const joined = new Uint8Array(bytes.length + value.length);
    joined.set(bytes);
    joined.set(value, bytes.length);
    bytes = joined;
    while (bytes.length >= 4) {
      const view = new DataView(bytes.buffer, bytes.byteOffset),
        length = view.getUint32(0);
      if (length === 0xfffffffe) {
        if (bytes.length < 8 || bytes.length < 8 + view.getUint32(4)) break;
        const end = 8 + view.getUint32(4);
        noted(new TextDecoder().decode(bytes.subarray(8, end)));
        bytes = bytes.subarray(end);
        continue;
      }
      if (length === 0xffffffff) {
        const rest = [bytes.slice(4)];
        for (let part = await reader.read(); !part.done; part = await reader.read()) rest.push(part.value);
        return new Blob(rest).text();
      }
      if (bytes.length < 4 + length) break;
      take(bytes.slice(4, 4 + length), number++);
      bytes = bytes.subarray(4 + length);
    }
  }
}
