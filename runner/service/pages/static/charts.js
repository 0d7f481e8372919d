// Metrics of one or several runs over an axis; runs that differ in nothing but the seed are one line with a band.
// Of a long curve the server returns the lowest and the highest value of each stretch, with a notice; zooming in
// requests that part at full resolution. It also leaves out what logarithmic axes cannot show.
import { json } from "./page.js";

const box = document.querySelector("[data-charts]");
const selectors = ["form", "template", "[data-plots]", "[data-hidden]", "[role=status]"];
const [form, template, plots, restore, message] = selectors.map((selector) => box.querySelector(selector));
const fields = form.elements;
const USUAL = { axis: "episodes", smooth: "0" };
const COLOURS = 7; // of lines, in the style
const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3]];
const HEIGHT = 216;
const HIDDEN = "charts hidden",
  PINNED = "charts pinned"; // names of metrics, which this browser keeps
const shown = new Map(); // what is drawn of a metric
let requests = 0,
  last = null; // what was received

// --- what is chosen: in the form, and in the address without what is usual ------------------------------

const chosen = () => Object.fromEntries(new FormData(form));

function fill() {
  const query = new URLSearchParams(location.search);
  for (const field of form.querySelectorAll("input, select")) {
    const value = query.get(field.name) ?? USUAL[field.name] ?? "";
    if (field.type === "checkbox") field.checked = value;
    else field.value = value;
    if (field === fields.axis && field.value !== value) field.add(new Option(value, value, true, true));
  }
  draw();
}

// Add values to a query, except for empty and usual ones.
function add(query, values) {
  for (const [name, value] of Object.entries(values)) if (value && value !== USUAL[name]) query.set(name, value);
  return query;
}

function change(values, keep = true) {
  for (const [name, value] of Object.entries(values)) fields[name].value = value ?? "";
  const query = new URLSearchParams(location.search);
  for (const { name } of fields) query.delete(name);
  add(query, chosen());
  history[keep ? "pushState" : "replaceState"](null, "", query.size ? `?${query}` : location.pathname);
}

function remembered(kind) {
  try {
    return new Set(JSON.parse(localStorage.getItem(kind)));
  } catch {
    return new Set(); // the browser keeps nothing for pages, or something else was there
  }
}

function remember(kind, metric) {
  const metrics = remembered(kind);
  if (!metrics.delete(metric)) metrics.add(metric);
  try {
    localStorage.setItem(kind, JSON.stringify([...metrics]));
    show();
  } catch (error) {
    complain(`The browser does not let pages keep anything: ${error.message}`);
  }
}

// Notes stand below the charts, so these stay where they are; an error stands above.
function complain(text) {
  message.textContent = text;
  plots.prepend(message);
}

// --- data -----------------------------------------------------------------------------------------------

// Return the query for curves of the runs over the axis.
function queryOf(values) {
  const axis = new URLSearchParams(location.search).get("axis") ?? USUAL.axis;
  return add(new URLSearchParams([["axis", axis], ...new URLSearchParams(box.dataset.charts)]), values);
}

async function draw() {
  const mine = ++requests,
    { axis, from, to, logged, ...values } = chosen();
  fields.smoothed.value = Number(values.smooth) ? `${values.smooth} % of the axis` : "none";
  const query = queryOf({
    ...values,
    points: Math.max(400, Math.round(plots.clientWidth)),
    start: from,
    stop: to && (axis === "time" ? to : Number(to) + 1),
    metric: logged && `training.logged.${logged}`,
  });
  box.setAttribute("aria-busy", "true");
  try {
    const found = await json(`/api/v1/curves?${query}`);
    if (mine !== requests) return;
    last = found;
    const axes = found.axes.map(({ name, label }) => new Option(label, name, false, name === found.axis));
    fields.axis.replaceChildren(...axes);
    fields.logged.list.replaceChildren(...found.names.map((name) => new Option(name)));
    fields.logged.parentElement.hidden = found.names.length < 2;
    fields.lines.parentElement.hidden = found.groups.every((group) => group.runs.length < 2);
    for (const [i, group] of found.groups.entries())
      for (const id of group.runs) // the swatches of the runs above
        document.querySelector(`[data-run="${id}"]`)?.setAttribute("class", `swatch line-${i % COLOURS}`);
    show();
  } catch (error) {
    complain(error.message);
  }
  box.removeAttribute("aria-busy");
}

