"use strict";
// A replay: the picture, the values and the facts of the frame at the slider.
//
// Frame k of an episode is the state after k steps. The episode may be a part of one: the frames from `first` on,
// with the sums of the rewards before them; `load` returns the part with another frame. `pictures(k, show)` calls
// `show` with the address of a picture, or with an empty one and a message, as often as it knows better.
class Replay {
  constructor(root, { load = null, moved = () => {}, pictures = null } = {}) {
    Object.assign(this, { root, load, moved, pictures, episode: null, timer: null, k: 0, pace: 350 });
    this.slider = this.find(".step");
    this.button = this.find(".play");
    this.image = this.find(".frame");
    this.things = [...root.querySelectorAll("[data-thing]")];
    this.trails = [...root.querySelectorAll("[data-trail]")];
    this.slider.addEventListener("input", () => {
      this.pause();
      this.show(Number(this.slider.value));
    });
    this.slider.addEventListener("keydown", (event) => this.key(event));
    this.button.addEventListener("click", () => this.play());
    this.image?.addEventListener("load", () => this.image.classList.toggle("coarse", this.image.naturalWidth < 300));
  }

  find(selector) {
    return this.root.querySelector(selector);
  }

  get length() {
    return this.episode.length ?? this.episode.reward.length;
  }

  begin(episode, k = 0) {
    this.pause();
    this.take(episode);
    this.slider.max = this.length;
    this.find(".description").textContent = episode.description;
    return this.show(k);
  }

  take(episode) {
    this.episode = episode;
    this.pace = episode.grid ? 350 : 80;
    const low = (values) => values.filter((value) => typeof value === "number");
    const lines = episode.series.map((series) => {
      const numbers = low(series.values);
      return { ...series, low: Math.min(...numbers), high: Math.max(...numbers) };
    });
    const owners = [...new Set([...episode.actions, ...episode.texts, ...lines].map((one) => one.agent))];
    this.owners = owners.some(Boolean) ? owners.filter(Boolean) : owners;
    this.columns = this.owners.map((agent) =>
      this.column(
        agent,
        lines.filter((one) => one.agent === agent),
      ),
    );
    const values = this.find(".values");
    if (this.owners.length > 1) this.find(".stage, .step-facts").after(values);
    values.classList.toggle("several", this.owners.length > 1);
    values.replaceChildren(...this.columns.map((column) => column.box));
    const notes = episode.notes.map((note) => `${note[0].toUpperCase()}${note.slice(1)}.`).join(" ");
    if (notes) values.append(Replay.make("p", notes, "hint"));
    this.table =
      !episode.grid && !lines.length && episode.texts.length ? Replay.make("table", undefined, "steps") : null;
    if (this.table) values.append(this.table);
  }

  // The values of an agent, or of all together: a line for each number, over the frames that are loaded.
  column(agent, lines) {
    const box = Replay.make("section"),
      facts = Replay.make("dl");
    if (agent) box.append(Replay.make("h3", agent.replaceAll("_", " ")), facts);
    let kind = null;
    const rows = lines.map((line) => {
      if (line.kind !== kind) box.append(Replay.make(agent ? "h4" : "h3", line.kind));
      kind = line.kind;
      const row = Replay.make("div", undefined, "series"),
        value = Replay.make("b");
      const [chart, cursor] = this.chart(line);
      row.title = Number.isFinite(line.low)
        ? `${line.name}: ${line.low} to ${line.high} in the steps loaded`
        : line.name;
      row.append(Replay.make("span", line.name), chart, value);
      box.append(row);
      return { line, cursor, value };
    });
    return { agent, box, facts, rows };
  }

