// A part of a page that changes: asked for again and again, until the page as a whole is another.
const place = document.querySelector("[data-live]");

async function look() {
  try {
    const answer = await fetch(place.dataset.live, { headers: { accept: "text/html" } });
    if (answer.status === 204) return location.reload();
    if (answer.ok) place.innerHTML = await answer.text();  // rendered, and escaped, by the server
  } catch { /* the service is away: ask again */ }
  setTimeout(look, document.hidden ? 10000 : 1500);
}

setTimeout(look, 1500);
