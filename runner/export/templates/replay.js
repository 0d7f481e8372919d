"use strict";
// Replays: every frame is the elements of the picture moved to the places that came with the data.
for (const root of document.querySelectorAll(".replay")) {
  const data = JSON.parse(document.getElementById(root.dataset.replay).textContent);
  const find = (selector) => root.querySelector(selector);
  const [choose, slider, button] = [find(".episode"), find(".step"), find(".play")];
  const things = [...root.querySelectorAll("[data-thing]")];
  const trails = [...root.querySelectorAll("[data-trail]")];
  let episode, timer = null;

  const made = (tag, text, name) => {
    const element = document.createElement(tag);
    if (text !== undefined) element.textContent = text;
    if (name) element.className = name;
    return element;
  };
  const place = (k, thing) => episode.places[episode.state[k]].slice(3 * thing, 3 * thing + 3);
  const signed = (value) => (value > 0 ? "+" : "") + String(value).replace("-", "\u2212");
  const several = (values) => data.learners.length > 1
    ? values.map((value, i) => `${data.learners[i]} ${signed(value)}`).join(", ") : signed(values[0]);
  const total = (k) => data.learners.map((_, i) =>
    Math.round(episode.reward.slice(0, k).reduce((sum, row) => sum + row[i], 0) * 1e4) / 1e4);

  function draw(k) {
    for (const thing of things) {
      const [x, y, percent] = place(k, Number(thing.dataset.thing));
      thing.setAttribute("transform", `translate(${x} ${y}) scale(${percent / 100})`);
    }
    const from = Math.max(0, k + 1 - data.trail);
    for (const trail of trails) {
      const points = [];
      for (let i = from; i <= k; i++) points.push(place(i, Number(trail.dataset.trail)).slice(0, 2).join(","));
      trail.setAttribute("points", points.join(" "));
    }
  }

  function tell(k) {
    const list = made("dl");
    const say = (name, content) => {
      list.append(made("dt", name));
      const value = made("dd");
      value.append(...(Array.isArray(content) ? content : [content]));
      list.append(value);
    };
    say("State", episode.states[episode.state[k]]);
    if (k > 0) {
      say("Last action", data.actions[episode.action[k - 1]] + (episode.explored[k - 1] ? " (explored: chosen at random)" : ""));
      say("Reward", several(episode.reward[k - 1]));
      const events = data.events.filter((_, bit) => episode.event[k - 1] >>> bit & 1);
      say("Events", events.length ? events.map((name) => made("span", name, "event")) : "none");
      say("Sum so far", several(total(k)));
    } else {
      say("Last action", "none yet: the episode begins");
    }
    find(".caption").replaceChildren(list);
  }

  function choices(k) {
    const parts = episode.values.map((table, i) => {
      const box = made("div");
      if (k >= table.row.length) return box;
      const rows = table.rows[table.row[k]], taken = table.taken[k];
      const names = data.choices.length > 1 ? data.choices[i] : data.choices[0];
      const who = data.learners.length > 1 ? data.learners[i] : "Next action";
      const title = made("h4", who + ": Q-values here ");
      if (rows.length < table.of) title.append(made("small", `(${rows.length} of ${table.of} actions)`));
      const values = rows.map((row) => row[1]), low = Math.min(...values), high = Math.max(...values);
      const bars = made("ol");
      for (const [action, value] of rows) {
        const item = made("li", undefined, action === taken ? "taken" : "");
        const bar = made("span"), fill = made("i");
        fill.style.width = `${high > low ? 4 + 96 * (value - low) / (high - low) : 4}%`;
        bar.append(fill);
        item.append(made("span", (action === taken ? "\u25b8 " : "") + names[action]), bar, made("b", String(value).replace("-", "\u2212")));
        bars.append(item);
      }
      box.append(title, bars);
      return box;
    });
    const last = k === episode.action.length;
    if (last) parts.push(made("p", "The last step shown."));
    else if (!episode.values.length) parts.push(made("p", "Next action: " + data.actions[episode.action[k]]));
    find(".choice").replaceChildren(...parts);
  }

  function show(k) {
    slider.value = k;
    const said = `step ${k} of ${episode.action.length}`;
    slider.setAttribute("aria-valuetext", said);
    find(".count").textContent = said;
    if (episode.places.length) draw(k);
    tell(k);
    choices(k);
  }

  function pause() {
    clearInterval(timer);
    timer = null;
    button.textContent = "\u25b6";
    button.setAttribute("aria-label", "Play");
  }

  function play() {
    if (timer) return pause();
    if (Number(slider.value) === episode.action.length) show(0);
    button.textContent = "\u23f8";
    button.setAttribute("aria-label", "Pause");
    timer = setInterval(() => {
      const next = Number(slider.value) + 1;
      if (next > episode.action.length) return pause();
      show(next);
    }, 350);
  }

  function begin() {
    pause();
    episode = data.episodes[Number(choose.value)];
    slider.max = episode.action.length;
    find(".description").textContent = episode.description;
    show(0);
  }

  slider.addEventListener("input", () => { pause(); show(Number(slider.value)); });
  slider.addEventListener("keydown", (event) => {
    const jump = { PageUp: -10, PageDown: 10 }[event.key];
    if (event.key === " ") { event.preventDefault(); play(); }
    if (!jump) return;
    event.preventDefault();
    pause();
    show(Math.min(episode.action.length, Math.max(0, Number(slider.value) + jump)));
  });
  button.addEventListener("click", play);
  choose.addEventListener("change", begin);
  begin();
}