function show() {
  const metrics = Object.groupBy(last.curves, ({ metric }) => metric),
    hidden = remembered(HIDDEN),
    pinned = remembered(PINNED);
  const names = Object.keys(metrics).sort((one, other) => pinned.has(other) - pinned.has(one)), // pinned ones first
    left = names.filter((name) => hidden.has(name)),
    ranked = names.filter((name) => !hidden.has(name));
  for (const metric of ranked) plot(metric, metrics[metric], pinned.has(metric));
  const order = [...ranked.map((metric) => shown.get(metric).figure), message];
  if (order.some((node, i) => plots.children[i] !== node)) plots.replaceChildren(...order);
  for (const [metric, one] of shown)
    if (!ranked.includes(metric)) {
      one.chart.destroy();
      shown.delete(metric);
    }
  restore.hidden = !left.length;
  restore.replaceChildren("Hidden, click to show: ");
  for (const metric of left) {
    const button = restore.appendChild(document.createElement("button"));
    button.type = "button";
    button.textContent = metrics[metric][0].title;
    button.onclick = () => remember(HIDDEN, metric);
  }
  message.textContent = last.notes.join(" ");
}

// --- numbers --------------------------------------------------------------------------------------------

const exact = (value) => value?.toLocaleString("en", { maximumSignificantDigits: 6 }) ?? "";
const axisLabel = () => last.axes.find(({ name }) => name === last.axis).label;

function tick(value) {
  if (value === null) return "";
  const size = Math.abs(value);
  if (size >= 1e15 || (size > 0 && size < 1e-4)) return value.toExponential(0);
  const notation = size < 1e4 ? "standard" : "compact";
  return value.toLocaleString("en", { notation, maximumSignificantDigits: 6 }).replace("K", "k"); // as the server writes it
}

// --- plots ----------------------------------------------------------------------------------------------

const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// The series of curves: of each its band, its single runs, its values (faint if they are smoothed), and the smoothed
// line. Those with labels are in the key.
function seriesOf(curves) {
  return curves.flatMap((curve) => {
    const { label, colour, dash } = curve,
      stroke = style(`--line-${colour % COLOURS}`),
      size = curve.positions.length > 80 ? 0 : curve.positions.length > 1 ? 4 : 9,
      base = { stroke, dash: DASHES[dash % DASHES.length], width: 1.8, spanGaps: true, points: { show: false } },
      values = curve.smoothed ? { stroke: `${stroke}55`, width: 1 } : { label, points: { show: size > 0, size } };
    const drawn = [
      [curve.high, { width: 0, band: `${stroke}33` }],
      [curve.low, { width: 0 }],
      ...curve.runs.map((run, i) => [run, { width: 0.7, stroke: `${stroke}aa`, label: curve.run_labels[i] }]),
      [curve.values, values],
      [curve.smoothed, { label }],
    ];
    return drawn
      .filter(([values]) => values)
      .map(([values, look]) => ({ look: { ...base, ...look }, points: [curve.positions, values] }));
  });
}

function plot(metric, curves, isPinned) {
  const { smooth, lines, log_x, log_y } = chosen(),
    { title, unit } = curves[0],
    series = seriesOf(curves),
    looks = series.map(({ look }) => look),
    points = uPlot.join(series.map(({ points }) => points)),
    logX = log_x && points[0].length > 0,
    logY = log_y && points.slice(1).some((values) => values.some((value) => value > 0));
  const one = shown.get(metric) ?? figureOf(metric, title);
  const { caption, place, key, picture, table, pin } = one,
    kinds = JSON.stringify([looks, logX, logY, last.axis, plots.clientWidth < 500]);
  pin.setAttribute("aria-pressed", isPinned);
  picture.href = `/api/v1/curves.svg?${queryOf({ metric, smooth, log_x, log_y })}`;
  table.href = `/api/v1/curves.csv?${queryOf({ metric, lines })}`;
  const parts = [unit, curves.some((curve) => curve.thinned) && "thinned", !points[0].length && "no point in this part"];
  caption.textContent = parts.filter(Boolean).join(", ");
  place.setAttribute("aria-label", `${title}, ${unit}: ${curves.map(({ summary }) => summary).join("; ")}`);
  if (one.kinds === kinds) return one.chart.setData(points);
  one.chart?.destroy();
  one.kinds = kinds;
  one.chart = new uPlot(options(unit, looks, logX, logY, one), points, place);
  legend(one.chart, key, looks);
}

function figureOf(metric, title) {
  const figure = template.content.firstElementChild.cloneNode(true),
    [heading, place, key, tools] = figure.children,
    [name, caption] = heading.children,
    [pin, hide, picture, table] = tools.children;
  for (const tool of tools.children) tool.setAttribute("aria-label", `${tool.textContent}: ${title}`);
  pin.onclick = () => remember(PINNED, metric);
  hide.onclick = () => remember(HIDDEN, metric);
  picture.download = `${metric}.svg`;
  table.download = `${metric}.csv`;
  figure.classList.toggle("wide", metric === "training.reward");
  name.textContent = title;
  const one = { figure, caption, place, key, picture, table, pin };
  shown.set(metric, one);
  plots.append(figure);
  return one;
}

