// A job: the page shows the end of its log; until the job is over, events are added as they arrive.
const head = document.querySelector("[data-job]");
const [state, progress, runs, log] = ["state", "progress", "runs", "log"].map((name) =>
  document.querySelector(`[data-${name}]`),
);
const count = (number) => number.toLocaleString("en");
log.scrollTop = log.scrollHeight;

function line(time, ...content) {
  const item = document.createElement("li"),
    when = document.createElement("time");
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

function progressOf(data) {
  if ("done" in data) return [data.done / Math.max(1, data.runs), `${count(data.done)} of ${count(data.runs)} runs`];
  const run = data.runs > 1 ? `, run ${data.run} of ${data.runs}` : "";
  const share = (data.run - 1 + data.episode / Math.max(1, data.episodes)) / data.runs;
  if (data.train_steps + data.eval_steps === 0) return [share, `preparing${run}`];
  if (data.episodes === 0) return [share, `${count(data.train_steps)} steps`];
  return [share, `${count(data.episode)} of ${count(data.episodes)} episodes${run}`];
}

function watch() {
  // The server rendered the earlier events; the browser resumes a broken connection where it was.
  const source = new EventSource(`${head.dataset.job}/events?after=${head.dataset.place}`);
  const on = (kind, show) => source.addEventListener(kind, (event) => show(JSON.parse(event.data)));
  on("progress", (data) => {
    const [share, words] = progressOf(data);
    progress.hidden = false;
    progress.querySelector("progress").value = share;
    progress.querySelector("span").textContent = words;
  });
  on("run", (data) => {
    line(data.time, "run ", linked(data.run_id), " started");
    if (!runs) return;
    const item = document.createElement("li");
    item.append(linked(data.run_id), `, seed ${data.seed}`);
    runs.append(item);
  });
  on("log", (data) => line(data.time, data.text));
  on("state", (data) => {
    line(data.time, `job ${data.state}` + (data.error ? `: ${data.error}` : ""));
    state.textContent = data.state;
    state.className = `status ${data.state}`;
    if (!["queued", "running"].includes(data.state)) {
      source.close();
      location.reload();
    }
  });
}

if ("active" in head.dataset) watch();
