// A job: its log is shown from its end; while the job is not over, its events are added as they come.
const head = document.querySelector("[data-job]");
const [state, progress, runs, log] = ["state", "progress", "runs", "log"].map((name) => document.querySelector(`[data-${name}]`));
const count = (number) => number.toLocaleString("en");
log.scrollTop = log.scrollHeight;

function line(time, ...content) {
  const item = document.createElement("li"), when = document.createElement("time");
  when.dateTime = time ?? "";
  when.textContent = (time ?? "").slice(11, 19);
  item.append(when, " ", ...content);
  const isAtEnd = log.scrollHeight - log.scrollTop - log.clientHeight < 40;
  log.append(item);
  if (isAtEnd) log.scrollTop = log.scrollHeight;
}

function linked(id) {
  const link = document.createElement("a");
  link.href = `/runs/${id}`;
  link.textContent = id;
  return link;
}

function said(data) {
  if ("done" in data) return [data.done / Math.max(1, data.runs), `${count(data.done)} of ${count(data.runs)} runs`];
  const run = data.runs > 1 ? `, run ${data.run} of ${data.runs}` : "";
  return [(data.run - 1 + data.episode / Math.max(1, data.episodes)) / data.runs, `${count(data.episode)} of ${count(data.episodes)} episodes${run}`];
}

function watch() {
  // The server rendered what came before; a connection that breaks goes on where it was by itself.
  const source = new EventSource(`${head.dataset.job}/events?after=${head.dataset.place}`);
  const on = (kind, show) => source.addEventListener(kind, (event) => show(JSON.parse(event.data)));
  on("progress", (data) => {
    const [share, words] = said(data);
    progress.hidden = false;
    progress.querySelector("progress").value = share;
    progress.querySelector("span").textContent = words;
  });
  on("run", (data) => {
    line(data.time, "run ", linked(data.run_id), " begins");
    if (!runs) return;
    const item = document.createElement("li");
    item.append(linked(data.run_id), `, seed ${data.seed}`);
    runs.append(item);
  });
  on("log", (data) => line(data.time, data.text));
  on("state", (data) => {
    line(data.time, data.state + (data.error ? `: ${data.error}` : ""));
    state.textContent = data.state;
    state.className = `status ${data.state}`;
    if (!["queued", "running"].includes(data.state)) { source.close(); location.reload(); }
  });
}

if ("active" in head.dataset) watch();
