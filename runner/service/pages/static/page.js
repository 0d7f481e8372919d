// What all pages do: load parts that take long, reload parts that change, keep ages up to date, show the open tab.

// Fetch from this service; an error has the message of the response.
export async function request(address, options) {
  const response = await fetch(address, { headers: { accept: "application/json" }, ...options });
  if (response.ok) return response;
  const body = await response.json().catch(() => null);
  const message = body?.error.message ?? `The service responded with status ${response.status}.`;
  throw Object.assign(new Error(message), { status: response.status });
}

export const json = async (address) => (await request(address)).json();

export const wait = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

// Whether a key is part of a shortcut of the browser, or typed into a field.
export const isTaken = (event) =>
  event.ctrlKey ||
  event.metaKey ||
  event.altKey ||
  event.target.matches("input:not([type=checkbox], [type=range]), textarea, select");

// A part that takes long replaces its placeholder; one over the axis of charts reads every step, so only when near.
async function load(place) {
  const address = new URL(place.dataset.later, location.href),
    axis = new URLSearchParams(location.search).get("axis");
  if (axis && "overAxis" in place.dataset) address.searchParams.set("axis", axis);
  place.setAttribute("aria-busy", true);
  try {
    place.innerHTML = await (await request(address)).text(); // rendered, and escaped, by the server
  } catch (error) {
    place.className = "problem";
    place.innerHTML = "<p></p>";
    place.firstChild.textContent = error.message;
  }
  place.removeAttribute("aria-busy");
}

function look(entries) {
  for (const { isIntersecting, target } of entries)
    if (isIntersecting) {
      seen.unobserve(target);
      load(target);
    }
}
const seen = new IntersectionObserver(look, { rootMargin: "100%" });
const overAxis = () => document.querySelectorAll("[data-over-axis]").forEach((place) => seen.observe(place));
document.querySelectorAll("[data-later]:not([data-over-axis])").forEach(load);
document.addEventListener("change", ({ target }) => target.name === "axis" && overAxis());
addEventListener("popstate", overAxis);
overAxis();

// A part that changes is fetched repeatedly, until the whole page must be loaded again; of a list with ids only what
// follows its last entry.
async function reload(place) {
  try {
    const last = place.lastElementChild?.dataset.id;
    const response = await request(place.dataset.live + (last ?? ""));
    if (response.status === 204) return location.reload();
    if (!last) place.textContent = "";
    place.insertAdjacentHTML("beforeend", await response.text());
  } catch {
    /* the service is not available: try again */
  }
  setTimeout(reload, document.hidden ? 10000 : 1500, place);
}

document.querySelectorAll("[data-live]").forEach((place) => setTimeout(reload, 1500, place));

// The words of `runner.util.humanize.age`.
const UNITS = { d: 86400, h: 3600, min: 60, s: 1 };

setInterval(() => {
  for (const time of document.querySelectorAll("time[data-age]")) {
    const seconds = Math.max(0, Math.round((Date.now() - Date.parse(time.dateTime)) / 1000));
    const [unit, size] = Object.entries(UNITS).find(([, size]) => seconds >= size) ?? ["s", 1];
    time.textContent = `${Math.floor(seconds / size)} ${unit}`;
  }
}, 5000);

document.querySelector(".tabs [aria-current]")?.scrollIntoView({ block: "nearest", inline: "center" });
