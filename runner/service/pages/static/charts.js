// Metrics of one or several runs over an axis; runs that differ in nothing but the seed are one line with a band.
// Of a long curve the server returns the lowest and the highest value of each stretch, with a notice; zooming in
// requests that part at full resolution. The address holds what is chosen.
import { json } from "./page.js";

const box = document.querySelector("[data-charts]");
const runs = JSON.parse(box.dataset.charts);
const plots = box.querySelector("[data-plots]"),
  message = box.querySelector("[data-message]"),
  restore = box.querySelector("[data-hidden]");
const form = box.querySelector("form"),
  fields = form.elements;
const COLOURS = 7; // of lines, in the style
const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3]];
const MAX_AXES = 100; // logged values among the axes to choose from
const SHARES = "training.reward";
const HIDDEN = "charts hidden",
  PINNED = "charts pinned"; // names of metrics, which this browser keeps
const shown = new Map();
let requests = 0,
  last = null;

// --- what is chosen: in the address, and in the form ----------------------------------------------------

function chosen() {
  const query = new URLSearchParams(location.search);
  const number = (name) => (query.get(name) ? Number(query.get(name)) : null);
  return {
    axis: query.get("axis") ?? "episodes",
    from: number("from"),
    to: number("to"),
    smooth: number("smooth") ?? 0,
    log_x: query.has("log_x"),
    log_y: query.has("log_y"),
    lines: query.has("lines"),
    logged: query.get("logged") ?? "",
  };
}

function fill(state) {
  for (const name of ["from", "to"]) fields[name].value = state[name] ?? "";
  for (const name of ["log_x", "log_y", "lines"]) fields[name].checked = state[name];
  fields.logged.value = state.logged;
  fields.smooth.value = state.smooth;
  fields.smoothed.value = state.smooth ? `${state.smooth} % of the axis` : "none";
}

function change(changes, keep = true) {
  const query = new URLSearchParams(location.search);
  for (const [name, value] of Object.entries(changes)) {
    if (value === null || value === false || value === 0 || value === "" || value === "episodes") query.delete(name);
    else query.set(name, value === true ? "1" : value);
  }
  if (keep) history.pushState(null, "", query.size ? `?${query}` : location.pathname);
  else history.replaceState(null, "", query.size ? `?${query}` : location.pathname);
  fill(chosen());
}

function remembered(which) {
  try {
    return new Set(JSON.parse(localStorage.getItem(which) ?? "[]"));
  } catch {
    return new Set(); // the browser keeps nothing for pages, or something else was there
  }
}

function remember(which, metric, isMember) {
  const metrics = remembered(which);
  if (isMember) metrics.add(metric);
  else metrics.delete(metric);
  try {
    localStorage.setItem(which, JSON.stringify([...metrics]));
    show();
  } catch (error) {
    message.textContent = `The browser does not let pages keep anything: ${error.message}`;
  }
}

// --- data -----------------------------------------------------------------------------------------------

function selection() {
  const { axis, smooth, log_x, log_y } = chosen();
  const query = new URLSearchParams({ axis });
  for (const run of runs) query.append("run", run.id);
  for (const [name, value] of Object.entries({ smooth, log_x, log_y })) if (value) query.set(name, value);
  return query;
}

async function draw() {
  const mine = ++requests,
    { axis, from, to, lines, smooth, logged } = chosen();
  const query = new URLSearchParams({ axis, points: Math.max(400, Math.round(plots.clientWidth)) });
  for (const run of runs) query.append("run", run.id);
  if (from !== null) query.set("start", Math.max(0, from));
  if (to !== null) query.set("stop", axis === "time" ? to : to + 1);
  if (lines) query.set("lines", "true");
  if (smooth) query.set("smooth", smooth);
  if (logged) query.set("metric", `training.logged.${logged}`);
  box.setAttribute("aria-busy", "true");
  try {
    const found = await json(`/api/v1/curves?${query}`);
    if (mine !== requests) return;
    last = found;
    const named = found.axes.map(({ name }) => name),
      others = found.names.filter((name) => !named.includes(name)).slice(0, MAX_AXES);
    fields.axis.replaceChildren(
      ...[...found.axes, ...others.map((name) => ({ name, label: name }))].map(
        ({ name, label }) => new Option(label, name, false, name === found.axis),
      ),
    );
    box.querySelector("[data-names]").hidden = found.names.length < 2;
    fields.logged.list.replaceChildren(...found.names.map((name) => new Option(name)));
    box.querySelector("[data-seeds]").hidden = found.groups.every((group) => group.runs.length < 2);
    found.groups.forEach((group, i) =>
      group.runs.forEach((id) => {
        // the colours of the runs above
        const swatch = document.querySelector(`.swatch[data-run="${id}"]`);
        if (swatch) swatch.className = `swatch line-${i % COLOURS}`;
      }),
    );
    show();
  } catch (error) {
    message.textContent = error.message;
  }
  box.removeAttribute("aria-busy");
}

