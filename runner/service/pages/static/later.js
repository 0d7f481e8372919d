// Parts of a page that take long to compute: each is fetched and replaces its placeholder.
async function fill(place) {
  const axis = "overAxis" in place.dataset ? new URLSearchParams(location.search).get("axis") : null;
  try {
    const response = await fetch(
      place.dataset.later +
        (axis ? `${place.dataset.later.includes("?") ? "&" : "?"}axis=${encodeURIComponent(axis)}` : ""),
      { headers: { accept: "application/json" } },
    );
    if (!response.ok)
      throw new Error(
        (await response.json().catch(() => null))?.error.message ??
          `The service responded with status ${response.status}.`,
      );
    place.innerHTML = await response.text(); // rendered, and escaped, by the server
  } catch (error) {
    const problem = document.createElement("p");
    problem.textContent = error.message;
    place.replaceChildren(problem);
    place.className = "problem";
  }
  place.removeAttribute("aria-busy");
}

// What depends on the axis is computed when it is seen: it reads every step.
const seen = new IntersectionObserver((entries) =>
  entries
    .filter((entry) => entry.isIntersecting)
    .forEach((entry) => {
      seen.unobserve(entry.target);
      fill(entry.target);
    }),
);
document
  .querySelectorAll("[data-later]")
  .forEach((place) => ("overAxis" in place.dataset ? seen.observe(place) : fill(place)));
document.addEventListener("axischange", () =>
  document.querySelectorAll("[data-over-axis]").forEach((place) => seen.observe(place)),
);
