"use strict";
// A replay: every frame is the elements of the picture moved to the places that came with the data.
//
// Frame k of an episode is the state after k steps. An episode's data may be a part of it: the frames
// from `first` on, with the sums of the rewards before them; what else is wanted is then asked of `load`.
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
    const said = `step ${k} of ${this.length}`;
    this.slider.value = k;
    this.slider.setAttribute("aria-valuetext", said);
    this.find(".count").textContent = said;
    if (!this.holds(k)) {
      const wanted = await this.load(k);
      if (this.k !== k) return;
      this.episode = wanted;
    }
    const i = k - (this.episode.first ?? 0);
    if (this.episode.places.length) this.draw(i);
    this.tell(i);
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

  tell(i) {
    const { data, episode } = this, list = Replay.made("dl");
    const say = (name, content) => {
      list.append(Replay.made("dt", name));
      const value = Replay.made("dd");
      value.append(...(Array.isArray(content) ? content : [content]));
      list.append(value);
    };
    say("State", episode.states[episode.state[i]]);
    if (i > 0) {
      say("Last action", data.actions[episode.action[i - 1]] + this.explorers(episode.explored[i - 1]));
      say("Reward", this.several(episode.reward[i - 1]));
      const events = data.events.filter((_, bit) => episode.event[i - 1] >>> bit & 1);
      say("Events", events.length ? events.map((name) => Replay.made("span", name, "event")) : "none");
      say("Sum so far", this.several(this.total(i)));
    } else {
      say("Last action", "none yet: the episode begins");
    }
    this.find(".caption").replaceChildren(list);
  }

  // Bit i of a step's mask is learner i: whose part of the action was chosen at random.
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
      const box = Replay.made("div");
      if (i >= table.row.length) return box;
      const rows = table.rows[table.row[i]], taken = table.taken[i];
      const names = data.choices.length > 1 ? data.choices[learner] : data.choices[0];
      const who = data.learners.length > 1 ? data.learners[learner] : "Next action";
      const title = Replay.made("h4", who + ": Q-values here ");
      const most = rows.length < table.of ? `${rows.length} of ${table.of} actions; ` : "";
      title.append(Replay.made("small", `(${most}bars from the lowest here to the highest)`));
      const values = rows.map((row) => row[1]), low = Math.min(...values), high = Math.max(...values);
      const bars = Replay.made("ol");
      for (const [action, value] of rows) {
        const item = Replay.made("li", undefined, action === taken ? "taken" : "");
        const bar = Replay.made("span"), fill = Replay.made("i");
        fill.style.width = `${high > low ? 4 + 96 * (value - low) / (high - low) : 4}%`;
        bar.append(fill);
        item.append(Replay.made("span", (action === taken ? "\u25b8 " : "") + names[action]), bar, Replay.made("b", String(value).replace("-", "\u2212")));
        bars.append(item);
      }
      box.append(title, bars);
      return box;
    });
    if (i + (episode.first ?? 0) === this.length) parts.push(Replay.made("p", "The last step shown."));
    else if (!episode.values.length) parts.push(Replay.made("p", "Next action: " + data.actions[episode.action[i]]));
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

  static made(tag, text, name) {
    const element = document.createElement(tag);
    if (text !== undefined) element.textContent = text;
    if (name) element.className = name;
    return element;
  }

  static signed(value) { return (value > 0 ? "+" : "") + String(value).replace("-", "\u2212"); }
}

// A report: its episodes stand in the page.
for (const root of document.querySelectorAll(".replay[data-replay]")) {
  const data = JSON.parse(document.getElementById(root.dataset.replay).textContent);
  const replay = new Replay(root, data), choose = root.querySelector(".episode");
  const begin = () => replay.begin(data.episodes[Number(choose.value)]);
  choose.addEventListener("change", begin);
  begin();
}