// A key of all labelled lines, as they are drawn; a click hides or shows a line.
function legend(chart, key, looks) {
  const [entry, position] = template.content.lastElementChild.children,
    labelled = looks.flatMap((look, i) => (look.label ? [[look, i + 1]] : []));
  const entries = labelled.map(([{ label, stroke, dash }, number]) => {
    const button = entry.cloneNode(true),
      line = button.querySelector("line");
    line.setAttribute("stroke", stroke);
    line.setAttribute("stroke-dasharray", dash.join(" "));
    button.querySelector("span").textContent = label;
    button.querySelector("output").dataset.series = number;
    button.hidden = labelled.length < 2;
    button.onclick = () => {
      const show = !chart.series[number].show;
      chart.setSeries(number, { show });
      button.setAttribute("aria-pressed", show);
    };
    return button;
  });
  key.replaceChildren(...entries, position.cloneNode());
}

// While the cursor is over a plot, its key shows the position and the values there.
function readOut(chart, key) {
  const value = (series) => exact(chart.data[series][chart.cursor.idx]),
    outputs = [...key.querySelectorAll("output")],
    position = outputs.pop();
  for (const output of outputs) output.textContent = value(output.dataset.series);
  const alone = outputs.length === 1 && outputs[0].textContent,
    at = value(0);
  if (position) position.textContent = at && `${axisLabel()} ${at}${alone ? `: ${alone}` : ""}`;
}

function options(unit, series, logX, logY, { place, key }) {
  const axis = {
    stroke: style("--soft"),
    grid: { stroke: style("--line"), width: 1 },
    ticks: { show: false },
    font: "12px system-ui, sans-serif",
    values: (_, ticks) => ticks.map(tick),
  };
  // To the only position where there is one: uPlot proposes an axis to twice that.
  const across = ({ data: [positions] }, low, high) => {
    const [start, end] = positions.length > 1 ? [low, high] : [0, positions[0] || 1];
    return [Number(fields.from.value || start), Number(fields.to.value || end)];
  };
  const whole = unit.startsWith("percent") ? 100 : null,
    ends = { min: { pad: 0.05, soft: 0, mode: 1 }, max: { pad: 0.05, soft: whole, mode: 1 } };
  const up = (_, low, high) => (low || high ? uPlot.rangeNum(Math.min(0, low), high, ends) : [0, whole ?? 1]);
  return {
    width: place.clientWidth,
    height: HEIGHT,
    padding: [8, 22, 0, 0],
    scales: {
      x: logX ? { time: false, distr: 3 } : { time: false, range: across },
      y: logY ? { distr: 3 } : { range: up },
    },
    series: [{}, ...series],
    bands: series.flatMap(({ band }, i) => (band ? [{ series: [i + 1, i + 2], fill: band }] : [])),
    axes: [
      { ...axis, size: 28, label: axisLabel(), labelSize: 18, labelGap: 0, labelFont: axis.font },
      { ...axis, size: (_, ticks) => 18 + 7.2 * Math.max(3, ...(ticks ?? []).map((text) => text.length)) },
    ],
    legend: { show: false },
    cursor: {
      drag: { x: true, y: false, setScale: false },
      // The plots share the position of the cursor; a drag zooms once.
      sync: { key: "metrics", setSeries: false, filters: { pub: (type) => !["mousedown", "mouseup"].includes(type) } },
    },
    hooks: { setSelect: [zoom], setCursor: [(chart) => readOut(chart, key)] },
  };
}

// --- events ---------------------------------------------------------------------------------------------

function go(values) {
  change(values);
  draw();
}

const showAll = () => go({ from: "", to: "" });

function zoom(chart) {
  const { left, width } = chart.select,
    round = fields.axis.value === "time" ? [Number, Number] : [Math.floor, Math.ceil];
  if (width < 4) return;
  const [from, to] = [left, left + width].map((at, i) => round[i](chart.posToVal(at, "x")));
  go({ from: Math.max(0, from), to });
  chart.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  go({});
});
let sliding = 0;
form.addEventListener("input", ({ target }) => {
  if (target !== fields.smooth) return;
  change({}, false);
  clearTimeout(sliding);
  sliding = setTimeout(draw, 150);
});
form.addEventListener("change", ({ target: { name } }) => {
  if (["from", "to", "smooth"].includes(name)) return;
  if (name === "axis") showAll();
  else go({});
});
box.querySelector("[data-reset]").addEventListener("click", showAll);
plots.addEventListener("dblclick", showAll);
addEventListener("popstate", fill);

new ResizeObserver(() => {
  for (const { chart, place } of shown.values())
    if (chart.width !== place.clientWidth) chart.setSize({ width: place.clientWidth, height: HEIGHT });
}).observe(plots);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  if (last) show();
});

fill();
if (document.querySelector("[data-live]"))
  setInterval(() => {
    if (!document.hidden) draw();
  }, 4000);
