// Keeps ages of moments up to date, in the words of `runner.util.humanize.age`.
const UNITS = [
  [60, 1, "s"],
  [3600, 60, "min"],
  [86400, 3600, "h"],
  [Infinity, 86400, "d"],
];

function age(moment) {
  const seconds = Math.max(0, Math.round((Date.now() - Date.parse(moment)) / 1000));
  const [, divisor, unit] = UNITS.find(([bound]) => seconds < bound);
  return `${Math.floor(seconds / divisor)} ${unit}`;
}

function update() {
  for (const time of document.querySelectorAll("time[data-age]")) {
    const words = age(time.dateTime);
    if (time.textContent !== words) time.textContent = words;
  }
}

setInterval(update, 5000);
