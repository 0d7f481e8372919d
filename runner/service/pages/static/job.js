// A job: the page shows the end of its log; until the job is over, events are added as they arrive.
const [log, state, progress, runs] = ["[data-job]", "[data-state] span", "[data-progress]", "[data-runs]"].map((selector) =>
  document.querySelector(selector),
);
const count = (number) => number.toLocaleString("en");

function made(tag, values, ...content) {
  const element = Object.assign(document.createElement(tag), values);
  element.append(...content);
  return element;
}

const linked = (id) => made("a", { href: `/runs/${id}` }, id);

function line(time = "", ...content) {
  const isAtEnd = log.scrollHeight - log.scrollTop - log.clientHeight < 40;
  log.append(made("li", {}, made("time", { dateTime: time }, time.slice(11, 19)), " ", ...content));
  if (isAtEnd) log.scrollTop = log.scrollHeight;
}

function progressOf(data) {
  if ("done" in data) return [data.done / Math.max(1, data.runs), `${count(data.done)} of ${count(data.runs)} runs`];
  const run = data.runs > 1 ? `, run ${data.run} of ${data.runs}` : "",
    share = (data.run - 1 + data.episode / Math.max(1, data.episodes)) / data.runs;
  if (data.train_steps + data.eval_steps === 0) return [share, `preparing${run}`];
  if (data.episodes === 0) return [share, `${count(data.train_steps)} steps`];
  return [share, `${count(data.episode)} of ${count(data.episodes)} episodes${run}`];
}

const ON = {
  progress(data) {
    progress.hidden = false;
    [progress.firstElementChild.value, progress.lastElementChild.textContent] = progressOf(data);
  },
  run(data) {
    line(data.time, "run ", linked(data.run_id), " started");
    runs?.append(made("li", {}, linked(data.run_id), `, seed ${data.seed}`));
  },
  log(data) {
    line(data.time, data.text);
  },
  state(data) {
    line(data.time, `job ${data.state}${data.error ? `: ${data.error}` : ""}`);
    state.textContent = data.state;
    state.className = `status ${data.state}`;
    if (!["queued", "running"].includes(data.state)) location.reload();
  },
};

log.scrollTop = log.scrollHeight;
if ("active" in log.dataset) {
  // The server rendered the earlier events; the browser resumes a broken connection where it was.
  const source = new EventSource(`${log.dataset.job}/events?after=${log.dataset.place}`);
  for (const [kind, show] of Object.entries(ON))
    source.addEventListener(kind, (event) => show(JSON.parse(event.data)));
}
