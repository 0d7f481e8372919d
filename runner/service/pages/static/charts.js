// Metrics of one or several runs over training episodes. Of a long curve the server returns the lowest and the
// highest value of each stretch, with a notice; zooming in requests that part at full resolution.
import { request } from "./api.js";

const box = document.querySelector("[data-charts]");
const runs = JSON.parse(box.dataset.charts);
const plots = box.querySelector("[data-plots]"), message = box.querySelector("[data-message]"), form = box.querySelector("form");
const COLOURS = 7;  // of lines, in the style
const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3]];
const SHARES = "training.reward";
const shown = new Map();
let range = zoomed(), requests = 0;

function zoomed() {
  const query = new URLSearchParams(location.search);
  const end = (name) => query.get(name) ? Number(query.get(name)) : null;
  return { from: end("from"), to: end("to") };
}

const look = () => getComputedStyle(document.documentElement);
const colour = (i) => look().getPropertyValue(`--line-${i % COLOURS}`).trim();
const spoken = (name) => name.replaceAll("_", " ");

async function curvesOf(run) {
  const query = new URLSearchParams({ points: Math.max(400, Math.round(plots.clientWidth)) });
  if (range.from) query.set("start", Math.max(0, Math.floor(range.from)));
  if (range.to) query.set("stop", Math.ceil(range.to) + 1);
  return (await request(`/api/v1/runs/${run.id}/metrics?${query}`)).curves;
}

async function draw() {
  const mine = ++requests;
  box.setAttribute("aria-busy", "true");
  try {
    const found = await Promise.all(runs.map(curvesOf));
    if (mine !== requests) return;
    show(found);
  } catch (error) {
    message.textContent = error.message;
  }
  box.removeAttribute("aria-busy");
}

function show(found) {
  const metrics = new Map();
  found.forEach((curves, run) => curves.forEach((curve) => {
    if (curve.metric === SHARES && runs.length > 1) return;  // as many lines as rewards
    const panel = metrics.get(curve.metric) ?? { ...curve, lines: [] };
    panel.lines.push({ ...curve, run });
    metrics.set(curve.metric, panel);
  }));
  const ranked = [...metrics].sort(([one], [other]) => rank(one) - rank(other));
  for (const [metric, panel] of ranked) plot(metric, panel);
  for (const [metric, one] of shown) if (!metrics.has(metric)) { one.chart?.destroy(); one.figure.remove(); shown.delete(metric); }
  const all = [...metrics.values()].flatMap((panel) => panel.lines);
  const thinned = all.filter((line) => line.thinned);
  message.textContent = !all.length ? "No metrics were recorded."
    : thinned.length ? `Thinned: of up to ${Math.max(...thinned.map((line) => line.of)).toLocaleString("en")} points a curve the lowest and highest of each stretch are drawn. Zoom in for all of them.`
      : "Every recorded point is drawn. Drag across a plot to zoom; double click shows all.";
}

function rank(metric) {
  return metric === SHARES ? 4 : metric.startsWith("training.logged.") ? 3 : metric.startsWith("training.") ? 2 : metric.startsWith("event.") ? 1 : 0;
}