function show() {
  const metrics = new Map();
  for (const curve of last.curves) {
    const panel = metrics.get(curve.metric) ?? { ...curve, curves: [] };
    panel.curves.push(curve);
    metrics.set(curve.metric, panel);
  }
  const hidden = remembered(HIDDEN),
    pinned = remembered(PINNED),
    first = (metric) => (pinned.has(metric) ? -1 : rank(metric));
  const ranked = [...metrics]
    .filter(([metric]) => !hidden.has(metric))
    .sort(([one], [other]) => first(one) - first(other));
  for (const [metric, panel] of ranked) plot(metric, panel, pinned.has(metric));
  const order = ranked.map(([metric]) => shown.get(metric).figure);
  if (order.some((figure, i) => plots.children[i] !== figure)) plots.append(...order);
  const left = [...metrics].filter(([metric]) => hidden.has(metric));
  restore.hidden = !left.length;
  restore.replaceChildren(
    "Hidden, click to show: ",
    ...left.map(([metric, { title }]) => button(title, () => remember(HIDDEN, metric, false))),
  );
  for (const [metric, one] of shown)
    if (!metrics.has(metric) || hidden.has(metric)) {
      one.chart?.destroy();
      one.figure.remove();
      shown.delete(metric);
    }
  const thinned = last.curves.filter((curve) => curve.thinned),
    repeated = last.groups.flatMap((group) => group.left_out);
  const parts = [
    !last.curves.length
      ? "No metrics were recorded."
      : thinned.length
        ? `Thinned: of up to ${Math.max(...thinned.map((curve) => curve.of)).toLocaleString("en")} points a curve ` +
          "the lowest and highest of each stretch are drawn. Zoom in for all of them."
        : `${last.averaged || "Every recorded point is drawn."} Drag across a plot to zoom; double click shows all.`,
  ];
  if (last.groups.some((group) => group.runs.length > 1))
    parts.push(
      "Runs that differ only in the seed: interquartile mean with its 95 % interval; below four runs, mean and range.",
    );
  if (repeated.length) parts.push(`Left out, as the same run is there: ${repeated.map(named).join(", ")}.`);
  message.textContent = [...parts, ...last.notes].join(" ");
}

function rank(metric) {
  return metric === SHARES
    ? 4
    : metric.startsWith("training.logged.")
      ? 3
      : metric.startsWith("training.")
        ? 2
        : metric.startsWith("event.")
          ? 1
          : 0;
}

const named = (id) => runs.find((run) => run.id === id)?.label ?? id;

function groupName(number) {
  const { label, runs: own } = last.groups[number];
  if (own.length === 1) return named(own[0]);
  const letters = own.map((id) => named(id).split(": ")[0]).join(", ");
  return own.length <= 5 ? `${letters}: ${label}` : `${label}, ${own.length} runs`;
}

// The series of a plot: for each curve its band, its single runs, its values (faint if they are smoothed), and
// the smoothed line. A logarithmic axis leaves out what is not positive, and is linear if nothing is.
function seriesOf(panel, state) {
  const lines = [...new Set(panel.curves.map((curve) => curve.line))];
  const logy = state.log_y && panel.curves.some((curve) => curve.values.some((value) => value > 0));
  const series = [];
  let left = 0;
  for (const curve of panel.curves) {
    const at = lines.indexOf(curve.line),
      several = last.groups.length > 1;
    const keep = curve.positions.map(
      (place, i) => !(state.log_x && place <= 0) && !(logy && curve.values[i] !== null && curve.values[i] <= 0),
    );
    left += keep.filter((kept) => !kept).length;
    const only = (values) => values.filter((_, i) => keep[i]).map((value) => (logy && value <= 0 ? null : value));
    const positions = curve.positions.filter((_, i) => keep[i]);
    const base = {
      stroke: colour(several ? curve.group : at),
      dash: DASHES[at % DASHES.length],
      width: 1.8,
      points: positions.length > 80 ? 0 : positions.length > 1 ? 4 : 9,
    };
    const add = (values, style) => series.push({ ...base, positions, values, label: "", ...style });
    if (curve.low) {
      add(only(curve.high), { width: 0, points: 0, fill: `${base.stroke}33` });
      add(only(curve.low), { width: 0, points: 0 });
    }
    curve.runs.forEach((values, i) =>
      add(only(values), {
        width: 0.7,
        points: 0,
        stroke: `${base.stroke}aa`,
        label: `${named(last.groups[curve.group].runs[i])}${curve.line && lines.length > 1 ? `, ${spoken(curve.line)}` : ""}`,
      }),
    );
    const values = only(curve.values),
      label = labelOf(curve, lines);
    if (!curve.smoothed) add(values, { label });
    else {
      add(values, { stroke: `${base.stroke}55`, width: 1, points: 0 });
      add(only(curve.smoothed), { label, points: 0 });
    }
  }
  return { series, left, logy };
}