  chart({ values, low, high }) {
    const draw = (tag, attributes) => {
      const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
      for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
      return element;
    };
    const width = Math.max(1, values.length - 1),
      range = high > low ? high - low : 1;
    const runs = [[]]; // lines are broken where a value is unknown
    values.forEach((value, i) => {
      if (typeof value === "number")
        runs.at(-1).push(`${i} ${(high > low ? 1 - (value - low) / range : 0.5).toFixed(4)}`);
      else if (runs.at(-1).length) runs.push([]);
    });
    const chart = draw("svg", { viewBox: `0 -.06 ${width} 1.12`, preserveAspectRatio: "none", "aria-hidden": "true" });
    const path = runs
      .filter((run) => run.length)
      .map((run) => `M${run.length > 1 ? run.join("L") : `${run[0]}l.01 0`}`)
      .join("");
    const cursor = draw("line", { y1: -0.06, y2: 1.06, class: "cursor" });
    chart.append(draw("path", { d: path }), cursor);
    return [chart, cursor];
  }

  holds(k) {
    const first = this.episode.first ?? 0;
    return k >= first && k <= first + this.episode.reward.length;
  }

  async show(k) {
    this.k = k = Math.min(this.length, Math.max(0, k));
    const count = `step ${k} of ${this.length}`;
    this.slider.value = k;
    this.slider.setAttribute("aria-valuetext", count);
    this.find(".count").textContent = count;
    if (this.pictures) this.pictures(k, (address, message) => this.k === k && this.picture(address, message));
    if (!this.holds(k)) {
      const loaded = await this.load(k);
      if (this.k !== k) return;
      this.take(loaded);
    }
    const i = k - (this.episode.first ?? 0);
    if (this.episode.grid) this.draw(i);
    this.describe(i);
    this.move(i);
    this.near(i);
    if (this.table) this.list(i);
    this.choices(i);
    this.moved(k);
  }

  picture(address, message = "") {
    const note = this.find(".frame-note");
    note.textContent = message;
    note.hidden = !message;
    if (!this.image) return;
    if (address && this.image.getAttribute("src") !== address) this.image.src = address;
    this.image.hidden = !this.image.getAttribute("src");
    this.image.alt = `The environment after ${this.k} of ${this.length} steps`;
  }

  place(i, thing) {
    const { grid } = this.episode;
    return grid.places[grid.at[i]].slice(3 * thing, 3 * thing + 3);
  }

  draw(i) {
    for (const thing of this.things) {
      const [x, y, percent] = this.place(i, Number(thing.dataset.thing));
      thing.setAttribute("transform", `translate(${x} ${y}) scale(${percent / 100})`);
    }
    const from = Math.max(0, i + 1 - this.episode.trail);
    for (const trail of this.trails) {
      const points = [];
      for (let j = from; j <= i; j++) points.push(this.place(j, Number(trail.dataset.trail)).slice(0, 2).join(","));
      trail.setAttribute("points", points.join(" "));
    }
  }

  describe(i) {
    const { episode } = this,
      list = Replay.make("dl"),
      together = this.owners.length < 2;
    const add = (to, name, content) => {
      to.append(Replay.make("dt", name[0].toUpperCase() + name.slice(1)));
      const value = Replay.make("dd");
      value.append(...(Array.isArray(content) ? content : [content]));
      to.append(value);
    };
    const total = this.total(i);
    for (const { agent, facts } of this.columns) {
      const to = together ? list : facts,
        own = (one) => one.agent === agent;
      facts.replaceChildren();
      for (const text of episode.texts.filter(own)) add(to, text.name, text.values[text.at[i]]);
      for (const action of episode.actions.filter(own)) {
        add(
          to,
          "last action",
          i > 0 ? action.values[action.at[i - 1]] + this.explorers(i) : "none yet: the episode begins",
        );
      }
      const number = episode.agents.indexOf(agent.replaceAll("_", " "));
      if (!together && number >= 0) {
        if (i > 0) add(to, "reward", Replay.signed(episode.reward[i - 1][number]));
        add(to, "return so far", Replay.signed(total[number]));
      }
    }
    if (i > 0 && together) {
      add(list, "reward", this.several(episode.reward[i - 1]));
      if (episode.events.length) {
        const events = episode.events.filter((_, bit) => (episode.event[i - 1] >>> bit) & 1);
        add(list, "events", events.length ? events.map((name) => Replay.make("span", name, "event")) : "none");
      }
      add(list, "return so far", this.several(total));
    }
    if (this.k === this.length) add(list, "end", episode.end);
    this.find(".caption").replaceChildren(list);
  }

