// Parts of a page that take their time: each is fetched, and takes the place of what announces it.
async function fill(place) {
  try {
    const answer = await fetch(place.dataset.later, { headers: { accept: "application/json" } });
    if (!answer.ok) throw new Error((await answer.json().catch(() => null))?.error.message ?? `The service answers ${answer.status}.`);
    place.innerHTML = await answer.text();  // rendered, and escaped, by the server
  } catch (error) {
    const problem = document.createElement("p");
    problem.textContent = error.message;
    place.replaceChildren(problem);
    place.className = "problem";
  }
  place.removeAttribute("aria-busy");
}

document.querySelectorAll("[data-later]").forEach(fill);