function labelOf(curve, lines) {
  const parts = [
    last.groups.length > 1 || runs.length > 1 ? groupName(curve.group) : "",
    lines.length > 1 && curve.line ? spoken(curve.line) : "",
  ];
  return parts.filter(Boolean).join(", ") || curve.title;
}

// --- plots ----------------------------------------------------------------------------------------------

const look = () => getComputedStyle(document.documentElement);
const colour = (i) =>
  look()
    .getPropertyValue(`--line-${i % COLOURS}`)
    .trim();
const spoken = (name) => name.replaceAll("_", " ");

function button(text, act, attributes = {}) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = text;
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.addEventListener("click", act);
  return made;
}

// What a chart offers: to be pinned above the others, hidden, and downloaded, with every recorded point.
function tools(metric, { title }, isPinned) {
  const query = selection();
  query.set("metric", metric);
  const picture = document.createElement("a");
  picture.href = `/api/v1/curves.svg?${query}`;
  picture.download = `${metric}.svg`;
  picture.textContent = "SVG";
  picture.setAttribute("aria-label", `${title} as SVG`);
  return [
    button("Pin", () => remember(PINNED, metric, !isPinned), {
      "aria-pressed": isPinned,
      "aria-label": `Pin ${title}`,
    }),
    button("Hide", () => remember(HIDDEN, metric, true), { "aria-label": `Hide ${title}` }),
    picture,
    button("CSV", () => download(metric), { "aria-label": `${title} as CSV` }),
  ];
}

async function download(metric) {
  try {
    save(`${metric}.csv`, await table(metric));
  } catch (error) {
    message.textContent = error.message;
  }
}

function save(name, text) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
}

async function table(metric) {
  const query = selection();
  if (chosen().lines) query.set("lines", "true");
  query.set("metric", metric);
  for (const name of ["smooth", "log_x", "log_y"]) query.delete(name); // the values as they were recorded
  const { axis, curves } = await json(`/api/v1/curves?${query}`);
  const lines = [...new Set(curves.map((curve) => curve.line))];
  const columns = curves.flatMap((curve) => {
    const label = labelOf(curve, lines);
    const values = { [label]: curve.values, [`${label}, low`]: curve.low, [`${label}, high`]: curve.high };
    curve.runs.forEach((of, i) => (values[named(last.groups[curve.group].runs[i])] = of));
    return Object.entries(values).flatMap(([heading, of]) =>
      of ? [[heading, new Map(curve.positions.map((at, i) => [at, of[i]]))]] : [],
    );
  });
  const positions = [...new Set(curves.flatMap((curve) => curve.positions))].sort((one, other) => one - other);
  const cell = (value) =>
    typeof value === "string" ? `"${value.replaceAll('"', '""')}"` : value === null ? "" : String(value ?? "");
  const rows = [[axis, ...columns.map(([heading]) => heading)]];
  for (const at of positions) rows.push([at, ...columns.map(([, values]) => values.get(at))]);
  return rows.map((row) => `${row.map(cell).join(",")}\n`).join("");
}

