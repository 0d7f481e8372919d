"use strict";

// Make an element with attributes and content; null is no content.
function make(tag, attributes, ...content) {
  const isDrawn = ["svg", "path", "line"].includes(tag);
  const element = document.createElementNS(`http://www.w3.org/${isDrawn ? "2000/svg" : "1999/xhtml"}`, tag);
  for (const [name, value] of Object.entries(attributes ?? {})) element.setAttribute(name, value);
  element.append(...content.flat().filter((part) => part !== null));
  return element;
}

// A slider over steps, and a button that plays; `shown(k)` shows a step.
class Scrubber {
  constructor(box, what, shown) {
    Object.assign(this, { what, shown, k: 0, length: 0, pace: 350, timer: null });
    [this.slider, this.button, this.count] = ["input", "button", "output"].map((tag) => box.querySelector(tag));
    this.slider.addEventListener("input", () => this.go(Number(this.slider.value)));
    this.slider.addEventListener("keydown", (event) => this.key(event));
    this.button.addEventListener("click", () => this.play());
    this.pause();
  }

  show(k) {
    this.k = Math.min(this.length, Math.max(0, k));
    this.slider.max = this.length;
    this.slider.value = this.k;
    this.count.textContent = `step ${this.k} of ${this.length}`;
    this.slider.setAttribute("aria-valuetext", this.count.textContent);
    return this.shown(this.k);
  }

  go(k) {
    this.pause();
    this.show(k);
  }

  pause() {
    clearInterval(this.timer);
    this.timer = null;
    this.label("\u25b6", "Play");
  }

  play() {
    if (this.timer) return this.pause();
    if (this.k === this.length) this.show(0);
    this.label("\u275a\u275a", "Pause");
    this.timer = setInterval(() => (this.k < this.length ? this.show(this.k + 1) : this.pause()), this.pace);
  }

  label(text, act) {
    this.button.textContent = text;
    this.button.setAttribute("aria-label", `${act} ${this.what}`.trim());
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const by = { ArrowLeft: -1, ArrowRight: 1, PageUp: -10, PageDown: 10, Home: -Infinity, End: Infinity }[event.key];
    if (event.key === " ") this.play();
    else if (by) this.go(this.k + by);
    else return;
    event.preventDefault();
  }
}

// A replay: the picture, the values and the facts of the frame at the slider.
//
// Frame k of an episode is the state after k steps. The episode may be a part of one: the frames from `first` on,
// with the sums of the rewards before them; `load` returns the part with another frame. `pictures(k, show)` calls
// `show` with the address of a picture, or with an empty one and a message, as often as it knows better.
class Replay {
  constructor(root, { load = null, moved = () => {}, pictures = null } = {}) {
    Object.assign(this, { root, load, moved, pictures });
    this.bar = new Scrubber(this.find(".scrub"), "", (k) => this.show(k));
    this.image = this.find(".frame");
    this.image?.addEventListener("load", () => this.image.classList.toggle("coarse", this.image.naturalWidth < 300));
  }

  find(selector) {
    return this.root.querySelector(selector);
  }

  begin(episode, k = 0) {
    this.bar.pause();
    this.take(episode);
    this.find(".description").textContent = episode.description;
    return this.bar.show(k);
  }

  close() {
    this.bar.pause();
    this.pictures?.close();
  }

  take(episode) {
    Object.assign(this, { episode, first: episode.first ?? 0 });
    this.bar.length = episode.length ?? episode.reward.length;
    this.bar.pace = episode.grid ? 350 : 80;
    const agents = [...new Set([...episode.actions, ...episode.texts, ...episode.series].map(({ agent }) => agent))];
    this.owners = agents.some(Boolean) ? agents.filter(Boolean) : agents;
    this.columns = this.owners.map((agent) => this.column(agent));
    const values = this.find(".values"),
      notes = episode.notes.map((note) => `${note[0].toUpperCase()}${note.slice(1)}.`).join(" ");
    if (this.owners.length > 1) this.find(".stage, .step-facts").after(values);
    values.classList.toggle("several", this.owners.length > 1);
    this.table = !episode.grid && !episode.series.length && episode.texts.length ? make("table", { class: "steps" }) : null;
    const parts = [notes && make("p", { class: "hint" }, notes), this.table];
    values.replaceChildren(...this.columns.map(({ box }) => box), ...parts.filter(Boolean));
  }