function plot(metric, panel) {
  const lines = [...new Set(panel.lines.map((line) => line.line))];
  const data = uPlot.join(panel.lines.map((line) => [line.episodes, line.values]));
  const labels = panel.lines.map((line) => label(line, lines));
  const kinds = JSON.stringify([labels, plots.clientWidth < 500]);
  let one = shown.get(metric);
  if (one && one.kinds !== kinds) { one.chart.destroy(); one.chart = null; }
  if (!one) {
    one = { figure: document.createElement("figure") };
    one.figure.className = metric === SHARES ? "wide" : "";
    one.figure.append(...["figcaption", "div", "div"].map((name) => document.createElement(name)));
    one.figure.children[2].className = "key";
    shown.set(metric, one);
    plots.append(one.figure);
  }
  const [caption, place, key] = one.figure.children;
  const [title, unit] = [document.createElement("b"), document.createElement("span")];
  title.textContent = panel.title;
  unit.textContent = panel.unit + (panel.lines.some((line) => line.thinned) ? ", thinned" : "")
    + (panel.lines.every((line) => line.episodes.length === 0) ? ", no point in this part" : "");
  caption.replaceChildren(title, " ", unit);
  place.setAttribute("role", "img");
  place.setAttribute("aria-label", `${panel.title}, ${panel.unit}: ${panel.lines.map((line) => summary(line, lines)).join("; ")}`);
  const sparse = panel.lines.every((line) => line.episodes.length < 80);
  if (one.chart) one.chart.setData(data);
  else one.chart = new uPlot(options(panel, lines, labels, place, key, sparse), data, place);
  if (one.kinds !== kinds) legend(one.chart, key, labels);
  one.kinds = kinds;
}

// A key of all lines, as they are drawn; a click hides or shows a line. While the cursor is over a plot, the key
// shows the episode and the values there.
function legend(chart, key, labels) {
  const entries = labels.map((name, i) => {
    const entry = document.createElement("button"), value = document.createElement("output");
    const { stroke, dash } = chart.series[i + 1];
    entry.type = "button";
    entry.append(sample(stroke(chart, i + 1), dash), name, " ", value);
    entry.setAttribute("aria-pressed", "true");
    entry.hidden = labels.length < 2;
    entry.addEventListener("click", () => {
      const show = !chart.series[i + 1].show;
      chart.setSeries(i + 1, { show });
      entry.setAttribute("aria-pressed", String(show));
    });
    return entry;
  });
  key.replaceChildren(...entries, document.createElement("output"));
}

function sample(stroke, dash) {
  const [picture, line] = ["svg", "line"].map((name) => document.createElementNS("http://www.w3.org/2000/svg", name));
  const set = (element, values) => Object.entries(values).forEach(([name, value]) => element.setAttribute(name, value));
  set(picture, { width: 30, height: 10, viewBox: "0 0 30 10", "aria-hidden": "true" });
  set(line, { x1: 1, x2: 29, y1: 5, y2: 5, stroke, "stroke-width": 2.5, "stroke-dasharray": dash.join(" ") });
  picture.append(line);
  return picture;
}

function readOut(chart, key) {
  const at = chart.cursor.idx, outputs = key.querySelectorAll("output");
  if (!outputs.length) return;
  const there = at !== null && at !== undefined && chart.cursor.left >= 0;
  const value = (i) => there && chart.data[i][at] !== null && chart.data[i][at] !== undefined ? exact(chart.data[i][at]) : "";
  chart.series.slice(1).forEach((_, i) => { if (outputs.length > 2) outputs[i].textContent = value(i + 1); });
  const alone = outputs.length === 2 && value(1) ? `: ${value(1)}` : "";
  outputs[outputs.length - 1].textContent = there ? `episode ${exact(chart.data[0][at])}${alone}` : "";
}

const exact = (value) => Number(value.toPrecision(6)).toLocaleString("en", { maximumFractionDigits: 6 });

function tick(value) {
  const size = Math.abs(value), units = [[1e12, "T"], [1e9, "G"], [1e6, "M"], [1e4, "k"]];
  if (size >= 1e15 || (size > 0 && size < 1e-4)) return value.toExponential(0);
  const [, unit] = units.find(([least]) => size >= least) ?? [1, ""];
  const shown = unit === "k" ? value / 1e3 : unit ? value / units.find(([, name]) => name === unit)[0] : value;
  return Number(shown.toPrecision(6)).toLocaleString("en", { maximumFractionDigits: 6 }) + unit;
}

function label(line, lines) {
  const parts = [runs.length > 1 ? runs[line.run].label : "", lines.length > 1 && line.line ? spoken(line.line) : ""];
  return parts.filter(Boolean).join(", ") || line.title;
}