function plot(metric, panel, isPinned) {
  const state = chosen(),
    { series, left, logy } = seriesOf(panel, state);
  const data = uPlot.join(series.map(({ positions, values }) => [positions, values]));
  const kinds = JSON.stringify([
    series.map(({ label, stroke, width, points }) => [label, stroke, width, points]),
    state.log_x,
    logy,
    state.axis,
    plots.clientWidth < 500,
  ]);
  let one = shown.get(metric);
  if (one && one.kinds !== kinds) {
    one.chart.destroy();
    one.chart = null;
  }
  if (!one) {
    one = { figure: document.createElement("figure") };
    one.figure.className = metric === SHARES ? "wide" : "";
    one.figure.append(...["figcaption", "div", "div", "p"].map((name) => document.createElement(name)));
    one.figure.children[2].className = "key";
    one.figure.children[3].className = "tools";
    shown.set(metric, one);
    plots.append(one.figure);
  }
  const [caption, place, key, offered] = one.figure.children,
    offer = JSON.stringify([metric, selection().toString(), isPinned]);
  if (offered.dataset.offer !== offer) {
    const focused = [...offered.children].indexOf(document.activeElement);
    offered.dataset.offer = offer;
    offered.replaceChildren(...tools(metric, panel, isPinned));
    offered.children[focused]?.focus();
  }
  const [title, unit] = [document.createElement("b"), document.createElement("span")];
  title.textContent = panel.title;
  unit.textContent = [
    panel.unit,
    panel.curves.some((curve) => curve.thinned) && "thinned",
    state.log_y && !logy && "not logarithmic: no value is positive",
    left && `${left.toLocaleString("en")} point${left > 1 ? "s" : ""} at 0 or below left out`,
    series.every(({ positions }) => positions.length === 0) && "no point in this part",
  ]
    .filter(Boolean)
    .join(", ");
  caption.replaceChildren(title, " ", unit);
  place.setAttribute("role", "img");
  const lines = [...new Set(panel.curves.map((curve) => curve.line))];
  place.setAttribute(
    "aria-label",
    `${panel.title}, ${panel.unit}: ${panel.curves.map((curve) => summary(curve, lines)).join("; ")}`,
  );
  if (one.chart) one.chart.setData(data);
  else {
    one.chart = new uPlot(options(panel, series, state, logy, place, key), data, place);
    legend(one.chart, key, series);
  }
  one.kinds = kinds;
}