  // Bit i of a step's mask: agent i chose its part of the action at random.
  explorers(i) {
    const { agents, explored } = this.episode,
      who = agents.filter((_, agent) => (explored[i - 1] >>> agent) & 1);
    if (!who.length) return "";
    return ` (${who.length < agents.length ? `${who.join(" and ")} ` : ""}explored: chosen at random)`;
  }

  several(values) {
    const { agents } = this.episode;
    return agents.length > 1
      ? values.map((value, i) => `${agents[i]} ${Replay.signed(value)}`).join(", ")
      : Replay.signed(values[0]);
  }

  total(i) {
    const { agents, reward, before, begins } = this.episode;
    const from = begins?.findLast((begin) => begin <= Math.max(0, i - 1)) ?? 0;
    return agents.map(
      (_, agent) =>
        Math.round(
          reward.slice(from, i).reduce((sum, row) => sum + Number(row[agent]), from ? 0 : (before[agent] ?? 0)) * 1e4,
        ) / 1e4,
    );
  }

  move(i) {
    for (const { rows } of this.columns) {
      for (const { line, cursor, value } of rows) {
        cursor.setAttribute("x1", i);
        cursor.setAttribute("x2", i);
        value.textContent = line.values[i] ?? "unknown";
      }
    }
  }

  // The value logged last under each name up to this frame; of names that were logged only later, the next one.
  near(i) {
    const { logged, time } = this.episode,
      now = time[i],
      place = this.find(".logged");
    const rows = logged.map(({ name, at, values }) => {
      const after = at.findIndex((step) => step > now),
        j = after < 0 ? at.length - 1 : Math.max(0, after - 1);
      const far = Math.abs(at[j] - now),
        steps = `${far.toLocaleString("en")} ${far === 1 ? "step" : "steps"}`;
      const row = Replay.make("tr");
      row.append(
        Replay.make("th", name),
        Replay.make("td", values[j]),
        Replay.make(
          "td",
          far
            ? `${steps} ${at[j] > now ? "later" : "before"}`
            : (this.episode.first ?? 0) + i
              ? "now"
              : "before the first step",
        ),
      );
      row.firstChild.scope = "row";
      return row;
    });
    place.hidden = !rows.length;
    if (!rows.length) return;
    const table = Replay.make("table"),
      body = Replay.make("tbody");
    table.append(Replay.make("caption", "Logged near this step"), body);
    body.append(...rows);
    place.replaceChildren(table);
  }

  // Where there is nothing but texts: the steps around this one.
  list(i) {
    const { episode } = this,
      body = Replay.make("tbody"),
      first = episode.first ?? 0;
    const row = (tag, cells, name) => {
      const line = Replay.make("tr", undefined, name);
      line.append(...cells.map((cell) => Replay.make(tag, String(cell))));
      return line;
    };
    const text = (words, j) => words.values[words.at[j]] ?? "";
    for (let j = Math.max(0, i - 6); j <= Math.min(episode.reward.length, i + 6); j++) {
      const taken = episode.actions.map((words) => (j ? text(words, j - 1) : ""));
      body.append(
        row(
          "td",
          [
            first + j,
            ...taken,
            j ? episode.reward[j - 1].join(", ") : "",
            ...episode.texts.map((words) => text(words, j)),
          ],
          j === i ? "now" : "",
        ),
      );
    }
    const named = ({ agent, name }) => `${agent} ${name}`.trim(),
      head = Replay.make("thead");
    head.append(row("th", ["step", ...episode.actions.map(named), "reward", ...episode.texts.map(named)]));
    this.table.replaceChildren(head, body);
  }

