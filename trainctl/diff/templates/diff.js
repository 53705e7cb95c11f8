"use strict";
const plots = JSON.parse(document.getElementById("data").textContent);

// Value of the row at or before a time; null before the first.
function held(points, time) {
  let low = 0, high = points.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (points[middle][0] <= time + 1e-9) low = middle + 1; else high = middle;
  }
  return low ? points[low - 1][1] : null;
}

for (const svg of document.querySelectorAll("svg[data-plot]")) {
  const plot = plots[Number(svg.dataset.plot)];
  const line = svg.querySelector(".cursor-line");
  const out = svg.closest("figure").querySelector("output");
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width * svg.viewBox.baseVal.width;
    const share = Math.min(1, Math.max(0, (x - plot.left) / (plot.right - plot.left)));
    const time = plot.begin + share * (plot.end - plot.begin);
    const shown = (value) => value === null ? "nothing" : String(Number(value.toPrecision(8)));
    const [a, b, low, high] = ["a", "b", "lower", "upper"].map((name) => held(plot[name], time));
    out.textContent = `${time.toFixed(1)} s: A ${shown(a)}, B ${shown(b)}, tube ${shown(low)} .. ${shown(high)}`;
    line.setAttribute("x1", x); line.setAttribute("x2", x);
  });
}
document.documentElement.dataset.ready = "yes";
