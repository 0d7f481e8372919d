"use strict";
// A replay: a frame moves the elements of the picture to the places in the data.
//
// Frame k of an episode is the state after k steps. The data may be a part of an episode: the frames from `first`
// on, with the sums of the rewards before them; `load` returns the part with another frame.
class Replay {
  constructor(root, data, { load = null, moved = () => {} } = {}) {
    Object.assign(this, { root, data, load, moved, episode: null, timer: null, k: 0, pace: 350 });
    this.slider = this.find(".step");
    this.button = this.find(".play");
    this.things = [...root.querySelectorAll("[data-thing]")];
    this.trails = [...root.querySelectorAll("[data-trail]")];
    this.slider.addEventListener("input", () => { this.pause(); this.show(Number(this.slider.value)); });
    this.slider.addEventListener("keydown", (event) => this.key(event));
    this.button.addEventListener("click", () => this.play());
  }

  find(selector) { return this.root.querySelector(selector); }

  get length() { return this.episode.length ?? this.episode.action.length; }

  begin(episode, k = 0) {
    this.pause();
    this.episode = episode;
    this.slider.max = this.length;
    this.find(".description").textContent = episode.description;
    this.show(k);
  }

  holds(k) {
    const first = this.episode.first ?? 0;
    return k >= first && k <= first + this.episode.action.length;
  }

  async show(k) {
    this.k = k = Math.min(this.length, Math.max(0, k));
    const count = `step ${k} of ${this.length}`;
    this.slider.value = k;
    this.slider.setAttribute("aria-valuetext", count);
    this.find(".count").textContent = count;
    if (!this.holds(k)) {
      const loaded = await this.load(k);
      if (this.k !== k) return;
      this.episode = loaded;
    }
    const i = k - (this.episode.first ?? 0);
    if (this.episode.places.length) this.draw(i);
    this.describe(i);
    this.choices(i);
    this.moved(k);
  }

  place(i, thing) {
    return this.episode.places[this.episode.state[i]].slice(3 * thing, 3 * thing + 3);
  }

  draw(i) {
    for (const thing of this.things) {
      const [x, y, percent] = this.place(i, Number(thing.dataset.thing));
      thing.setAttribute("transform", `translate(${x} ${y}) scale(${percent / 100})`);
    }
    const from = Math.max(0, i + 1 - this.data.trail);
    for (const trail of this.trails) {
      const points = [];
      for (let j = from; j <= i; j++) points.push(this.place(j, Number(trail.dataset.trail)).slice(0, 2).join(","));
      trail.setAttribute("points", points.join(" "));
    }
  }

  describe(i) {
    const { data, episode } = this, list = Replay.make("dl");
    const add = (name, content) => {
      list.append(Replay.make("dt", name));
      const value = Replay.make("dd");
      value.append(...(Array.isArray(content) ? content : [content]));
      list.append(value);
    };
    add("State", episode.states[episode.state[i]]);
    if (i > 0) {
      add("Last action", data.actions[episode.action[i - 1]] + this.explorers(episode.explored[i - 1]));
      add("Reward", this.several(episode.reward[i - 1]));
      const events = data.events.filter((_, bit) => episode.event[i - 1] >>> bit & 1);
      add("Events", events.length ? events.map((name) => Replay.make("span", name, "event")) : "none");
      add("Sum so far", this.several(this.total(i)));
    } else {
      add("Last action", "none yet: the episode begins");
    }
    this.find(".caption").replaceChildren(list);
  }

  // Bit i of a step's mask: learner i chose its part of the action at random.
  explorers(mask) {
    const { learners } = this.data, who = learners.filter((_, learner) => mask >>> learner & 1);
    if (!who.length) return "";
    return ` (${who.length < learners.length ? `${who.join(" and ")} ` : ""}explored: chosen at random)`;
  }

  several(values) {
    const { learners } = this.data;
    return learners.length > 1
      ? values.map((value, i) => `${learners[i]} ${Replay.signed(value)}`).join(", ") : Replay.signed(values[0]);
  }

  total(i) {
    return this.data.learners.map((_, learner) => Math.round(
      this.episode.reward.slice(0, i).reduce((sum, row) => sum + row[learner], this.episode.before?.[learner] ?? 0) * 1e4,
    ) / 1e4);
  }

  choices(i) {
    const { data, episode } = this;
    const parts = episode.values.map((table, learner) => {
      const box = Replay.make("div");
      if (i >= table.row.length) return box;
      const rows = table.rows[table.row[i]], taken = table.taken[i];
      const names = data.choices.length > 1 ? data.choices[learner] : data.choices[0];
      const who = data.learners.length > 1 ? data.learners[learner] : "Next action";
      const title = Replay.make("h4", who + ": Q-values here ");
      const most = rows.length < table.of ? `${rows.length} of ${table.of} actions; ` : "";
      title.append(Replay.make("small", `(${most}bars from the lowest here to the highest)`));
      const values = rows.map((row) => row[1]), low = Math.min(...values), high = Math.max(...values);
      const bars = Replay.make("ol");
      for (const [action, value] of rows) {
        const item = Replay.make("li", undefined, action === taken ? "taken" : "");
        const bar = Replay.make("span"), fill = Replay.make("i");
        fill.style.width = `${high > low ? 4 + 96 * (value - low) / (high - low) : 4}%`;
        bar.append(fill);
        item.append(Replay.make("span", (action === taken ? "\u25b8 " : "") + names[action]), bar, Replay.make("b", String(value).replace("-", "\u2212")));
        bars.append(item);
      }
      box.append(title, bars);
      return box;
    });
    if (i + (episode.first ?? 0) === this.length) parts.push(Replay.make("p", "The last step shown."));
    else if (!episode.values.length) parts.push(Replay.make("p", "Next action: " + data.actions[episode.action[i]]));
    this.find(".choice").replaceChildren(...parts);
  }

  key(event) {
    const jump = { PageUp: -10, PageDown: 10 }[event.key];
    if (event.key === " ") { event.preventDefault(); this.play(); }
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
    this.button.textContent = "\u23f8";
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

  static signed(value) { return (value > 0 ? "+" : "") + String(value).replace("-", "\u2212"); }
}

// A report contains its episodes.
for (const root of document.querySelectorAll(".replay[data-replay]")) {
  const data = JSON.parse(document.getElementById(root.dataset.replay).textContent);
  const replay = new Replay(root, data), choose = root.querySelector(".episode");
  const begin = () => replay.begin(data.episodes[Number(choose.value)]);
  choose.addEventListener("change", begin);
  begin();
}
