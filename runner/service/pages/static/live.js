// A part of a page that changes: fetched repeatedly, until the whole page must be loaded again.
const place = document.querySelector("[data-live]");

async function look() {
  try {
    const response = await fetch(place.dataset.live, { headers: { accept: "text/html" } });
    if (response.status === 204) return location.reload();
    if (response.ok) place.innerHTML = await response.text(); // rendered, and escaped, by the server
  } catch {
    /* the service is not available: try again */
  }
  setTimeout(look, document.hidden ? 10000 : 1500);
}

setTimeout(look, 1500);