  // The values of an agent, or of all together: a line for each number, over the frames that are loaded.
  column(agent) {
    const facts = make("dl"),
      box = make("section", {}, agent ? [make("h3", {}, spaced(agent)), facts] : []),
      rows = [];
    let heading = null;
    for (const { name, kind, values } of this.episode.series.filter((series) => series.agent === agent)) {
      if (kind !== heading) box.append(make(agent ? "h4" : "h3", {}, (heading = kind)));
      const numbers = values.filter(isNumber),
        [low, high] = [Math.min(...numbers), Math.max(...numbers)],
        height = (value) => (high > low ? 1 - (value - low) / (high - low) : 0.5).toFixed(4);
      const points = values.map((value, i) => {
        if (!isNumber(value)) return ""; // lines are broken where a value is unknown
        return isNumber(values[i - 1]) ? `L${i} ${height(value)}` : `M${i} ${height(value)}h.01`;
      });
      const value = make("b"),
        cursor = make("line", { y1: -0.06, y2: 1.06, class: "cursor" }),
        look = { viewBox: `0 -.06 ${Math.max(1, values.length - 1)} 1.12`, preserveAspectRatio: "none", "aria-hidden": true },
        chart = make("svg", look, make("path", { d: points.join("") }), cursor),
        title = numbers.length ? `${name}: ${low} to ${high} in the steps loaded` : name;
      box.append(make("div", { class: "series", title }, make("span", {}, name), chart, value));
      rows.push({ values, cursor, value });
    }
    return { agent, box, facts, rows };
  }

  async show(k) {
    this.pictures?.(k, (address, message) => this.bar.k === k && this.picture(address, message));
    if (k < this.first || k > this.first + this.episode.reward.length) {
      const loaded = await this.load(k);
      if (this.bar.k !== k) return;
      this.take(loaded);
    }
    const i = k - this.first;
    if (this.episode.grid) this.draw(i);
    this.describe(i);
    this.near(i);
    if (this.table) this.list(i);
    this.choices(i);
    this.moved(this.bar);
  }

  picture(address, message = "") {
    const note = this.find(".frame-note");
    note.textContent = message;
    note.hidden = !message;
    if (!this.image) return;
    if (address && this.image.getAttribute("src") !== address) this.image.src = address;
    this.image.hidden = !this.image.getAttribute("src");
    this.image.alt = `The environment after ${this.bar.k} of ${this.bar.length} steps`;
  }

  draw(i) {
    const { grid, trail } = this.episode;
    const place = (j, thing) => grid.places[grid.at[j]].slice(3 * thing, 3 * thing + 3);
    for (const thing of this.root.querySelectorAll("[data-thing]")) {
      const [x, y, percent] = place(i, Number(thing.dataset.thing));
      thing.setAttribute("transform", `translate(${x} ${y}) scale(${percent / 100})`);
    }
    for (const line of this.root.querySelectorAll("[data-trail]")) {
      const points = [];
      for (let j = Math.max(0, i + 1 - trail); j <= i; j++)
        points.push(place(j, Number(line.dataset.trail)).slice(0, 2).join(","));
      line.setAttribute("points", points.join(" "));
    }
  }

  describe(i) {
    const { texts, facts, end } = this.episode,
      list = make("dl");
    for (const column of this.columns) {
      const own = [...texts, ...facts].filter((fact) => fact.agent === column.agent && fact.values[fact.at[i]]);
      const to = this.owners.length < 2 ? list : column.facts;
      to.replaceChildren(...own.flatMap(({ name, values, at }) => this.fact(name, values[at[i]])));
      for (const { values, cursor, value } of column.rows) {
        cursor.setAttribute("x1", i);
        cursor.setAttribute("x2", i);
        value.textContent = values[i] ?? "unknown";
      }
    }
    if (this.bar.k === this.bar.length) list.append(...this.fact("end", end));
    this.find(".caption").replaceChildren(list);
  }

  fact(name, text) {
    const isTagged = name === "events" && text !== "none",
      content = isTagged ? text.split(", ").map((event) => make("span", { class: "tag" }, event)) : text;
    return [make("dt", {}, name[0].toUpperCase() + name.slice(1)), make("dd", {}, content)];
  }