  choices(i) {
    const { episode } = this;
    const parts = episode.values.map((table, learner) => {
      const box = Replay.make("div");
      if (i >= table.row.length) return box;
      const rows = table.rows[table.row[i]],
        taken = table.taken[i];
      const names = episode.choices[episode.choices.length > 1 ? learner : 0];
      const who = episode.agents.length > 1 ? episode.agents[learner] : "Next action";
      const title = Replay.make("h3", who + ": Q-values here ");
      const most = rows.length < table.of ? `${rows.length} of ${table.of} actions; ` : "";
      title.append(Replay.make("small", `(${most}bars from the lowest here to the highest)`));
      const values = rows.map((row) => row[1]),
        low = Math.min(...values),
        high = Math.max(...values);
      const bars = Replay.make("ol");
      for (const [action, value] of rows) {
        const item = Replay.make("li", undefined, action === taken ? "taken" : "");
        const bar = Replay.make("span"),
          fill = Replay.make("i");
        fill.style.width = `${high > low ? 4 + (96 * (value - low)) / (high - low) : 4}%`;
        bar.append(fill);
        item.append(
          Replay.make("span", (action === taken ? "\u25b8 " : "") + names[action]),
          bar,
          this.explained(value, action, learner),
        );
        bars.append(item);
      }
      box.append(title, bars);
      return box;
    });
    if (this.k === this.length) parts.push(Replay.make("p", "The last step shown."));
    else if (!episode.values.length) {
      const next = episode.actions.map(
        (words) => `${words.agent ? `${words.agent.replaceAll("_", " ")}: ` : ""}${words.values[words.at[i]]}`,
      );
      parts.push(Replay.make("p", `Next action: ${next.join(", ")}`));
    }
    this.find(".choice").replaceChildren(...parts);
  }

  // A Q-value before the step at the slider; on a server's page a link to where it comes from.
  explained(value, action, learner) {
    const number = Replay.make("b", value),
      { why } = this.root.dataset;
    if (!why) return number;
    const { agents, choices } = this.episode,
      link = Replay.make("a");
    const query = new URLSearchParams({ action, ...(choices.length > 1 ? { agent: agents[learner] } : {}) });
    link.href = `${why}:${this.k}&${query}`;
    link.title = "Why is it this value?";
    link.append(number);
    return link;
  }

  key(event) {
    const jump = { PageUp: -10, PageDown: 10 }[event.key];
    if (event.key === " ") {
      event.preventDefault();
      this.play();
    }
    if (!jump) return;
    event.preventDefault();
    this.pause();
    this.show(this.k + jump);
  }

  pause() {
    clearInterval(this.timer);
    this.timer = null;
    this.button.textContent = "\u25b6";
    this.button.setAttribute("aria-label", "Play");
  }

  play() {
    if (this.timer) return this.pause();
    if (this.k === this.length) this.show(0);
    this.button.textContent = "\u275a\u275a";
    this.button.setAttribute("aria-label", "Pause");
    this.timer = setInterval(() => {
      if (this.k >= this.length) return this.pause();
      this.show(this.k + 1);
    }, this.pace);
  }

  static make(tag, text, name) {
    const element = document.createElement(tag);
    if (text !== undefined) element.textContent = text;
    if (name) element.className = name;
    return element;
  }

  static signed(value) {
    return (value > 0 ? "+" : "") + value;
  }
}

// A report contains its episodes, with their pictures.
for (const root of document.querySelectorAll(".replay[data-replay]")) {
  const episodes = JSON.parse(document.getElementById(root.dataset.replay).textContent);
  const choose = root.querySelector(".episode"),
    chosen = () => episodes[Number(choose.value)];
  const pictures = (k, show) => {
    const { pictures: addresses, picture, picture_note: note } = chosen();
    show(
      addresses[picture[k]] ?? "",
      k < picture.length && addresses.length && picture[k] < addresses.length - 1 ? "" : note,
    );
  };
  const replay = new Replay(root, { pictures });
  choose.addEventListener("change", () => replay.begin(chosen()));
  replay.begin(chosen());
}
