// A job under way: its events as the server sends them.
const head = document.querySelector("[data-job]");
const [state, progress, runs, log] = ["state", "progress", "runs", "log"].map((name) => document.querySelector(`[data-${name}]`));
const count = (number) => number.toLocaleString("en");
let seen = Number(head.dataset.place);
log.scrollTop = log.scrollHeight;

function line(time, text) {
  const item = document.createElement("li"), when = document.createElement("time");
  when.dateTime = time ?? "";
  when.textContent = (time ?? "").slice(11, 19);
  item.append(when, " ", text);
  const isAtEnd = log.scrollHeight - log.scrollTop - log.clientHeight < 40;
  log.append(item);
  if (isAtEnd) log.scrollTop = log.scrollHeight;
}

function said(data) {
  if ("done" in data) return [data.done / Math.max(1, data.runs), `${count(data.done)} of ${count(data.runs)} runs`];
  const run = data.runs > 1 ? `, run ${data.run} of ${data.runs}` : "";
  return [(data.run - 1 + data.episode / Math.max(1, data.episodes)) / data.runs, `${count(data.episode)} of ${count(data.episodes)} episodes${run}`];
}

// What the page says already was rendered by the server; only what came after it is added.
function heard(kind, tell) {
  source.addEventListener(kind, (event) => {
    const fresh = !event.lastEventId || Number(event.lastEventId) > seen;
    if (fresh) tell(JSON.parse(event.data));
  });
}

const source = new EventSource(`${head.dataset.job}/events`);
heard("progress", (data) => {
  const [share, words] = said(data);
  progress.hidden = false;
  progress.querySelector("progress").value = share;
  progress.querySelector("span").textContent = words;
});
heard("run", (data) => {
  line(data.time, `run ${data.run_id} begins`);
  if (!runs) return;
  const item = document.createElement("li"), link = document.createElement("a");
  link.href = `/runs/${data.run_id}`;
  link.textContent = data.run_id;
  item.append(link, `, seed ${data.seed}`);
  runs.append(item);
});
heard("log", (data) => line(data.time, data.text));
heard("state", (data) => {
  line(data.time, data.state + (data.error ? `: ${data.error}` : ""));
  state.textContent = data.state;
  state.className = `status ${data.state}`;
  if (!["queued", "running"].includes(data.state)) { source.close(); location.reload(); }
});