function summary(line, lines) {
  const known = line.values.filter((value) => value !== null);
  const last = known.at(-1);
  if (last === undefined) return `${label(line, lines)} has no point in this part`;
  return `${label(line, lines)} ends at ${Number(last.toPrecision(4))}, between ${Number(Math.min(...known).toPrecision(4))} and ${Number(Math.max(...known).toPrecision(4))}`;
}

function options(panel, lines, labels, place, key, sparse) {
  const percent = panel.unit.startsWith("percent");
  const positive = panel.lines.every((line) => line.values.every((value) => value === null || value >= 0));
  const axis = {
    stroke: look().getPropertyValue("--soft").trim(), grid: { stroke: look().getPropertyValue("--line").trim(), width: 1 },
    ticks: { show: false }, font: "12px system-ui, sans-serif", values: (_, ticks) => ticks.map(tick),
  };
  const series = panel.lines.map((line, i) => {
    const at = lines.indexOf(line.line), several = runs.length > 1;
    const stroke = colour(several ? line.run : at);
    return { label: labels[i], stroke, width: 1.8, dash: DASHES[at % DASHES.length], spanGaps: true, points: { show: sparse, size: 4 } };
  });
  return {
    width: place.clientWidth, height: 216, padding: [8, 22, 0, 0],
    scales: { x: { time: false, range: (_, low, high) => [range.from ?? low ?? 0, range.to ?? high ?? 1] }, y: { range: (_, low, high) => bounds(low, high, percent, positive) } },
    series: [{ label: "episode" }, ...series],
    axes: [
      { ...axis, size: 28, label: "training episodes", labelSize: 18, labelGap: 0, labelFont: axis.font },
      { ...axis, size: (_, values) => 18 + 7.2 * Math.max(3, ...(values ?? []).map((text) => text.length)) },
    ],
    legend: { show: false },
    cursor: { drag: { x: true, y: false, setScale: false }, sync: { key: "metrics", setSeries: false } },
    hooks: { setSelect: [(chart) => zoom(chart)], setCursor: [(chart) => readOut(chart, key)] },
  };
}

function bounds(low, high, percent, positive) {
  if (percent && high <= 100 && low >= 0) return [0, 100];
  if (low === null) return [0, 1];
  const from = positive ? 0 : low - 0.05 * (high - low || 1);
  return [from, high + 0.05 * (high - from || 1)];
}

function zoom(chart) {
  const { left, width } = chart.select;
  if (width < 4) return;
  go(Math.max(0, chart.posToVal(left, "x")), chart.posToVal(left + width, "x"));
  chart.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
}

function go(from, to, keep = true) {
  range = { from: from === null ? null : Math.floor(from), to: to === null ? null : Math.ceil(to) };
  form.elements.from.value = range.from ?? "";
  form.elements.to.value = range.to ?? "";
  if (keep) {
    const query = new URLSearchParams(location.search);
    for (const [name, value] of Object.entries(range)) value === null ? query.delete(name) : query.set(name, value);
    history.pushState(null, "", query.size ? `?${query}` : location.pathname);
  }
  draw();
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  const end = (name) => form.elements[name].value === "" ? null : Number(form.elements[name].value);
  go(end("from"), end("to"));
});
box.querySelector("[data-reset]").addEventListener("click", () => go(null, null));
plots.addEventListener("dblclick", () => go(null, null));
addEventListener("popstate", () => { const { from, to } = zoomed(); go(from, to, false); });

let width = plots.clientWidth;
new ResizeObserver(() => {
  if (plots.clientWidth === width) return;
  width = plots.clientWidth;
  for (const { chart, figure } of shown.values()) chart?.setSize({ width: figure.children[1].clientWidth, height: 216 });
}).observe(plots);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  for (const one of shown.values()) one.kinds = null;
  draw();
});

form.elements.from.value = range.from ?? "";
form.elements.to.value = range.to ?? "";
await draw();
if (document.querySelector("[data-live]")) setInterval(() => { if (!document.hidden) draw(); }, 4000);