  // The value logged last under each name up to this frame; of names that were logged only later, the next one.
  near(i) {
    const { logged, time } = this.episode,
      now = time[i],
      box = this.find(".logged");
    const rows = logged.map(({ name, at, values }) => {
      const j = Math.max(0, at.findLastIndex((step) => step <= now)),
        far = Math.abs(at[j] - now);
      const steps = `${far.toLocaleString("en")} ${far === 1 ? "step" : "steps"} ${at[j] > now ? "later" : "before"}`,
        when = far ? steps : this.first + i ? "now" : "before the first step";
      return rowOf("td", [name, values[j], when]);
    });
    box.hidden = !rows.length;
    box.replaceChildren(make("table", {}, make("caption", {}, "Logged near this step"), make("tbody", {}, rows)));
  }

  // Where there is nothing but texts: the steps around this one.
  list(i) {
    const { actions, reward, texts } = this.episode,
      named = ({ agent, name }) => `${agent} ${name}`.trim(),
      text = ({ values, at }, j) => values[at[j]] ?? "",
      rows = [];
    for (let j = Math.max(0, i - 6); j <= Math.min(reward.length, i + 6); j++) {
      const taken = [...actions.map((words) => (j ? text(words, j - 1) : "")), j ? reward[j - 1].join(", ") : ""];
      rows.push(rowOf("td", [this.first + j, ...taken, ...texts.map((words) => text(words, j))], j === i ? "now" : ""));
    }
    const head = rowOf("th", ["step", ...actions.map(named), "reward", ...texts.map(named)]);
    this.table.replaceChildren(make("thead", {}, head), make("tbody", {}, rows));
  }

  choices(i) {
    const { episode } = this;
    const parts = episode.values.map((table, learner) => (i < table.row.length ? this.ranking(table, learner, i) : ""));
    if (this.bar.k === this.bar.length) parts.push(make("p", {}, "The last step shown."));
    else if (!episode.values.length) {
      const next = ({ agent, values, at }) => `${agent ? `${spaced(agent)}: ` : ""}${values[at[i]]}`;
      parts.push(make("p", {}, `Next action: ${episode.actions.map(next).join(", ")}`));
    }
    this.find(".choice").replaceChildren(...parts);
  }

  // The Q-values of a learner before the step; on a server's page with links to where they come from.
  ranking(table, learner, i) {
    const { agents, choices } = this.episode,
      { why } = this.root.dataset,
      rows = table.rows[table.row[i]],
      values = rows.map(([, value]) => value),
      [low, high] = [Math.min(...values), Math.max(...values)],
      names = choices[choices.length > 1 ? learner : 0],
      most = rows.length < table.of ? `${rows.length} of ${table.of} actions; ` : "",
      hint = make("small", {}, `(${most}bars from the lowest here to the highest)`);
    const bars = rows.map(([action, value]) => {
      const isTaken = action === table.taken[i],
        query = new URLSearchParams({ action, ...(choices.length > 1 ? { agent: agents[learner] } : {}) }),
        number = make("b", {}, String(value)),
        href = `${why}:${this.bar.k}&${query}`,
        fill = make("i");
      fill.style.width = `${high > low ? 4 + (96 * (value - low)) / (high - low) : 4}%`;
      const name = make("span", {}, (isTaken ? "\u25b8 " : "") + names[action]),
        shown = why ? make("a", { href, title: "Why is it this value?" }, number) : number;
      return make("li", isTaken ? { class: "taken" } : {}, name, make("span", {}, fill), shown);
    });
    const who = agents.length > 1 ? agents[learner] : "Next action";
    return make("div", {}, make("h3", {}, `${who}: Q-values here `, hint), make("ol", {}, bars));
  }
}

// A row with a heading; the first row of a table has only headings.
const rowOf = (tag, [name, ...cells], kind = "") =>
    make("tr", { class: kind }, make("th", { scope: tag === "td" ? "row" : "col" }, name), cells.map((cell) => make(tag, {}, cell))),
  isNumber = (value) => typeof value === "number",
  spaced = (name) => name.replaceAll("_", " ");

// A report contains its episodes, with their pictures.
for (const root of document.querySelectorAll("[data-replay]")) {
  const episodes = JSON.parse(document.getElementById(root.dataset.replay).textContent),
    choose = root.querySelector(".episode"),
    chosen = () => episodes[choose.value];
  const pictures = (k, show) => {
    const { pictures: addresses, picture, picture_note: note } = chosen(),
      isMade = k < picture.length && addresses.length && picture[k] < addresses.length - 1;
    show(addresses[picture[k]] ?? "", isMade ? "" : note);
  };
  const replay = new Replay(root, { pictures });
  choose.addEventListener("change", () => replay.begin(chosen()));
  replay.begin(chosen());
}