// A key of all labelled lines, as they are drawn; a click hides or shows a line. While the cursor is over a plot,
// the key shows the position and the values there.
function legend(chart, key, series) {
  const labelled = series.flatMap(({ label }, i) => (label ? [i + 1] : []));
  const entries = labelled.map((number) => {
    const entry = document.createElement("button"),
      value = document.createElement("output");
    const { label, stroke, dash } = series[number - 1];
    entry.type = "button";
    entry.dataset.series = value.dataset.series = number;
    entry.append(sample(stroke, dash), label, " ", value);
    entry.setAttribute("aria-pressed", "true");
    entry.hidden = labelled.length < 2;
    entry.addEventListener("click", () => {
      const show = !chart.series[number].show;
      chart.setSeries(number, { show });
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
  const at = chart.cursor.idx,
    outputs = [...key.querySelectorAll("output")],
    position = outputs.pop();
  if (!position) return;
  const there = at !== null && at !== undefined && chart.cursor.left >= 0;
  const value = (i) =>
    there && chart.data[i][at] !== null && chart.data[i][at] !== undefined ? exact(chart.data[i][at]) : "";
  if (outputs.length > 1) for (const output of outputs) output.textContent = value(output.dataset.series);
  const alone = outputs.length === 1 && value(outputs[0].dataset.series);
  const axis = last.axes.find(({ name }) => name === last.axis);
  position.textContent = there ? `${axis.label} ${exact(chart.data[0][at])}${alone ? `: ${alone}` : ""}` : "";
}

const exact = (value) => Number(value.toPrecision(6)).toLocaleString("en", { maximumFractionDigits: 6 });

function tick(value) {
  if (value === null) return "";
  const size = Math.abs(value),
    units = [
      [1e12, "T"],
      [1e9, "G"],
      [1e6, "M"],
      [1e4, "k"],
    ];
  if (size >= 1e15 || (size > 0 && size < 1e-4)) return value.toExponential(0);
  const [, unit] = units.find(([least]) => size >= least) ?? [1, ""];
  const shown = unit === "k" ? value / 1e3 : unit ? value / units.find(([, name]) => name === unit)[0] : value;
  return Number(shown.toPrecision(6)).toLocaleString("en", { maximumFractionDigits: 6 }) + unit;
}

function summary(curve, lines) {
  const known = curve.values.filter((value) => value !== null),
    end = known.at(-1);
  if (end === undefined) return `${labelOf(curve, lines)} has no point in this part`;
  const short = (number) => Number(number.toPrecision(4));
  const range = `between ${short(Math.min(...known))} and ${short(Math.max(...known))}`;
  return `${labelOf(curve, lines)} ends at ${short(end)}, ${range}`;
}

function options(panel, series, state, logy, place, key) {
  const percent = panel.unit.startsWith("percent"),
    positive = series.every(({ values }) => values.every((value) => value === null || value >= 0));
  const axis = {
    stroke: look().getPropertyValue("--soft").trim(),
    grid: { stroke: look().getPropertyValue("--line").trim(), width: 1 },
    ticks: { show: false },
    font: "12px system-ui, sans-serif",
    values: (_, ticks) => ticks.map(tick),
  };
  const scale = (log, range) => ({
    distr: log ? 3 : 1,
    range: (_, low, high) =>
      log ? uPlot.rangeLog(low > 0 ? low : 0.1, high > 0 ? high : 1, 10, false) : range(low, high),
  });
  const lines = series.map(({ label, stroke, dash, width, points }) => ({
    label,
    stroke,
    dash,
    width,
    spanGaps: true,
    points: { show: points > 0, size: points },
  }));
  return {
    width: place.clientWidth,
    height: 216,
    padding: [8, 22, 0, 0],
    scales: {
      x: { time: false, ...scale(state.log_x, (low, high) => [state.from ?? low ?? 0, state.to ?? high ?? 1]) },
      y: scale(logy, (low, high) => bounds(low, high, percent, positive)),
    },
    series: [{}, ...lines],
    bands: series.flatMap(({ fill }, i) => (fill ? [{ series: [i + 1, i + 2], fill }] : [])),
    axes: [
      {
        ...axis,
        size: 28,
        label: last.axes.find(({ name }) => name === last.axis).label,
        labelSize: 18,
        labelGap: 0,
        labelFont: axis.font,
      },
      { ...axis, size: (_, values) => 18 + 7.2 * Math.max(3, ...(values ?? []).map((text) => text.length)) },
    ],
    legend: { show: false },
    cursor: { drag: { x: true, y: false, setScale: false }, sync: { key: "metrics", setSeries: false } },
    hooks: { setSelect: [zoom], setCursor: [(chart) => readOut(chart, key)] },
  };
}

function bounds(low, high, percent, positive) {
  if (percent && high <= 100 && low >= 0) return [0, 100];
  if (low === null || (low === 0 && high === 0)) return [0, 1];
  const from = positive ? 0 : low - 0.05 * (high - low || 1);
  return [from, high + 0.05 * (high - from || 1)];
}

// --- events ---------------------------------------------------------------------------------------------

function go(from, to) {
  const end = (value, round) => (value === null || chosen().axis === "time" ? value : round(value));
  change({ from: end(from, Math.floor), to: end(to, Math.ceil) });
  draw();
}

function zoom(chart) {
  const { left, width } = chart.select;
  if (width < 4) return;
  go(Math.max(0, chart.posToVal(left, "x")), chart.posToVal(left + width, "x"));
  chart.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  const end = (name) => (fields[name].value === "" ? null : Number(fields[name].value));
  go(end("from"), end("to"));
});
fields.axis.addEventListener("change", () => {
  change({ axis: fields.axis.value, from: null, to: null });
  draw();
  document.dispatchEvent(new Event("axischange"));
});
fields.logged.addEventListener("change", () => {
  change({ logged: fields.logged.value });
  draw();
});
fields.lines.addEventListener("change", () => {
  change({ lines: fields.lines.checked });
  draw();
});
for (const name of ["log_x", "log_y"])
  fields[name].addEventListener("change", () => {
    change({ [name]: fields[name].checked });
    if (last) show();
  });
let sliding = 0;
fields.smooth.addEventListener("input", () => {
  change({ smooth: Number(fields.smooth.value) }, false);
  clearTimeout(sliding);
  sliding = setTimeout(draw, 150);
});
box.querySelector("[data-reset]").addEventListener("click", () => go(null, null));
plots.addEventListener("dblclick", () => go(null, null));
addEventListener("popstate", () => {
  fill(chosen());
  draw();
});

let width = plots.clientWidth;
new ResizeObserver(() => {
  if (plots.clientWidth === width) return;
  width = plots.clientWidth;
  for (const { chart, figure } of shown.values())
    chart?.setSize({ width: figure.children[1].clientWidth, height: 216 });
}).observe(plots);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  if (last) show();
});

fill(chosen());
await draw();
if (document.querySelector("[data-live]"))
  setInterval(() => {
    if (!document.hidden) draw();
  }, 4000);
